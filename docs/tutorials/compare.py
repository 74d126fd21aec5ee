"""How long the notebooks' problems take with `shadowmap` and with Mitsuba's `direct_projective`.

    python docs/tutorials/compare.py --search    finds the cheapest sample counts with which Mitsuba solves each problem
    python docs/tutorials/compare.py             measures all methods in turns, Mitsuba's with these counts

Both take their scenes, loops and errors from the notebooks, so that only the integrator differs. A problem counts as solved when
the mean errors of ten steps in a row are within its bar; the time is that of the last of the ten. Records go to
docs/results/tutorials.json, which also tells a search that was cut short what it need not measure again, and a plot beside it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any, TypeAlias

import drjit as dr
import numpy as np
from notebooks import HERE, run
from rich.console import Console

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.common import timing
from shadowmap_dr.io import plot_style
from shadowmap_dr.io.console import progress, table
from shadowmap_dr.io.records import read_json, write_json
from shadowmap_dr.jit import gc

OUT = HERE.parent / "results" / "tutorials.json"
# Steps in a row whose mean error decides.
WINDOW = 10
# Seconds after which it is another method's turn.
TURN = 2.0
WARM_UP = 2
# Ours: the faster loop, the loop of all integrators with the plug-in's parameter `recorded`, and without.
METHODS = ("shadowmap, frozen", "shadowmap, recorded", "shadowmap", "direct_projective")
# The second and the third where the notebook's batch sensor shows all views together. Mitsuba's projective integrators cannot
# look through one.
ONE_CALL = ("shadowmap, recorded, one call", "shadowmap, one call")
# sppc, sppp, sppi, samples of the image in the loss, and the guiding if there is any.
Counts: TypeAlias = tuple[int, int, int, int] | tuple[int, int, int, int, str]


@dataclass(frozen=True)
class Problem:
    """A notebook and what counts as its solution.

    bar         largest errors, as the notebook's `error` names them
    steps       after which a method has failed
    candidates  of Mitsuba's settings, the cheapest step first
    parameters  of the notebook that differ from its own
    """

    bar: Mapping[str, float]
    steps: int
    candidates: tuple[Counts, ...]
    parameters: Mapping[str, Any] = field(default_factory=dict)


PROBLEMS = {
    "pose": Problem(
        {"degrees": 0.2, "100 x offset": 1.0},
        200,
        ((1, 1, 1, 1), (1, 1, 1, 4), (1, 1, 1, 16), (2, 2, 2, 16), (4, 4, 4, 16), (8, 8, 8, 64), (16, 16, 16, 64)),
    ),
    "shape": Problem(
        {"100 x Chamfer": 5.0},
        200,
        ((1, 1, 0, 1), (1, 1, 0, 4), (1, 1, 1, 4), (2, 2, 0, 16), (4, 4, 0, 16), (4, 4, 4, 16), (16, 16, 16, 64)),
        # Small pictures and steps: a search takes Mitsuba's integrator long enough.
        {"resolution": 96, "rate": 0.02},
    ),
    "curve": Problem(
        {"RMSE in %": 3.0},
        200,
        (
            (0, 0, 1, 1),
            (0, 0, 1, 4),
            (0, 0, 2, 4),
            (0, 0, 4, 16),
            (0, 0, 16, 16),
            (0, 0, 64, 64),
            (0, 0, 256, 64),
            (0, 0, 16, 16, "grid"),
            (0, 0, 64, 64, "grid"),
            (0, 0, 256, 64, "grid"),
            (0, 0, 1024, 64),
        ),  # fmt: skip
    ),
}


@dataclass
class Trace:
    """Seconds of each step, the state after it, and what errors these states have."""

    seconds: list[float] = field(default_factory=list)
    states: list[np.ndarray] = field(default_factory=list)
    errors: list[dict[str, float]] = field(default_factory=list)

    def advance(self, steps: Iterator[Any], error: Callable[[Any], dict[str, float]]) -> bool:
        """One step; False if there is none left. Only the step is timed."""
        began = time.perf_counter()
        state = next(steps, None)
        dr.sync_thread()
        if state is None:
            return False
        self.seconds.append(time.perf_counter() - began)
        self.states.append(np.array(state))
        self.errors.append({name: float(value) for name, value in error(self.states[-1]).items()})
        return True

    def within(self, bar: Mapping[str, float]) -> bool:
        """Whether the last steps solve a problem."""
        return len(self.errors) >= WINDOW and all(
            np.mean([errors[name] for errors in self.errors[-WINDOW:]]) <= most for name, most in bar.items()
        )

    def record(self, bar: Mapping[str, float]) -> dict[str, Any]:
        """As JSON values. `seconds` is None where the problem is not solved."""
        solved = self.within(bar)
        return {
            "solved": solved,
            "steps": len(self.seconds),
            "seconds": sum(self.seconds) if solved else None,
            "seconds_per_step": float(np.median(self.seconds[1:] or self.seconds)),
            "first_step_seconds": self.seconds[0],
            "last_errors": {name: float(np.mean([e[name] for e in self.errors[-WINDOW:]])) for name in self.errors[-1]},
        }


def load(name: str, image_samples: int, **parameters: Any) -> dict[str, Any]:
    """The definitions of a notebook."""
    return run(HERE / f"{name}.ipynb", skip={"run"}, image_samples=image_samples, **parameters)


def projective(counts: Counts) -> dict[str, Any]:
    """Mitsuba's integrator with sample counts."""
    sppc, sppp, sppi, _, *guiding = counts
    return {"type": "direct_projective", "sppc": sppc, "sppp": sppp, "sppi": sppi, "guiding": guiding[0] if guiding else "none"}


