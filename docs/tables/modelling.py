"""The table of modelling by painting."""

from __future__ import annotations

import numpy as np

from shadowmap_dr.io.console import markdown

from .records import Lines, record


def modelling() -> Lines:
    """Delays and rates of the page."""
    found = record("model")
    delays = {name: 1e3 * np.array(values) for name, values in found["delay_seconds"].items()}
    count = len(delays["first"])
    first, half = delays["first"], delays["half"]
    rows = [
        ["steps a second while painting without a pause", f"{found['steps_per_second']:.0f}"],
        ["frames a second in the browser meanwhile", f"{found['frames_per_second']:.0f}"],
        [
            "from pressing the button until the mesh has moved by a pixel",
            f"{np.median(first):.0f} ms (median of {count} strokes), {max(first):.0f} ms at most",
        ],
        [
            "until it has moved half as far as the stroke goes",
            f"{np.median(half):.0f} ms (median), {max(half):.0f} ms at most",
        ],
    ]
    return markdown(["", ""], rows)
