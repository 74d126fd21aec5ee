"""The gallery of shadow art and the accuracy of its shadows: all pieces by one command.

    python -m shadowmap_dr.experiments.art.gallery

makes every piece with the settings of `shadowmap-dr art`, and from their files a folder of animations, a sheet of pictures, and a
record of all numbers with the tables of the documentation.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from rich.console import Console

from ...errors import ShadowmapError, did_you_mean
from ...io import files
from ...io import records as io_records
from ...io.console import markdown, notes
from ...io.machine import header
from ...variants import DEFAULT_VARIANT
from .experiment import ArtOptions, run_art

#: Targets without holes, except the thin-legged horse, and targets with holes.
WHOLE, HOLED = ("airplane", "heart", "elephant", "palm"), ("cat", "duck", "rabbit", "kettle")
# Animations of each piece in the gallery.
_SHOWN = ("turntable.webp", "steps.webp")
_PICTURE_SIZE, _TURNS = 256, 32
# Entries of a piece's record that the record of all pieces leaves out.
_LEFT_OUT = ("machine", "loss_curve", "iou_curve", "files")


@dataclass(frozen=True)
class Piece:
    """One piece: its name, the group in the tables, its `ArtOptions`, and its title in the gallery.

    Pieces without a title are not in the gallery.
    """

    name: str
    group: str
    options: Mapping[str, Any] = field(default_factory=dict)
    title: str = ""

    @property
    def shown(self) -> bool:
        return bool(self.title)


def _pieces() -> tuple[Piece, ...]:
    titles = {"elephant": "One view: an elephant", "palm": "One view: a hand",
              "heart-elephant": "Two views: a heart and an elephant"}  # fmt: skip
    single = [Piece(name, "one view", {"targets": (name,)}, titles.get(name, "")) for name in (*WHOLE, "horse", *HOLED)]
    pairs = [(a, b) for k, a in enumerate(WHOLE) for b in WHOLE[k + 1 :]]
    double = [Piece(f"{a}-{b}", "two views", {"targets": (a, b)},
                    titles.get(f"{a}-{b}", "")) for a, b in pairs]  # fmt: skip
    return (
        *single,
        *double,
        Piece("text-L-M", "two views", {"targets": ("text:L", "text:M")}, "Two views of letters: L and M"),
        *(Piece(f"{name}-remeshed", "one view, remeshed", {"targets": (name,), "remesh": 100}) for name in (*WHOLE, "horse")),
        Piece("text-S", "text", {"targets": ("text:S",)}, "A letter: S"),
        Piece("perspective", "perspective camera", {"targets": ("airplane",), "camera": "perspective"},
              "A perspective camera from the side: an airplane"),
        Piece("wavy", "wavy receiver", {"targets": ("heart",), "receiver": "wavy"}),
        Piece("wavy-perspective", "wavy receiver, perspective camera",
              {"targets": ("elephant",), "receiver": "wavy", "camera": "perspective"},
              "A curtain and a perspective camera: an elephant that is none from elsewhere"),
        Piece("bunny-heart", "from a mesh", {"targets": ("heart",), "mesh": "bunny"}, "The bunny with the shadow of a heart"),
        Piece("teapots-elephant", "collection", {"targets": ("elephant",), "collection": "teapot"},
              "128 teapots with the shadow of an elephant"),
        Piece("cows-heart", "collection", {"targets": ("heart",), "collection": "spot", "most": 32},
              "32 cows with the shadow of a heart"),
    )  # fmt: skip


PIECES = _pieces()


def run_gallery(
    names: Iterable[str], work: Path, out: Path, results: Path, *, resume: bool = False, console: Console | None = None
) -> dict[str, Any]:
    """Make pieces by name, and write gallery, tables and record. Returns the record.

    Args:
        names: of `PIECES`.
        work: folder for all files of all pieces, a folder for each.
        out: folder of the gallery.
        results: JSON file for the numbers; a file of tables (.md) is written beside it.
        resume: keep finished pieces.
    """
    console = console or notes()
    files.check_output(results, (".json",))
    chosen = [piece for piece in PIECES if piece.name in set(names)]
    records: dict[str, Any] = {}
    for number, piece in enumerate(chosen):
        path = work / piece.name / "art.json"
        if not (resume and path.exists() and _is_finished(path)):
            console.print(f"{number + 1} of {len(chosen)}: {piece.name}")
            run_art(
                ArtOptions(**piece.options, animate=".webp" if piece.shown else None, picture_size=_PICTURE_SIZE, turns=_TURNS,
                           out=work / piece.name, resume=resume),
                console=console,
            )  # fmt: skip
        kept = {name: value for name, value in io_records.read_json(path).items() if name not in _LEFT_OUT}
        records[piece.name] = {"group": piece.group, **kept}
        if piece.shown:
            for name in (*_SHOWN, *_shadow_images(piece)):
                with files.atomic(out / f"{piece.name}-{name}") as temporary:
                    shutil.copyfile(work / piece.name / name, temporary)
    record = {**header({"pieces": [piece.name for piece in chosen]}), "pieces": records, "summary": summary(records)}
    io_records.write_json(results, record)
    with files.atomic(results.with_suffix(".md")) as temporary:
        temporary.write_text("\n".join(document(record)) + "\n", encoding="utf-8")
    shown = [piece for piece in chosen if piece.shown]
    if shown:
        with files.atomic(out / "gallery.md") as temporary:
            temporary.write_text("\n".join(gallery(shown, records)) + "\n", encoding="utf-8")
        _sheet(out / "gallery.png", [work / piece.name / "picture.png" for piece in shown])
    return record


def _is_finished(path: Path) -> bool:
    """True if a file holds the record of a finished piece; other files are set aside."""
    try:
        record = io_records.read_json(path)
    except ShadowmapError:
        record = None
    sound = isinstance(record, dict) and {"settings", "views", "mesh", "iou_curve"} <= record.keys()
    if not sound:
        io_records.set_aside(path)
    return sound


def summary(records: Mapping[str, Any]) -> dict[str, Any]:
    """Means and worst cases of all records."""
    whole = [records[name]["views"][0]["iou"] for name in WHOLE if name in records]
    double = [view["iou"] for record in records.values() if record["group"] == "two views" for view in record["views"]]
    deformed = [record for record in records.values() if record["group"] != "collection"]
    result: dict[str, Any] = {}
    if whole:
        result |= {"one_view_mean": float(np.mean(whole)), "one_view_least": min(whole)}
    if double:
        result |= {"two_views_mean": float(np.mean(double)), "two_views_least": min(double)}
    if deformed:
        result["inverted_most"] = max(record["mesh"]["inverted_triangles"] for record in deformed)
    return result


def document(record: Mapping[str, Any]) -> list[str]:
    """Markdown tables of all pieces, by group."""
    groups: dict[str, list[tuple[str, Any]]] = {}
    for name, entry in record["pieces"].items():
        groups.setdefault(entry["group"], []).append((name, entry))
    lines = ["# Shadows and their targets", ""]
    columns = ["piece", "IoU", "IoU, target without holes", "triangles", "inverted", "steps", "s"]
    for group, entries in groups.items():
        rows = [[
            name,
            ", ".join(f"{view['iou']:.4f}" for view in entry["views"]),
            ", ".join(f"{view['iou_filled']:.4f}" for view in entry["views"]) if any(v["holes"] for v in entry["views"]) else "",
            f"{entry['mesh']['faces']:,}",
            f"{100 * entry['mesh']['inverted_triangles']:.2f} %",
            str(entry["settings"]["iterations"]),
            f"{entry['seconds']:.1f}",
        ] for name, entry in entries]  # fmt: skip
        lines += [f"## {group[0].upper()}{group[1:]}", "", *markdown(columns, rows), ""]
    values = ", ".join(f"{name.replace('_', ' ')} {value:.4f}" for name, value in record["summary"].items())
    return [*lines, f"In all: {values}."]


def gallery(pieces: Sequence[Piece], records: Mapping[str, Any]) -> list[str]:
    """Markdown: animations, shadows and a line for each piece."""
    lines = ["# Gallery of shadow art", "", "Left: a turn of the finished object; its shadow is right at the beginning only. "
             "Then: the steps of the optimisation, and the shadow images.", "",
             "    python -m shadowmap_dr.experiments.art.gallery", "",
             "makes all of it. [../art.md](../art.md) says how.", ""]  # fmt: skip
    for piece in pieces:
        ious = ", ".join(f"{view['iou']:.3f}" for view in records[piece.name]["views"])
        names = (*_SHOWN, *_shadow_images(piece))
        lines += [f"## {piece.title}", "", " ".join(f"![{name.split('.')[0]}]({piece.name}-{name})" for name in names), "",
                  f"    {_command(piece)}", "", f"Intersection over union with the target: {ious}.", ""]  # fmt: skip
    return lines


def _command(piece: Piece) -> str:
    words = ["shadowmap-dr art"]
    for name, value in piece.options.items():
        if name == "targets":
            words += [f"--text {v.removeprefix('text:')}" if v.startswith("text:") else f"--target {v}" for v in value]
        else:
            words.append(f"--{'copies' if name == 'most' else name} {value}")
    return " ".join(words)


def _shadow_images(piece: Piece) -> list[str]:
    """Names of a piece's shadow images."""
    return [f"shadow-{k + 1}.png" for k in range(len(piece.options["targets"]))]


