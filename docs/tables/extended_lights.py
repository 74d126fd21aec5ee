"""Tables of area lights and skies."""

from __future__ import annotations

from shadowmap_dr.experiments.soft import report as soft
from shadowmap_dr.io.console import markdown

from .records import Lines, record


def extended_lights() -> Lines:
    """All scenes."""
    return markdown(*soft.rows(record("soft")))


def extended_lights_in_short() -> Lines:
    """Errors of some scenes."""
    labels = {
        "desk": "a lamp over a desk",
        "lantern": "a shining ball in the middle of a scene",
        "overcast": "overcast sky",
        "sunny": "sky with a small, bright sun",
    }
    found = record("soft")
    columns = [f"{a} / {b}" for a, b in found["settings"]["samples"]]
    rows = [
        [label, *(f"{100 * error['error']:.1f} %" for error in found["scenes"][name]["errors"])] for name, label in labels.items()
    ]
    return markdown(["scene", *columns], rows)


def brightness() -> Lines:
    """Lamps without shadows: the largest deviation of all distances."""
    rows = []
    for name, entries in record("lamp_brightness")["lamps"].items():
        bias = max((entry["bias"] for entry in entries.values()), key=abs)
        rows.append([name, f"{100 * bias:+.1f} %", f"{100 * max(entry['error'] for entry in entries.values()):.1f} %"])
    return markdown(["lamp", "bias", "error"], rows)
