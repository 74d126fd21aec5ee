"""Report of the experiment with extended lights: a table, a summary of it and a sheet of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.table import Table

from ...io import console, files, images, plots

Image = npt.NDArray[np.floating[Any]]

# End of the scale of differences: surfaces are about as bright as 0.5, outlines of lamps differ by more.
_MOST = 0.1


def rows(record: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Column titles, and a row for each scene."""
    pairs = [tuple(pair) for pair in record["settings"]["samples"]]
    columns = ["scene", "lights, materials", *(f"{a} / {b}" for a, b in pairs), "bias", "one map", "ours", "direct", "ratio"]
    table = []
    for name, entry in record["scenes"].items():
        errors, times = entry["errors"], entry.get("times")
        row = [f"({name})" if entry["glossy"] else name, entry["about"], *(f"{100 * e['error']:.2f} %" for e in errors)]
        row.append(f"{100 * errors[-1]['bias']:+.2f} %")
        single = entry.get("one_map")
        row.append(f"{100 * single['error']:.2f} %" if single else "-")
        if times:
            seconds = times["seconds"]
            row += [_time(seconds["ours"]), f"{_time(seconds['path traced'])} ({times['path_traced_spp']})"]
            row.append(f"{times['ratio']:.1f}x")
        else:
            row += ["-"] * 3
        table.append(row)
    return columns, table


def table(record: Mapping[str, Any]) -> Table:
    """Table of errors for the terminal, without the units of the cells."""
    columns, lines = rows(record)
    keep = [0, *range(2, len(columns) - 3)]
    cells = [[line[k].removesuffix(" %") for k in keep] for line in lines]
    return console.table(
        "Relative error [%] by samples (area light / sky)", [columns[k].replace(" / ", "/") for k in keep], cells
    )


def times_table(record: Mapping[str, Any]) -> Table | None:
    """Table of times for the terminal; None if none were measured."""
    columns, lines = rows(record)
    cells = [[line[0], *line[-3:]] for line in lines if line[-1] != "-"]
    names = ["scene", "ours", "path traced (samples per pixel)", "ratio"]
    return console.table("Time of an image at equal error", names, cells) if cells else None


def reading(record: Mapping[str, Any], bar: float = 0.02) -> list[str]:
    """Summary of the record in sentences."""
    scenes = record["scenes"]
    rough = {name: entry for name, entry in scenes.items() if not entry["glossy"]}
    above = {n: e["errors"][-1]["error"] for n, e in rough.items() if e["errors"][-1]["error"] > bar}
    rising = [name for name, entry in rough.items() if not falling([e["error"] for e in entry["errors"]])]
    lines = [f"{len(rough) - len(above)} of {len(rough)} scenes without gloss are within {100 * bar:g} %."]
    if above:
        lines.append("Above it: " + ", ".join(f"{name} ({100 * error:.2f} %)" for name, error in above.items()) + ".")
    lines.append(f"Errors that do not fall with samples: {', '.join(rising) or 'none'}.")
    return lines


def falling(errors: Sequence[float]) -> bool:
    """True if the last error is below the first, and no error exceeds the one before by a tenth of the last error."""
    if len(errors) < 2:
        return True
    return errors[-1] < errors[0] and all(b <= a + 0.1 * errors[-1] for a, b in zip(errors, errors[1:], strict=False))


def write(record: Mapping[str, Any], out: Path) -> None:
    """Write `soft.md` and `soft.png`."""
    columns, lines = rows(record)
    text = ["# Extended lights", "", *reading(record), "", _markdown(columns), _markdown(["---"] * len(columns))]
    text += [_markdown(line) for line in lines]
    with files.atomic(out / "soft.md") as temporary:
        temporary.write_text("\n".join(text) + "\n", encoding="utf-8")
    sheet = {}
    for name in record["scenes"]:
        pictures = load_pictures(out / "pictures" / f"{name}.exr")
        if pictures:
            shown = {title: image * _exposure(pictures["path traced"]) for title, image in pictures.items()}
            sheet[name] = {**shown, "difference": shown["ours"] - shown["path traced"]}
    if sheet:
        plots.image_sheet(out / "soft.png", _paired(sheet), most=_MOST)


def save_pictures(path: Path, pictures: Mapping[str, Image]) -> None:
    """Write images (H, W, 3) of the same size as channels of one EXR file."""
    channels = {f"{title}.{'RGB'[k]}": image[..., k].astype(np.float32) for title, image in pictures.items() for k in range(3)}
    files.make_folder(path.parent)
    images.write_exr(path, channels)


def load_pictures(path: Path) -> dict[str, Image]:
    """Read the pictures of :func:`save_pictures`; an empty dictionary if the file does not exist."""
    if not path.exists():
        return {}
    channels, _ = images.read_exr(path)
    titles = dict.fromkeys(key.rpartition(".")[0] for key in channels)
    order = sorted(titles, key=lambda title: title != "path traced")
    return {title: np.stack([channels[f"{title}.{c}"] for c in "RGB"], -1) for title in order}


def _exposure(image: Image) -> float:
    """Factor that brings an image to a visible brightness."""
    return 0.5 / max(float(np.quantile(image, 0.8)), 1e-6)


def _paired(sheet: Mapping[str, Mapping[str, Image]]) -> dict[str, dict[str, Image]]:
    """Two scenes in each row, so that the sheet is not too long."""
    names = list(sheet)
    result: dict[str, dict[str, Image]] = {}
    for first, second in zip(names[0::2], [*names[1::2], None], strict=False):
        row = dict(sheet[first])
        if second is not None:
            # The titles again, with a space to keep the keys different.
            row |= {f"{title} ": image for title, image in sheet[second].items()}
        result[f"{first} | {second}" if second else first] = row
    return result


def _time(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 1 else f"{1e3 * seconds:.0f} ms"


def _markdown(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"
