"""Plot of the benchmark: growth of costs, beside Embree's, and the passes of a step."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from ...io import plot_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LABELS = {
    "triangles": "triangles",
    "resolution": "pixels",
    "map_resolution": "texels of the shadow map",
    "filter_size": "filter size [texels]",
    "lights": "directional lights",
}
_BLUE, _RED = plot_style.COLOURS[:2]
#: Markers of the meshes that are drawn beside the curves of rasterization.
_ODD = {"slivers": "x", "even": "+", "screen-filling": "v"}


def plot(path: str | os.PathLike[str], record: dict[str, Any]) -> None:
    """Draw a panel for each measurement of the record. Times are medians, bars their quartiles."""
    sections = {name: _complete(section["units"]) for name, section in record["sections"].items()}
    scaling, raster = sections.get("scaling", {}), sections.get("raster", {})
    panels: list[Any] = [(_series, scaling[name]) for name in _LABELS if name in scaling]
    if "batch" in scaling:
        panels.append((_batch, scaling["batch"]))
    rasters = [unit for unit in raster.values() if "embree trace" in unit.get("seconds", {})]
    if rasters:
        panels.append((_raster, rasters))
    steps = [unit for key, unit in sections.get("steps", {}).items() if key.startswith("step")]
    if steps:
        panels.append((_steps, steps))
    for unit in sections.get("breakdown", {}).values():
        if unit["method"] != "none":
            panels.append((_passes, unit))
    columns = min(3, max(1, len(panels)))
    rows = max(1, -(-len(panels) // columns))
    with plot_style.drawn(path, 5.2 * columns, 3.4 * rows if panels else 1.0, dpi=110) as figure:
        for k, (draw, data) in enumerate(panels):
            draw(figure.add_subplot(rows, columns, k + 1), data)
        measured = "Points: medians. Bars: from the lower to the upper quartile."
        plot_style.caption(figure, measured if panels else f"The sections measured have tables only: {', '.join(sections)}.")


def _complete(units: dict[str, Any]) -> dict[str, Any]:
    return {key: unit for key, unit in units.items() if "failed" not in unit and "skipped" not in unit}


def _series(axes: Axes, unit: dict[str, Any]) -> None:
    points = [point for point in unit["points"] if "seconds" in point]
    sizes = [point["size"] for point in points]
    _curve(axes, sizes, [point["seconds"] for point in points], _BLUE)
    exponent = unit["exponent"]
    axes.set_title("" if exponent is None else f"time grows with the power {exponent:.2f}")
    _logarithmic(axes, _LABELS[unit["quantity"]], "time of a step [ms]")
    axes.yaxis.label.set_color(_BLUE)
    _ticks(axes, sizes)
    memory = axes.twinx()
    memory.plot(sizes, [point["peak_memory"] / 2**30 for point in points], "s--", color=_RED, markersize=3, linewidth=1)
    memory.set_ylabel("peak memory [GiB]", color=_RED)
    memory.set_ylim(bottom=0)
    memory.grid(False)
    memory.spines["right"].set_visible(True)


def _batch(axes: Axes, unit: dict[str, Any]) -> None:
    ends = []
    for k, (kind, label) in enumerate((("raster", "raster\nfunctions"), ("sensors", "sensors"))):
        values = unit[kind]["images_per_second"]
        axes.plot(
            [int(count) for count in values], list(values.values()), marker=plot_style.marker(k), color=plot_style.colour(k)
        )
        ends.append((list(values.values())[-1], label, plot_style.colour(k)))
    _logarithmic(axes, f"images of {unit['resolution']} x {unit['resolution']} in a step", "throughput [images / s]")
    _ticks(axes, unit["batches"])
    plot_style.label_ends(axes, ends)


def _raster(axes: Axes, units: list[dict[str, Any]]) -> None:
    ends = []
    for k, resolution in enumerate(sorted({unit["resolution"] for unit in units})):
        tint = plot_style.colour(k)
        own = sorted((unit for unit in units if unit["resolution"] == resolution), key=lambda unit: unit["triangles"])
        for unit in own:
            if marker := _marker(unit):
                axes.plot(unit["triangles"], 1e3 * unit["seconds"]["ours"]["median"], marker, color=tint, markersize=5)
        own = [unit for unit in own if not _marker(unit)]
        sizes = [unit["triangles"] for unit in own]
        _curve(axes, sizes, [unit["seconds"]["ours"] for unit in own], tint)
        embree = [1e3 * unit["seconds"]["embree update and trace"]["median"] for unit in own]
        axes.plot(sizes, embree, ":", color=tint)
        if own:
            ends.append((1e3 * own[-1]["seconds"]["ours"]["median"], f"{resolution} pixels", tint))
    axes.set_title("dotted: Embree; ours for slivers x, even +, screen-filling v", fontsize=9)
    _logarithmic(axes, "triangles", "rasterization [ms]")
    plot_style.label_ends(axes, ends)


def _marker(unit: dict[str, Any]) -> str | None:
    return _ODD.get(unit["mesh"].rsplit("-", 1)[0])


def _steps(axes: Axes, units: list[dict[str, Any]]) -> None:
    ends = []
    for k, (name, label) in enumerate((("shadows", "with shadows"), ("rasterizer", "without"), ("mitsuba", "Mitsuba"))):
        own = [unit for unit in units if name in unit["seconds"]]
        _curve(axes, [unit["resolution"] for unit in own], [unit["seconds"][name] for unit in own], plot_style.colour(k))
        if own:
            ends.append((1e3 * own[-1]["seconds"][name]["median"], label, plot_style.colour(k)))
    default = [unit for unit in units if "median" in unit.get("mitsuba default", {})]
    medians = [1e3 * unit["mitsuba default"]["median"] for unit in default]
    axes.plot([unit["resolution"] for unit in default], medians, "o-", color=plot_style.colour(3))
    if default:
        ends.append((medians[-1], "Mitsuba's\ndefault", plot_style.colour(3)))
    _logarithmic(axes, "image width [pixels]", "time of a step [ms]")
    _ticks(axes, [unit["resolution"] for unit in units])
    plot_style.label_ends(axes, ends)


def _passes(axes: Axes, unit: dict[str, Any]) -> None:
    passes = unit["passes"][::-1]
    names = [entry["pass"] for entry in passes]
    forward, backward = ([1e3 * entry[f"{way}_seconds"] for entry in passes] for way in ("forward", "backward"))
    axes.barh(names, forward, color=_BLUE, label="forward")
    axes.barh(names, backward, left=forward, color=_RED, label="backward")
    axes.set_xlabel("time in kernels [ms]")
    axes.set_title(f"passes of a step, {unit['resolution']} x {unit['resolution']} pixels")
    axes.tick_params(axis="y", labelsize=7.5)
    axes.grid(False, axis="y")
    axes.legend()


def _curve(axes: Axes, sizes: list[float], seconds: list[dict[str, float]], colour: str) -> None:
    medians = [1e3 * entry["median"] for entry in seconds]
    spread = [[1e3 * (e["median"] - e["q1"]) for e in seconds], [1e3 * (e["q3"] - e["median"]) for e in seconds]]
    axes.errorbar(sizes, medians, yerr=spread, fmt="o-", color=colour, capsize=2)


def _logarithmic(axes: Axes, x_label: str, y_label: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)


def _ticks(axes: Axes, values: list[float]) -> None:
    """Set ticks at the points only."""
    short = [f"{v / 1e6:.3g}M" if v >= 1e6 else f"{v / 1e3:.3g}k" if v >= 1e4 else f"{v:g}" for v in values]
    axes.set_xticks(values, short, fontsize=8)
    axes.set_xticks([], minor=True)
