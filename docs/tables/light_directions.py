"""Tables of directions of lights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from shadowmap_dr.io.console import markdown

from .records import Lines, record


def light_directions() -> Lines:
    """Alignment for all settings."""
    rows = [
        [
            *(str(entry["lights"]), _filter(entry)),
            f"{entry['alignment_mean']:.4f}",
            f"{entry['alignment_std']:.3f}",
            f"{entry['alignment_least']:.3f}",
            f"{100 * entry['share_from_0.995']:.1f} %",
        ]
        for entry in record("lights")["summaries"]
    ]
    return markdown(["n", "shadows", "alignment", "deviation", "least", "at least 0.995"], rows)


def _filter(entry: Mapping[str, Any]) -> str:
    name = {"gaussian": "Gaussian", "wendland": "Wendland"}.get(entry["filter"], entry["filter"])
    size = entry["filter_size"]
    parts = [{0: "none", 1: "unfiltered"}.get(size, f"{name} {size}")]
    parts += [f"`--strategy {entry['strategy']}`"] if entry["strategy"] != "plain" else []
    parts += [f"path-traced targets ({entry['spp']} samples)"] if entry["reference"] == "mitsuba" else []
    return ", ".join(parts)


def light_directions_by_filter() -> Lines:
    """Alignment by the number of lights and the size of the filter."""
    found = {
        (entry["lights"], entry["filter_size"]): entry
        for entry in record("lights")["summaries"]
        if (entry["filter"], entry["strategy"], entry["reference"]) == ("gaussian", "plain", "own") and entry["filter_size"]
    }
    sizes = sorted({size for _, size in found})
    rows = [
        [str(n), *(f"{e['alignment_mean']:.4f} ({100 * e['share_from_0.995']:.0f} %)" for e in (found[n, s] for s in sizes))]
        for n in sorted({n for n, _ in found})
    ]
    return markdown(["n", *("unfiltered" if size == 1 else str(size) for size in sizes)], rows)


def light_times() -> Lines:
    """Milliseconds of a step for each run."""
    labels = {
        "batch of 150": "batch of 150",
        "batch of 16": "batch of 16",
        "batch of 1": "batch of 1",
        "reverse": "*reverse*: a frozen single run through ordinary maps with derivatives backwards, G-buffer reused",
        "renderer": "*renderer*: the frozen step of a user who calls `Renderer.render`",
    }
    steps = record("lights-times")["steps"]
    ratios = {"batch of 150": 1.0} | {key.partition(" / ")[0]: value for key, value in steps["ratio_of_medians"].items()}
    rows = [[label, f"{1e3 * steps['seconds'][name]['median']:.2f}", f"{ratios[name]:.2f}"] for name, label in labels.items()]
    return markdown(["way", "ms", "/ batch of 150"], rows)