def _sheet(path: Path, pictures: Sequence[Path], columns: int = 5, size: int = 256) -> None:
    """Write all still pictures side by side."""
    from PIL import Image

    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (size * min(columns, len(pictures)), size * rows), "white")
    for k, picture in enumerate(pictures):
        with Image.open(picture) as image:
            sheet.paste(image.convert("RGB").resize((size, size), Image.Resampling.LANCZOS),
                        (size * (k % columns), size * (k // columns)))  # fmt: skip
    with files.atomic(path) as temporary:
        sheet.save(temporary)


def main(arguments: Sequence[str] | None = None) -> None:
    description = (__doc__ or "").split("\n")[0]
    parser = argparse.ArgumentParser(prog="python -m shadowmap_dr.experiments.art.gallery", description=description)
    names = [piece.name for piece in PIECES]
    parser.add_argument("names", nargs="*", metavar="PIECE", help=f"pieces to make [all]: {', '.join(names)}")
    parser.add_argument("--work", type=Path, default=Path("art-gallery"), help="folder for all files of the pieces")
    parser.add_argument("--out", type=Path, default=Path("docs/gallery"), help="folder of the gallery")
    parser.add_argument("--results", type=Path, default=Path("docs/results/art.json"), help="JSON file for the numbers")
    parser.add_argument("--resume", action="store_true", help="keep finished pieces, resume a killed one")
    options = parser.parse_args(arguments)
    try:
        unknown = sorted(set(options.names) - set(names))
        if unknown:
            raise ShadowmapError(f"no piece {unknown[0]!r}: choose from {', '.join(names)}.{did_you_mean(unknown[0], names)}")
        mi.set_variant(DEFAULT_VARIANT)
        record = run_gallery(options.names or names, options.work, options.out, options.results, resume=options.resume)
    except ShadowmapError as error:
        sys.exit(f"error: {error}")
    print("\n".join(document(record)))


if __name__ == "__main__":
    main()
