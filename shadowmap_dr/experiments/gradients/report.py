"""Report of the experiment on derivative images: a plot, tables, and a summary of the numbers."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.table import Table

from ...io import console, plot_style
from ...io.console import markdown

#: Aims for derivative images: least cosine, and bounds of the scale.
OWN, TRACED = (0.98, 0.97, 1.03), (0.95, 0.95, 1.05)
REVERSE, TESSELLATION = 1e-4, 0.02
_KINDS = {
    "own": ("own differences", OWN),
    "traced": ("path-traced differences", TRACED),
    "traced_blurred": ("path-traced, blurred like the map", TRACED),
}


def plot_agreement(path: str | os.PathLike[str], record: Mapping[str, Any]) -> None:
    """Plot scale and 1 - cosine over map sizes: a line for each filter, a column for each reference; means over motions."""
    entries = [e for e in _compared(record) if e["candidate"] == _first_candidate(record)]
    with plot_style.drawn(path, 13, 6.8, dpi=110) as figure:
        for j, (kind, (title, (least, low, high))) in enumerate(_KINDS.items()):
            for i, (quantity, label) in enumerate((("scale", "scale s (1: exact)"), ("cosine", "1 - cosine c (0: exact)"))):
                axes, ends = figure.add_subplot(2, 3, 1 + j + 3 * i), []
                every: set[int] = set()
                for k, taps in enumerate(sorted({e["filter"] for e in entries})):
                    sizes = sorted({e["map"] for e in entries if e["filter"] == taps})
                    means = [np.mean([e[kind][quantity] for e in entries if (e["filter"], e["map"]) == (taps, n)]) for n in sizes]
                    values = means if quantity == "scale" else [1 - m for m in means]
                    axes.plot(sizes, values, color=plot_style.colour(k), marker=plot_style.marker(k))
                    ends.append((float(values[-1]), f"filter {taps}" if taps > 1 else "no filter", plot_style.colour(k)))
                    every.update(sizes)
                for bound in (low, high) if quantity == "scale" else (1 - least,):
                    axes.axhline(bound, color=plot_style.GREY, linestyle=":")
                axes.set_xscale("log", base=2)
                axes.set_xticks(sorted(every), [str(size) for size in sorted(every)])
                if quantity == "cosine":
                    axes.set_yscale("log")
                axes.set(xlabel="texels along each side of the map", ylabel=label, title=title if i == 0 else "")
                if j == len(_KINDS) - 1:
                    plot_style.label_ends(axes, ends)
        plot_style.caption(figure, "Points: means over the motions across the light. Dotted: aims.")


def _compared(record: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Entries of motions across the light."""
    return [entry for entry in record["entries"].values() if "own" in entry]


def _first_candidate(record: Mapping[str, Any]) -> str:
    return next(iter(record["entries"].values()))["candidate"]


