"""Tables of shadow art."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from shadowmap_dr.experiments.art import gallery
from shadowmap_dr.io.console import markdown

from .records import Lines, record


def art() -> Lines:
    """Intersection over union by kinds of pieces."""
    pieces = record("art")["pieces"]

    def ious(*names: str) -> list[float]:
        return [view["iou"] for name in names for view in pieces[name]["views"]]

    def of_groups(*groups: str) -> list[float]:
        return ious(*(name for name, piece in pieces.items() if piece["group"] in groups))

    def row(label: str, values: Sequence[float], note: str = "") -> list[str]:
        return [label, f"{np.mean(values):.3f}", f"{min(values):.3f}" if len(values) > 1 else "", note]

    remeshed = [f"{name}-remeshed" for name in gallery.WHOLE]
    horse = f"{ious('horse-remeshed')[0]:.3f} with `--remesh 100`"
    return markdown(
        ["", "mean", "least", ""],
        [
            row("one view: airplane, heart, elephant, hand", ious(*gallery.WHOLE), "400 steps"),
            row("the same with `--remesh 100`", ious(*remeshed)),
            row("horse, whose legs are 4 pixels wide", ious("horse"), horse),
            row("two views: six pairs of these four targets, and the letters L and M", of_groups("two views"), "400 steps"),
            row("perspective camera; wavy receiver; both", ious("perspective", "wavy", "wavy-perspective")),
            row("collections: 128 teapots as an elephant, 32 cows as a heart", of_groups("collection"), "1100 steps"),
        ],
    )


def holes() -> Lines:
    """Targets with holes."""
    labels = {
        "cat": "cat",
        "rabbit": "rabbit",
        "duck": "duck (its eye becomes a hole)",
        "kettle": "kettle (its handle and its highlight become holes)",
    }
    pieces = record("art")["pieces"]
    rows = [[label, *(f"{pieces[name]['views'][0][key]:.3f}" for key in ("iou", "iou_filled"))] for name, label in labels.items()]
    return markdown(["", "IoU", "with the target's holes filled"], rows)
