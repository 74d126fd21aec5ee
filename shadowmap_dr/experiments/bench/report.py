"""Output of the benchmark: its table, for the terminal and for documentation, and a plot.

``python -m shadowmap_dr.experiments.bench.report bench.json`` prints the table in Markdown.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

from rich.table import Table

from ...errors import ShadowmapError
from ...io import console, records
from . import plot as bench_plot
from . import sums as bench_sums
from .fits.score import summary as score_summary

plot = bench_plot.plot

#: Aims on two cores, by resolution.
STEP_MS = {128: 3.0, 512: 9.0, 1024: 30.0}
SHADOWS_OVER_NONE = {128: 3.0, 512: 1.6, 1024: 1.3}
OVER_MITSUBA = 100.0
OVER_EMBREE = {128: 3.0, 512: 3.0, 1024: 1.5, 2048: 1.5}
OVER_DRTK = {128: 4.0, 512: 10.0, 1024: 10.0}
WORST_CASE = 5.0
#: Linear growth, with tolerance for the fit to noisy times.
EXPONENT = 1.05
LARGE_MS, LARGE_GIB = 250.0, 3.0
#: Cores that other processes may use before times are marked as doubtful.
BUSY = 0.3
#: A first picture may take this multiple of Mitsuba's `direct` and these seconds more; a first backward pass, these seconds.
FIRST_OVER_DIRECT, FIRST_SECONDS, BACKWARD_SECONDS = 2.0, 0.5, 5.0
#: A first derivative from nothing over that of Mitsuba's `direct_projective`.
COLD_OVER_PROJECTIVE = 1.2
#: Percentage of starts from which the command `fit` solves its problems, its seconds, percentage of intervals that hold true
#: values, and how much wider than the error they may be.
FITS_SOLVED, FIT_SECONDS, FITS_COVERAGE, FITS_WIDTH = 90.0, 60.0, (85.0, 99.0), 4.0
#: Steps of the plug-in over the step of a frozen `Renderer` and Mitsuba's update.
PLUGIN_OVER_RENDERER = 1.3
#: A step through PyTorch over that of a frozen `Renderer`.
TORCH_OVER_RENDERER = 1.3
EIGHT_LIGHTS, BATCH, OUTSIDE_KERNELS = 4.5, 1.2, 0.10


@dataclass(frozen=True)
class Row:
    """A line of the table. `met`: True if the aim was reached, None without an aim."""

    what: str
    size: str
    ours: str
    other: str = ""
    ratio: str = ""
    aim: str = ""
    met: bool | None = None

    def cells(self) -> list[str]:
        mark = {True: " yes", False: " NO", None: ""}[self.met]
        return [self.what, self.size, self.ours, self.other, self.ratio, self.aim + mark]

    def plain(self) -> dict[str, Any]:
        return asdict(self)


COLUMNS = ["", "size", "ours", "other", "ratio", "aim"]


def rows(record: dict[str, Any]) -> list[Row]:
    """Rows of all measurements in a record, in the order of the sections."""
    makers = {
        "steps": _step_rows,
        "raster": _raster_rows,
        "scaling": _scaling_rows,
        "breakdown": _breakdown_rows,
        "sums": _sum_rows,
        "loops": _loop_rows,
        "first": _first_rows,
        "plug-in": _plugin_rows,
        "torch": _torch_rows,
        "fits": _fit_rows,
    }
    result: list[Row] = []
    for name, make in makers.items():
        units = record["sections"].get(name, {}).get("units", {})
        for key, unit in units.items():
            if "failed" in unit:
                result.append(Row(f"{name} {key}", "", "failed"))
            else:
                result += make(key, unit)
        if name == "fits" and units:
            result += _fit_summary_rows(units)
    return result


def table(record: dict[str, Any]) -> Table:
    """The table for the terminal."""
    lines = rows(record)
    result = console.table("Medians; ratios are those of medians", COLUMNS, [row.cells() for row in lines], wrapped=range(5))
    for row, following, line in zip(lines, lines[1:], result.rows, strict=False):
        line.end_section = row.what.split()[0] != following.what.split()[0]
    return result


def markdown(record: dict[str, Any]) -> str:
    """Markdown for documentation: machine and command, then the table."""
    machine = record["machine"]
    units = [unit for section in record["sections"].values() for unit in section["units"].values()]
    others = [unit["cores_used_by_others"] for unit in units if unit.get("cores_used_by_others") is not None]
    spread = f"; cores used by other work: {max(others):.1f} at most" if others else ""
    commands = ", ".join(f"`{text}`" for text in dict.fromkeys(section["command"] for section in record["sections"].values()))
    lines = [
        f"{commands} on {machine['processor']}, {machine['threads']} threads, {machine['variant']}; "
        f"shadowmap_dr {machine['shadowmap_dr']}, Mitsuba {machine['mitsuba']}, Dr.Jit {machine['drjit']}, "
        f"LLVM {machine['llvm']}{spread}.",
        "",
        "| " + " | ".join(COLUMNS) + " |",
        "|" + "---|" * len(COLUMNS),
    ]
    lines += ["| " + " | ".join(row.cells()) + " |" for row in rows(record)]
    return "\n".join(lines)


def outcome(unit: dict[str, Any]) -> str:
    """A unit in one line, for the log."""
    for name in ("failed", "skipped"):
        if name in unit:
            return f"{name}: {unit[name]}"
    parts = [f"{name} {_time(entry['median'])}" for name, entry in unit.get("seconds", {}).items() if isinstance(entry, dict)]
    others = unit.get("cores_used_by_others") or 0.0
    if others > BUSY:
        parts.append(f"(other work used {others:.1f} cores meanwhile: not to be trusted)")
    return ", ".join(parts) or f"{unit['wall_seconds']:.0f} s"


def _step_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    size, fair = unit["resolution"], unit["mitsuba"]["fair"]
    mitsuba = "Mitsuba" if fair else "Mitsuba (not shown to converge)"
    if key.startswith("pose"):
        yield from _pose_rows(unit, mitsuba)
        return
    ours, plain = (unit["seconds"][name]["median"] for name in ("shadows", "rasterizer"))
    aim = STEP_MS.get(size)
    yield Row("step with shadows", f"{size}", _time(ours), "", "", *_aim(ours * 1e3, aim, "<= {:g} ms", least=False))
    ratio = unit["ratio_of_medians"]
    value = ratio["shadows / rasterizer"]
    aims = _aim(value, SHADOWS_OVER_NONE.get(size), "<= {:g}x", least=False)
    yield Row("step with shadows", f"{size}", _time(ours), f"none {_time(plain)}", f"{value:.2f}x", *aims)
    if "mitsuba / shadows" in ratio:
        value, other = ratio["mitsuba / shadows"], unit["seconds"]["mitsuba"]["median"]
        text, met = _aim(value, OVER_MITSUBA if size in STEP_MS else None, ">= {:g}x", least=True)
        yield Row(
            "step with shadows", f"{size}", _time(ours), f"{mitsuba} {_time(other)}", f"{value:.0f}x", text, met if fair else None
        )
    elif unit["mitsuba"].get("left_out"):
        yield Row("step with shadows", f"{size}", _time(ours), f"{mitsuba} left out: {unit['mitsuba']['left_out']}")
    default = unit.get("mitsuba default", {})
    if "median" in default:
        value = default["median"] / ours
        yield Row("step with shadows", f"{size}", _time(ours), f"Mitsuba's default {_time(default['median'])}", f"{value:.0f}x")
    elif "failed" in default:
        yield Row("step with shadows", f"{size}", _time(ours), f"Mitsuba's default: {default['failed'][:40]}")


def _pose_rows(unit: dict[str, Any], mitsuba: str) -> Iterator[Row]:
    def shown(name: str) -> str:
        entry = unit["methods"].get(name)
        if entry is None:
            return "left out"
        median = entry["median_seconds_to_pose"]
        return f"{'never' if median is None else _time(median)} ({entry['reached']} of {entry['starts']})"

    value = unit["ratio_of_medians"].get("mitsuba / shadows")
    aims = _aim(value, OVER_MITSUBA, ">= {:g}x", least=True) if value else ("", None)
    cut = " cut" if unit["cut"]["mitsuba_starts_not_run"] or unit["cut"]["mitsuba_starts_cut_short"] else ""
    other, ratio = f"{mitsuba} {shown('mitsuba')}{cut}", f"{value:.0f}x" if value else ""
    yield Row("time to pose", f"{unit['resolution']}", shown("shadows"), other, ratio, *aims)
    yield Row("time to pose", f"{unit['resolution']}", shown("shadows"), f"none {shown('rasterizer')}")


def _raster_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    size, mesh = unit["resolution"], unit["mesh"]
    if "skipped" in unit:
        yield Row(f"rasterize {mesh}", f"{size}", unit["skipped"])
        return
    seconds = {name: entry["median"] for name, entry in unit["seconds"].items()}
    if key.startswith("full"):
        for name, value in seconds.items():
            ratio = unit.get("drtk_over_ours", {}).get(name)
            if ratio is None:
                yield Row(f"raster: {name}", f"{size}", _time(value))
                continue
            aim = OVER_DRTK.get(size) if name == "forward and backward" else (1.0 if name == "rasterize" else None)
            other = f"DRTK (quoted) {unit['drtk_ms'][name]:g} ms"
            yield Row(
                f"raster: {name}", f"{size}", _time(value), other, f"{ratio:.1f}x", *_aim(ratio, aim, ">= {:g}x", least=True)
            )
        return
    ratios = unit["ratio_of_medians"]
    embree = f"Embree {_time(seconds['embree update and trace'])}, trace {_time(seconds['embree trace'])}"
    value = ratios["embree update and trace / ours"]
    partner = next((name.split(" / ")[1] for name in ratios if name.startswith(f"{mesh} / ")), None)
    worst = partner is not None or mesh.startswith(("slivers", "screen-filling", "even"))
    aims = _aim(value, None if worst else OVER_EMBREE.get(size), ">= {:g}x", least=True)
    yield Row(f"rasterize {mesh}", f"{size}", _time(seconds["ours"]), embree, f"{value:.1f}x", *aims)
    if partner is not None:
        value = ratios[f"{mesh} / {partner}"]
        yield Row(
            f"rasterize {mesh}",
            f"{size}",
            _time(seconds["ours"]),
            partner,
            f"{value:.1f}x",
            *_aim(value, WORST_CASE, "<= {:g}x", least=False),
        )


def _scaling_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    if key == "large":
        if "seconds" not in unit:
            yield Row("largest step", unit["case"]["mesh"], f"failed: {unit['failed'][0]}")
            return
        case, ms = unit["case"], 1e3 * unit["seconds"]["median"]
        size, gib = f"{case['mesh']} at {case['resolution']}", unit["peak_memory"] / 2**30
        yield Row("largest step", size, f"{ms:.0f} ms", "", "", *_aim(ms, LARGE_MS, "<= {:g} ms", least=False))
        yield Row("largest step", size, f"{gib:.2f} GiB", "", "", *_aim(gib, LARGE_GIB, "<= {:g} GiB", least=False))
        return
    if key == "batch":
        for kind in ("raster", "sensors"):
            for count, value in unit[kind]["throughput_over_single_steps"].items():
                aim = BATCH if count == "32" and kind == "sensors" else None
                size = f"{count} of {unit['resolution']} x {unit['resolution']}"
                yield Row(
                    f"batch, {kind}",
                    size,
                    _time(unit[kind]["seconds"][count]["median"]),
                    "single steps",
                    f"{value:.2f}x",
                    *_aim(value, aim, ">= {:g}x", least=True),
                )
        return
    points = [point for point in unit["points"] if "seconds" in point]
    for point in points:
        yield Row(
            f"growth with {key}", f"{point['size']}", _time(point["seconds"]["median"]), f"{point['peak_memory'] / 2**30:.2f} GiB"
        )
    value, end = unit["exponent"], unit["exponent_of_the_last_two"]
    if value is not None:
        aims = _aim(value, EXPONENT if key in ("triangles", "resolution") else None, "<= {:g}", least=False)
        yield Row(f"growth with {key}", "exponent", f"{value:.2f}", f"last two {end:.2f}", "", *aims)
    if key != "lights":
        return
    own = str(unit["points"][0]["case"]["resolution"])
    for size, compared in {own: unit["in turns"], **unit.get("in turns, larger images", {})}.items():
        eight = compared["ratio_of_medians"].get("8 / 1")
        if eight is not None:
            yield Row("eight lights over one", size, "", "", f"{eight:.2f}x", *_aim(eight, EIGHT_LIGHTS, "<= {:g}x", least=False))


def _breakdown_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    size, what = f"{unit['resolution']}", "pass" if unit["method"] != "none" else "pass (no shadows)"
    for name in ("frozen", "not frozen"):
        entry = unit[name]
        share = entry["share_outside_kernels"]
        aim = OUTSIDE_KERNELS if name == "frozen" and unit["resolution"] == 128 else None
        aims = _aim(100 * share, None if aim is None else 100 * aim, "<= {:g} %", least=False)
        other = f"{entry['kernels']} kernels {_time(entry['seconds_in_kernels'])}"
        yield Row(
            f"all of a step{what[4:]}, {name}",
            size,
            _time(entry["seconds"]["median"]),
            other,
            f"{100 * share:.0f} % outside",
            *aims,
        )
    total = sum(entry["forward_seconds"] + entry["backward_seconds"] for entry in unit["passes"]) or 1.0
    for entry in unit["passes"]:
        both = entry["forward_seconds"] + entry["backward_seconds"]
        other = f"there {_time(entry['forward_seconds'])}, back {_time(entry['backward_seconds'])}"
        yield Row(f"{what}: {entry['pass']}", size, _time(both), other, f"{100 * both / total:.0f} %")


def _sum_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    for entry in unit["sums"]:
        size, off = f"{entry['size']}, {entry['spp']} spp", abs(entry["ratio"] - 1)
        aims = _aim(100 * off, 100 * bench_sums.TOLERANCE, "<= {:g} %", least=False)
        yield Row(f"sum: {key}", size, f"{100 * off:.3f} % off", entry["mode"], f"{entry['ratio']:.4f}x", *aims)


def _loop_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    size, seconds, errors = f"{unit['size']}", unit["seconds"], unit["errors"]
    left = {name: entry["last"] / entry["first"] for name, entry in errors.items()}
    titles = {"original": unit["original"]["type"], "sppi 0": f"{unit['original']['type']}, sppi 0"}
    for name, title in titles.items():
        if name not in seconds:
            continue
        value, ours = unit["ratio_of_medians"][f"{name} / ours"], _time(seconds["ours"]["median"])
        aims = _aim(value, 1.0, ">= {:g}x", least=True)
        yield Row(f"loop: {key}", size, ours, f"{title} {_time(seconds[name]['median'])}", f"{value:.2f}x", *aims)
        yield Row(f"loop: {key}, error left", size, f"{100 * left['ours']:.0f} %", f"{title} {100 * left[name]:.0f} %")
    if "later" in unit.get("memory", {}):
        memory = unit["memory"]
        grown = (memory["later"] - memory["settled"]) / 2**20
        yield Row(f"loop: {key}, {memory['steps']} steps", size, f"{grown:.0f} MiB more")


def _first_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    seconds = {name: entry["median"] for name, entry in unit["seconds"].items()}
    if unit.get("cold"):
        value = unit["ratio_of_medians"]["ours / direct_projective"]
        aims = _aim(value, COLD_OVER_PROJECTIVE, "<= {:g}x", least=False)
        other = f"direct_projective {_time(seconds['direct_projective'])}"
        yield Row("first derivative", key, _time(seconds["ours"]), other, f"{value:.2f}x", *aims)
        return
    ours, most = seconds["ours"], FIRST_OVER_DIRECT * seconds["direct"] + FIRST_SECONDS
    ratio = f"{unit['ratio_of_medians']['ours / direct']:.2f}x"
    aims = _aim(ours, most, f"<= {most:.2f} s", least=False)
    yield Row("first picture", key, _time(ours), f"direct {_time(seconds['direct'])}", ratio, *aims)
    aims = _aim(seconds["backward"], BACKWARD_SECONDS, "<= {:g} s", least=False)
    other = f"uncompiled {_time(unit['uncompiled']['backward'])}"
    yield Row("first derivative", key, _time(seconds["backward"]), other, "", *aims)


def _plugin_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    what, size = f"plug-in: {unit['title']}", f"{unit['resolution']}"
    seconds = {name: entry["median"] for name, entry in unit["seconds"].items()}
    other = f"frozen {_time(seconds['renderer'])} + update {_time(seconds['update'])}"
    value = unit["over_renderer_and_update"]
    aims = _aim(value, PLUGIN_OVER_RENDERER, "<= {:g}x", least=False)
    yield Row(what, size, _time(seconds["plug-in"]), other, f"{value:.2f}x", *aims)
    value = unit["ratio_of_medians"]["not recorded / plug-in"]
    yield Row(what, size, _time(seconds["plug-in"]), f"not recorded {_time(seconds['not recorded'])}", f"{value:.2f}x")


def _torch_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    seconds, value = unit["seconds"], unit["ratio_of_medians"]["torch / renderer"]
    aims = _aim(value, TORCH_OVER_RENDERER, "<= {:g}x", least=False)
    ours, other = _time(seconds["torch"]["median"]), f"frozen {_time(seconds['renderer']['median'])}"
    yield Row("PyTorch: vertices", f"{unit['resolution']}", ours, other, f"{value:.2f}x", *aims)


def _fit_rows(key: str, unit: dict[str, Any]) -> Iterator[Row]:
    solved, count = sum(one["solved"] for one in unit["starts"]), len(unit["starts"])
    yield Row(
        f"fit: {key}", f"{count} starts", _time(unit["seconds"]["fit"]["median"]), ", ".join(unit["vary"]), f"{solved} solved"
    )


def _fit_summary_rows(units: dict[str, dict[str, Any]]) -> Iterator[Row]:
    runs = [one for unit in units.values() for one in unit.get("starts", [])]
    if not runs:
        return
    total = score_summary(runs)
    size, seconds = f"{total['starts']} starts", total["seconds"]
    share = 100 * total["solved"] / total["starts"]
    yield Row("fits: solved", size, f"{share:.0f} %", "", "", *_aim(share, FITS_SOLVED, ">= {:g} %", least=True))
    longest = seconds["max"]
    aims = _aim(longest, FIT_SECONDS, "<= {:g} s", least=False)
    yield Row("fits: longest", size, _time(longest), f"median {_time(seconds['median'])}", "", *aims)
    wrong, other = total["false_found"], f"solved, but called not found {total['missed']}"
    yield Row("fits: called found, but not solved", size, f"{wrong}", other, "", *_aim(wrong, 0, "<= {:g}", least=False))
    if total["coverage"] is None:
        return
    (low, high), share, ratio = FITS_COVERAGE, 100 * total["coverage"], total["ratio"]
    size, aim = f"{total['intervals']} numbers", f"{low:g} to {high:g} %"
    yield Row("fits: intervals that hold the truth", size, f"{share:.0f} %", "", "", aim, low <= share <= high)
    aims = _aim(ratio, FITS_WIDTH, "<= {:g}", least=False)
    yield Row("fits: half-width over error", size, f"{ratio:.2g}", "", "", *aims)


def _aim(value: float, aim: float | None, form: str, *, least: bool) -> tuple[str, bool | None]:
    if aim is None:
        return "", None
    return form.format(aim), value >= aim if least else value <= aim


def _time(seconds: float) -> str:
    if seconds >= 999.5:
        return f"{seconds:.0f} s"  # 1234 s, not 1.23e+03
    if seconds >= 0.9995:
        return f"{seconds:.3g} s"
    return f"{1e3 * seconds:.3g} ms"


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit("usage: python -m shadowmap_dr.experiments.bench.report FILE.json")
    try:
        print(markdown(records.read_json(sys.argv[1])))
    except ShadowmapError as error:
        sys.exit(f"error: {error}")
    except (KeyError, TypeError, AttributeError):
        sys.exit(f"error: {os.fspath(sys.argv[1])} is no record of a benchmark.")


if __name__ == "__main__":
    main()