def search(
    name: str,
    problem: Problem,
    record: dict[str, Any],
    seeds: int,
    save: Callable[[], None],
    on_step: Callable[[str], None] = lambda note: None,
) -> None:
    """Run candidates, cheapest first, until one solves the problem with all seeds. Extends `record["search"]`."""
    tried = record.setdefault("search", [])
    for counts in problem.candidates:
        known = {entry["seed"]: entry["solved"] for entry in tried if tuple(entry["counts"]) == counts}
        if all(known.values()) and len(known) < seeds:
            names = load(name, counts[3], **problem.parameters)
            for seed in range(seeds):
                if seed in known:
                    continue
                trace = Trace()
                steps = names["optimise"](projective(counts), problem.steps, seed=seed)
                while trace.advance(steps, names["error"]) and not trace.within(problem.bar):
                    on_step(f"{counts} seed {seed}: " + _errors(trace))
                known[seed] = trace.within(problem.bar)
                tried.append({"counts": list(counts), "seed": seed, **trace.record(problem.bar), "load": timing.load()})
                save()
                if not known[seed]:
                    break
        if len(known) >= seeds and all(known.values()):
            record["fair"] = list(counts)
            save()
            return
    record["fair"] = None
    save()


def counts_for_race(name: str, record: dict[str, Any]) -> Counts:
    """The fair sample counts; where a search has found none, those that solved the problem with most seeds, the cheapest of them.

    A method with the latter would have to start again now and then: what is measured is the least that it takes.
    """
    if record.get("fair"):
        return tuple(record["fair"])
    solved: dict[Counts, int] = {}
    for entry in record.get("search", ()):
        counts = tuple(entry["counts"])
        solved[counts] = solved.get(counts, 0) + entry["solved"]
    if not any(solved.values()):
        raise ShadowmapError(f"no setting is known that solves {name!r}: run with --search first.")
    return max(solved, key=lambda counts: solved[counts])


def race(
    name: str, problem: Problem, fair: Counts, on_step: Callable[[str], None] = lambda note: None, **parameters: Any
) -> dict[str, Any]:
    """All methods in turns, from the same start until each has solved the problem or has used up its steps."""
    names = load(name, fair[3], **{**problem.parameters, **parameters})
    ours, theirs = names["integrator"], projective(fair)
    methods = (*(ONE_CALL if "together" in names else ()), *METHODS)

    def start(method: str, steps: int) -> Iterator[Any]:
        if method == "direct_projective":
            return names["optimise"](theirs, steps)
        if method == "shadowmap, frozen":
            return names["optimise_frozen"](ours, steps)
        views = {"views": names["together"]} if method in ONE_CALL else {}
        return names["optimise"]({**ours, "recorded": "recorded" in method}, steps, **views)

    traces = {method: Trace() for method in methods}
    other = timing.OtherWork()
    with gc.gc_quiet():
        for method in methods:  # compiles kernels
            for _ in islice(start(method, WARM_UP), WARM_UP):
                on_step(f"{method}: warm-up")
        running = {method: start(method, problem.steps) for method in methods}
        while running:
            for method in list(running):
                trace, began = traces[method], sum(traces[method].seconds)
                while sum(trace.seconds) - began < TURN:
                    more = trace.advance(running[method], names["error"])
                    on_step(f"{method}: " + _errors(trace))
                    if not more or trace.within(problem.bar):
                        del running[method]
                        break
    records = {method: trace.record(problem.bar) for method, trace in traces.items()}
    for method, trace in traces.items():
        records[method] |= {"errors": trace.errors, "seconds_of_steps": trace.seconds}
    taken = {method: entry["seconds"] for method, entry in records.items()}
    ratios = {m: taken["direct_projective"] / taken[m] for m in methods[:-1] if taken["direct_projective"] and taken[m]}
    return {
        "bar": dict(problem.bar), "counts": list(fair), "integrator": ours, "methods": records, "times_faster": ratios,
        "load": timing.load(), "cores_of_others": other.cores(), "machine": timing.machine(),
    }  # fmt: skip


