"""Benchmark: time of an optimisation step, and time to find a pose, of this library and of Mitsuba's own integrator."""

from __future__ import annotations

import functools
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...inverse import Method
from ...io import assets, images
from ...jit.memory import physical_memory
from ..common.timing import Contender, alternate, compare, timed
from ..pose.methods import BETAS, METHODS, STEP_SIZE, build_method
from ..pose.record import seconds_to_pose
from ..pose.scene import PoseProblem, make_problem, path_traced_reference, pose_errors, start_pose
from .common import BenchOptions, Unit, Update, run_child

if TYPE_CHECKING:
    from mitsuba_baselines.pose import MitsubaPose

OBJECT = "spot"
#: Memory of Mitsuba's integrator for each sample that is alive at the same time (bytes, roughly).
BYTES_PER_SAMPLE = 60
SEED = 0
RATIOS = (("mitsuba", "shadows"), ("mitsuba", "rasterizer"), ("shadows", "rasterizer"))

Image = npt.NDArray[np.float32]


def units(options: BenchOptions) -> list[Unit]:
    """Steps of each resolution, then the times to pose."""
    kinds: dict[str, Callable[..., dict[str, Any]]] = {"step": measure_steps, "pose": measure_poses}
    return [
        Unit(f"{kind}-{resolution}", functools.partial(measure, options, resolution))
        for kind, measure in kinds.items()
        for resolution in options.what.resolutions
    ]