def jacobian_rows(record: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows: for each candidate, map and filter the worst cosine and scale over the motions."""
    columns = ["map, filter", "own c", "s", "traced c", "s", "blurred c", "s", "reverse"]
    groups: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for entry in _compared(record):
        groups.setdefault((entry["candidate"], entry["map"], entry["filter"]), []).append(entry)
    rows = []
    order = list(dict.fromkeys(label for label, _, _ in groups))
    named = order != ["default"]
    for (label, size, taps), entries in sorted(groups.items(), key=lambda item: (order.index(item[0][0]), *item[0][1:])):
        cells = []
        for kind in _KINDS:
            farthest = max((e[kind]["scale"] for e in entries), key=lambda scale: abs(scale - 1))
            cells += [f"{min(e[kind]['cosine'] for e in entries):.3f}", f"{farthest:.3f}"]
        reverse = max(e["reverse_error"] for e in entries)
        rows.append([f"{f'{label}, ' * named}{size}, {taps if taps > 1 else 'none'}", *cells, f"{reverse:.0e}"])
    return columns, rows


def jacobian_table(record: Mapping[str, Any]) -> Table:
    """The table for the terminal."""
    return console.table("Derivative images: worst cosine c and scale s over all motions", *jacobian_rows(record))


def read_jacobian(record: Mapping[str, Any]) -> str:
    """Report in Markdown: tables and their summary."""
    lines = ["# Derivative images of a shadow", ""]
    s = record["settings"]
    motions = ", ".join(sorted({e["motion"] for e in record["entries"].values()}))
    lines += [
        f"Occluder of {s['faces']} faces, image of {s['resolution']} x {s['resolution']} pixels, "
        f"path-traced with {s['spp']} samples. Motions: {motions}.",
        "",
    ]
    lines += markdown(*jacobian_rows(record)) + [""]
    entries = _compared(record)
    for label in dict.fromkeys(e["candidate"] for e in entries):
        own = [e for e in entries if e["candidate"] == label]
        lines.append(f"**{label}**: " + "; ".join(_reading_of(own, kind) for kind in _KINDS) + "." + _blur(own))
    lines.append("")
    lines += _along_light(record) + _noise(record) + _mitsuba(record) + _tessellation(record)
    worst = max((e["reverse_error"] for e in record["entries"].values()), default=0.0)
    lines.append(f"Reverse mode agrees with forward mode to {worst:.1e} ({_verdict(worst <= REVERSE, f'{REVERSE:.0e}')}).")
    return "\n".join(lines) + "\n"


def _reading_of(entries: Sequence[Mapping[str, Any]], kind: str) -> str:
    title, bounds = _KINDS[kind]
    least, low, high = bounds
    good = [e for e in entries if _reaches(e[kind], bounds)]
    cosines, scales = ([e[kind][q] for e in entries] for q in ("cosine", "scale"))
    text = (
        f"against {title} {len(good)} of {len(entries)} reach c >= {least} and s in [{low}, {high}] "
        f"(c from {min(cosines):.3f}, s {min(scales):.3f} to {max(scales):.3f})"
    )
    bad = [e for e in entries if e not in good]
    if not bad:
        return text
    worst = min(bad, key=lambda e: e[kind]["cosine"] - abs(1 - e[kind]["scale"]))
    return text + (
        f", worst {worst['motion']} at {worst['map']} texels, filter {worst['filter']}: "
        f"{worst[kind]['cosine']:.3f}, {worst[kind]['scale']:.3f}"
    )


def _reaches(found: Mapping[str, float], bounds: tuple[float, float, float]) -> bool:
    least, low, high = bounds
    return found["cosine"] >= least and low <= found["scale"] <= high


def _blur(entries: Sequence[Mapping[str, Any]]) -> str:
    """A sentence on the part of the deviation from path tracing that the map's blur explains."""
    missed = [e for e in entries if "blur" in e and not _reaches(e["traced"], TRACED)]
    if not missed:
        return ""
    alike = sum(not _reaches(e["blur"], TRACED) for e in missed)
    gains = [abs(e["blur"]["scale"] - 1) - abs(e["traced"]["scale"] - 1) for e in missed]
    return (
        f" Of the {len(missed)} that miss path-traced differences, path-traced images with the map's blur miss them in "
        f"{alike}, too; scales are nearer to 1 than theirs by up to {max(0.0, *gains):.3f}, "
        f"farther from it by up to {max(0.0, *(-gain for gain in gains)):.3f}."
    )


def _along_light(record: Mapping[str, Any]) -> list[str]:
    entries = [e for e in record["entries"].values() if "relative_norm" in e]
    if not entries:
        return []
    names = sorted({e["motion"] for e in entries})
    norms = [record["references"][name].get("norm") for name in names if name in record["references"]]
    low, high = min(e["relative_norm"] for e in entries), max(e["relative_norm"] for e in entries)
    return [
        f"Motion along the light ({', '.join(names)}) moves no shadow: path-traced differences have the norm "
        f"{max(norms or [0.0]):.3g}, so that there is nothing to compare with. Ours have {low:.1e} to {high:.1e} of the norm "
        "for the same motion across the light.",
        "",
    ]


def _noise(record: Mapping[str, Any]) -> list[str]:
    halves = [r["halves_cosine"] for r in record["references"].values() if r.get("halves_cosine") is not None]
    return [f"Independent halves of the path-traced references agree to c >= {min(halves):.4f}.", ""] if halves else []


def _mitsuba(record: Mapping[str, Any]) -> list[str]:
    if not record["mitsuba"]:
        return []
    first = next(iter(record["mitsuba"].values()))
    lines = [
        f"Mitsuba's projective integrator, area light with a penumbra of {first['penumbra_px']:.0f} pixels, "
        f"{first['resolution']} x {first['resolution']} pixels, {first['passes']} x {first['sppi']} samples:",
        "",
    ]
    rows = [
        [
            name,
            *(f"{r[key][q]:.3f}" for key in ("agreement_directional", "agreement_area") for q in ("cosine", "scale")),
            f"{r['halves_cosine']:.3f}",
        ]
        for name, r in record["mitsuba"].items()
    ]
    return lines + markdown(["motion", "c, parallel light", "s", "c, same area light", "s", "c of its halves"], rows) + [""]


def _tessellation(record: Mapping[str, Any]) -> list[str]:
    if not record["tessellation"]:
        return []
    worst = {key: max(r[key] for r in record["tessellation"].values()) for key in ("image_change", "gradient_change")}
    return [
        "Dividing each triangle into 64 changes the gradient of a squared difference by at most "
        f"{worst['gradient_change']:.1e} ({_verdict(worst['gradient_change'] < TESSELLATION, f'{TESSELLATION:.0%}')}), "
        f"the derivative image by {worst['image_change']:.1e} of its norm.",
        "",
    ]


def _verdict(reached: bool, limit: str) -> str:
    return f"limit {limit}: {'reached' if reached else 'not reached'}"