def plot(path: Path, records: Mapping[str, Any]) -> None:
    """Error over seconds, a panel for each problem that was measured."""
    shown = {name: record["race"] for name, record in records.items() if "race" in record}
    colours = {method: plot_style.colour(k) for k, method in enumerate((*METHODS, *ONE_CALL))}
    with plot_style.drawn(path, 5.4 * len(shown), 3.6, dpi=100) as figure:
        for axes, (name, result) in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown.items(), strict=True):
            measure, bar = next(iter(result["bar"].items()))
            ends = []
            for method, entry in result["methods"].items():
                seconds, errors = np.cumsum(entry["seconds_of_steps"]), [e[measure] for e in entry["errors"]]
                axes.loglog(seconds, errors, color=colours[method])
                axes.plot(seconds[-1], errors[-1], color=colours[method], marker="o")
                ends.append((seconds[-1], errors[-1], method, colours[method]))
            axes.axhline(bar, color=plot_style.GREY, linewidth=1, linestyle=":")
            axes.set(title=name, xlabel="time [s]", ylabel=f"error [{measure.removeprefix('RMSE in ')}]")
            # In the order of the ends of the lines, the slowest method uppermost.
            top = axes.get_ylim()[1]
            plot_style.label_ends(axes, [(top, method, tint) for _, _, method, tint in sorted(ends)])
        plot_style.caption(figure, "Dotted: the bar. Dots: ends of the runs; labels in their order, the first one lowest.")


def _errors(trace: Trace) -> str:
    return ", ".join(f"{name} {value:.2f}" for name, value in (trace.errors or [{}])[-1].items())


def _rows(records: Mapping[str, Any]) -> list[tuple[str, ...]]:
    rows = []
    for name, record in records.items():
        for method, entry in record.get("race", {}).get("methods", {}).items():
            seconds = "not solved" if entry["seconds"] is None else f"{entry['seconds']:.2f} s"
            faster = record["race"]["times_faster"].get(method)
            found = ", ".join(f"{value:.3g}" for value in entry["last_errors"].values())
            rows.append((name, method, str(entry["steps"]), f"{1e3 * entry['seconds_per_step']:.0f} ms", seconds, found,
                         "" if faster is None else f"{faster:.1f}x"))  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("problems", nargs="*", help=f"of {', '.join(PROBLEMS)}; default: all")
    parser.add_argument("--search", action="store_true", help="find Mitsuba's fair sample counts instead of measuring")
    parser.add_argument("--seeds", type=int, default=3, help="with which a candidate must succeed")
    parser.add_argument("--out", type=Path, default=OUT, help="JSON file; the plot lies beside it")
    options = parser.parse_args()
    unknown = [name for name in options.problems if name not in PROBLEMS]
    if unknown:
        parser.error(f"no problem {unknown[0]!r}: choose from {', '.join(PROBLEMS)}")
    records = read_json(options.out) if options.out.is_file() else {}

    console = Console()
    with progress(console) as bars:
        for name in options.problems or PROBLEMS:
            record = records.setdefault(name, {})
            task = bars.add_task(name, total=None, note="")

            def on_step(note: str, task: Any = task) -> None:
                bars.update(task, advance=1, note=note)

            if options.search:
                search(name, PROBLEMS[name], record, options.seeds, lambda: write_json(options.out, records), on_step)
                continue
            record["race"] = race(name, PROBLEMS[name], counts_for_race(name, record), on_step)
            write_json(options.out, records)
            plot(options.out.with_suffix(".png"), records)
    console.print(table("until solved", ("problem", "method", "steps", "a step", "time", "errors", "faster"), _rows(records)))


if __name__ == "__main__":
    main()