def measure_steps(options: BenchOptions, resolution: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Step times at a resolution: ours with and without shadows, Mitsuba's at its fair setting and at its default.

    The default runs in a process of its own, which may run out of memory at large images.
    """
    what = options.what
    problem, reference, path = _problem(options, resolution, update)
    methods, left_out = _methods(problem, reference)
    contenders = {}
    for name, method in methods.items():
        method.reset(start_pose(SEED, 0))
        if name == "mitsuba":
            contenders[name] = Contender(
                method.step, what.mitsuba_rounds, warm_up=1, settle=0, burst=1, seconds=options.mitsuba_seconds / 2
            )
        else:
            contenders[name] = Contender(method.step, what.rounds)
    samples = alternate(contenders, update)
    result = {
        "resolution": resolution,
        **compare(samples, RATIOS),
        "mitsuba": _setting(methods.get("mitsuba"), resolution, left_out),
    }
    result["recordings"] = {name: methods[name].recordings() for name in methods if name != "mitsuba"}
    steps = what.default_steps.get(resolution, 0)
    if steps:
        update(0, 1, "Mitsuba's default setting")
        arguments = {"resolution": resolution, "reference": str(path), "steps": steps}
        default = run_child("bench.steps:default_steps", arguments, options.mitsuba_seconds)
        if default.get("seconds"):
            # The first step compiles: it counts only if there is no other.
            median = statistics.median(default["seconds"][1:] or default["seconds"])
            ours = result["seconds"]["shadows"]["median"]
            default |= {"median": median, "ratio_of_medians": {"mitsuba default / shadows": median / ours}}
        result["mitsuba default"] = default
    return result


def default_steps(resolution: int, reference: str, steps: int, emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Seconds of the first steps of Mitsuba's integrator with its default sample counts and guiding."""
    from mitsuba_baselines.pose import MitsubaPose, ProjectiveSetting

    setting = ProjectiveSetting(16, 16, 16, "octree", 16)
    scene, mesh = assets.scene("pose"), assets.mesh(OBJECT)
    method = MitsubaPose(scene, mesh, resolution, setting, images.read_image(reference), step_size=STEP_SIZE, betas=BETAS)
    method.reset(start_pose(SEED, 0))
    seconds: list[float] = []
    result = {"setting": asdict(setting), "seconds": seconds}
    for _ in range(steps + 1):
        seconds.append(timed(method.step))
        emit(result)
    return result


def measure_poses(options: BenchOptions, resolution: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Seconds until the rotation error is at most 0.1 degrees and stays there, from several starts, methods in turns."""
    what = options.what
    problem, reference, _ = _problem(options, resolution, update)
    methods, left_out = _methods(problem, reference)
    for name, method in methods.items():
        method.reset(start_pose(SEED, 0))
        for _ in range(1 if name == "mitsuba" else 3):
            timed(method.step)
    left = options.mitsuba_seconds
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in methods}
    not_run: list[int] = []
    for run in range(what.starts):
        for k, (name, method) in enumerate(methods.items()):
            if name == "mitsuba" and left <= 0:
                not_run.append(run)
                continue
            began = time.perf_counter()
            note = functools.partial(_note, update, (run * len(methods) + k, what.starts * len(methods)), name, what.iterations)
            limit = left if name == "mitsuba" else float("inf")
            runs[name].append(_fit(method, run, what.iterations, limit, note))
            if name == "mitsuba":
                left -= time.perf_counter() - began
    result: dict[str, Any] = {
        "resolution": resolution,
        "reference": "path-traced" if what.path_traced else "own",
        "iterations": what.iterations,
        "mitsuba": _setting(methods.get("mitsuba"), resolution, left_out),
        "methods": {name: {**_times(entries), "runs": entries} for name, entries in runs.items()},
        "cut": {
            "mitsuba_seconds": options.mitsuba_seconds,
            "mitsuba_starts_not_run": not_run,
            "mitsuba_starts_cut_short": [entry["run"] for entry in runs.get("mitsuba", ()) if entry["cut_short"]],
        },
    }
    if left_out:
        result["cut"]["mitsuba_starts_not_run"] = list(range(what.starts))
    medians = {name: entry["median_seconds_to_pose"] for name, entry in result["methods"].items()}
    result["ratio_of_medians"] = {f"{a} / {b}": medians[a] / medians[b] for a, b in RATIOS if medians.get(a) and medians.get(b)}
    return result


def _fit(method: Method, run: int, iterations: int, limit: float, note: Callable[[int], None]) -> dict[str, Any]:
    start = start_pose(SEED, run)
    method.reset(start)
    parameters: list[Any] = [start]
    seconds: list[float] = []
    while len(seconds) < iterations and sum(seconds) < limit:
        seconds.append(timed(method.step))
        parameters.append(method.parameters())  # read back at the end, so that steps do not wait for it
        note(len(seconds))
    rotation, offset = pose_errors([np.asarray(entry, np.float64) for entry in parameters])
    cut = len(seconds) < iterations
    return {
        "run": run,
        "start": start,
        "final": np.asarray(parameters[-1], np.float64),
        "rotation_error_deg": rotation[-1],
        "translation_error_x100": offset[-1],
        "iterations": len(seconds),
        "seconds_total": sum(seconds),
        # In a run that was cut short, the error might have grown again.
        "seconds_to_pose": None if cut else seconds_to_pose(rotation, np.array(seconds)),
        "cut_short": cut,
    }


def _note(update: Update, position: tuple[int, int], name: str, iterations: int, step: int) -> None:
    update(*position, f"{name} {step}/{iterations}")


def _times(entries: list[dict[str, Any]]) -> dict[str, Any]:
    reached = [entry["seconds_to_pose"] for entry in entries if entry["seconds_to_pose"] is not None]
    return {
        "reached": len(reached),
        "starts": len(entries),
        "median_seconds_to_pose": statistics.median(reached) if reached else None,
    }


def _setting(method: MitsubaPose | None, resolution: int, left_out: str | None) -> dict[str, Any]:
    from mitsuba_baselines.fair_settings import fair_setting, is_fair

    setting = fair_setting(resolution)
    result = {"setting": asdict(setting), "fair": is_fair(setting, resolution)}
    return {**result, "left_out": left_out} if method is None else {**result, "proxy": method.proxy.record()}


def _methods(problem: PoseProblem, reference: Image) -> tuple[dict[str, Any], str | None]:
    """All methods, without Mitsuba's if its samples do not fit into memory, and the reason for leaving it out."""
    from mitsuba_baselines.fair_settings import fair_setting

    setting = fair_setting(problem.resolution)
    samples = max(setting.spp, setting.sppc, setting.sppp, setting.sppi) * problem.resolution**2
    names, left_out = list(METHODS), None
    if samples * BYTES_PER_SAMPLE > physical_memory() / 2:
        names.remove("mitsuba")
        left_out = f"{samples / 1e6:.0f} million samples at once do not fit into the memory"
    return {name: build_method(name, problem, reference) for name in names}, left_out


def _problem(options: BenchOptions, resolution: int, update: Update) -> tuple[PoseProblem, Image, Path]:
    """The pose problem, its reference image, and the image's file."""
    update(0, 1, "reference image")
    problem = make_problem(OBJECT, resolution, work=options.work)
    if options.what.path_traced:
        path = options.work / f"reference-{OBJECT}-{resolution}.exr"
        return problem, path_traced_reference(problem, path), path
    path = options.work / f"reference-own-{OBJECT}-{resolution}.exr"
    blank = np.zeros((resolution, resolution, 3), np.float32)
    method = build_method("shadows", problem, blank)
    image = method.render(np.zeros(3))
    if not np.isfinite(image).all():
        raise ShadowmapError(f"the reference image of {OBJECT} at {resolution} pixels is not finite.")
    images.write_image(path, image)
    return problem, image, path
