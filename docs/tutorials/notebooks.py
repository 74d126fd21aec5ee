"""Runs the notebooks of this folder without Jupyter: their code cells, in order, in one namespace.

    python docs/tutorials/notebooks.py NOTEBOOK.ipynb ...

runs notebooks as they are and stores what they print and draw in them, as Jupyter would.
"""

from __future__ import annotations

import argparse
import base64
import contextlib
import io
import json
import linecache
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io.files import atomic

HERE = Path(__file__).resolve().parent
# Of stored figures: small files matter more than sharp lettering.
_DPI = 72


@dataclass(frozen=True)
class Cell:
    """A code cell: its number in the notebook, its text and its tags."""

    number: int
    source: str
    tags: frozenset[str]


def code_cells(path: str | Path) -> list[Cell]:
    """The code cells of a notebook. Raises ShadowmapError if the file is no notebook."""
    return [
        Cell(number, "".join(cell["source"]), frozenset(cell["metadata"].get("tags", ())))
        for number, cell in enumerate(_read(path)["cells"])
        if cell["cell_type"] == "code"
    ]


def run(
    path: str | Path,
    skip: Collection[str] = (),
    on_cell: Callable[[Cell, str], None] = lambda cell, printed: None,
    **parameters: Any,
) -> dict[str, Any]:
    """Run a notebook's code cells.

    Args:
        path: of the notebook.
        skip: tags of cells that are left out. Those that only run and draw what others define have the tag `run`.
        on_cell: told after each cell what it has printed; figures are still open.
        parameters: new values of variables that the cell with the tag `parameters` sets.

    Returns:
        The namespace after the last cell.

    Raises:
        ShadowmapError: A parameter that the notebook does not have. Errors of cells come through as they are.
    """
    # As a script would be called, so that the notebook's functions and classes can be pickled and inspected.
    names: dict[str, Any] = {"__name__": "__notebook__"}
    for cell in code_cells(path):
        if cell.tags & set(skip):
            continue
        label = f"{Path(path).name}, cell {cell.number}"
        # Tracebacks then show the cell's lines, and `dr.freeze` finds the text of functions.
        linecache.cache[label] = (len(cell.source), None, cell.source.splitlines(True), label)
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(cell.source, label, "exec", dont_inherit=True), names)
        if "parameters" in cell.tags:
            unknown = sorted(set(parameters) - set(names))
            if unknown:
                raise ShadowmapError(f"{Path(path).name} has no parameter {unknown[0]!r}: its cell 'parameters' sets none.")
            names.update(parameters)
        on_cell(cell, printed.getvalue())
    return names


def store_outputs(path: str | Path, **parameters: Any) -> None:
    """Run a notebook and put what its cells print and draw (as PNG) into the file. Written at once, when all cells have run."""
    from matplotlib import pyplot

    notebook = _read(path)
    done = 0

    def keep(cell: Cell, printed: str) -> None:
        nonlocal done
        done += 1
        outputs: list[dict[str, Any]] = []
        if printed:
            outputs.append({"name": "stdout", "output_type": "stream", "text": printed.splitlines(True)})
        for number in pyplot.get_fignums():
            file = io.BytesIO()
            pyplot.figure(number).savefig(file, format="png", dpi=_DPI, bbox_inches="tight", metadata={"Software": None})
            data = {"image/png": base64.b64encode(small_png(file.getvalue())).decode() + "\n", "text/plain": ["<Figure>"]}
            outputs.append({"data": data, "metadata": {}, "output_type": "display_data"})
        pyplot.close("all")
        notebook["cells"][cell.number] |= {"execution_count": done, "outputs": outputs}

    run(path, on_cell=keep, **parameters)
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def small_png(picture: bytes) -> bytes:
    """A PNG picture with a palette of 256 colours: a third of the size."""
    file = io.BytesIO()
    Image.open(io.BytesIO(picture)).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(file, format="PNG", optimize=True)
    return file.getvalue()


def _read(path: str | Path) -> dict[str, Any]:
    try:
        notebook = json.loads(Path(path).read_text(encoding="utf-8"))
        if notebook["nbformat"] < 4:
            raise KeyError("nbformat")
        return notebook
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ShadowmapError(f"{path} is no notebook that can be read: give an .ipynb file of format 4.") from error


def main() -> None:
    import matplotlib
    from rich.progress import track

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("notebooks", nargs="+", type=Path, help=".ipynb files, which are rewritten")
    matplotlib.use("Agg")
    for path in track(parser.parse_args().notebooks, "notebooks"):
        store_outputs(path)


if __name__ == "__main__":
    main()
