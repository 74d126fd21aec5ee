"""The record of a run of pose estimation: its identity and its results."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ... import __version__
from ...errors import ShadowmapError, warn
from ...inverse import History, Method, optimize
from ...io import records
from ...io.machine import DRJIT_VERSION
from .methods import Image, fairness
from .scene import PoseProblem, ReferenceKind, pose_errors, start_pose
from .search import AWAY, EXPLAINED, TURN_DEG

RECOVERED_DEG, RECOVERED_X100 = 0.2, 0.3
TIME_TO_POSE_DEG = 0.1
# Steps whose mean loss stands for the end of a descent.
_LAST = 5


def identity(
    problem: PoseProblem, name: str, run: int, method: Method, *, seed: int, iterations: int, reference: ReferenceKind
) -> dict[str, Any]:
    """Entries of a run's record that are known before the run. Records that agree in them are of the same run."""
    return records.plain(
        {
            "object": problem.name,
            "resolution": problem.resolution,
            "method": name,
            "run": run,
            "seed": seed,
            "start": start_pose(seed, run),
            "iterations": iterations,
            "reference": reference,
            "variant": mi.variant(),
            "shadow_only": problem.shadow_only,
            "normals": problem.normals,
            "settings": {"object_digest": problem.digest, **method.describe(), **fairness(method, problem)},
        }
    )


def is_of(record: dict[str, Any], wanted: dict[str, Any]) -> bool:
    """True if a record is of the run with the identity ``wanted``."""
    environment = record.get("environment")
    # Records of earlier versions hold the variant elsewhere.
    older = {"variant": environment.get("variant")} if isinstance(environment, dict) else {}
    found = essence({**older, **record})
    return all(found.get(key) == value for key, value in essence(wanted).items())


def stored_records(path: Path) -> list[dict[str, Any]]:
    """Complete records in a file of an earlier call; a warning tells of others. A file without records is set aside."""
    try:
        found = runs_in(records.read_json(path))
    except ShadowmapError:
        found = None
    if found is None:
        records.set_aside(path)
        return []
    kept = [record for record in found if is_complete(record)]
    if len(kept) < len(found):
        warn(f"{path}: {len(found) - len(kept)} of {len(found)} records were edited or are damaged: their runs are made again.")
    return kept


def runs_in(content: Any) -> list[dict[str, Any]] | None:  # Any: JSON
    """The runs in the content of a `pose.json`, which is a list of them in earlier versions; None if it is something else."""
    runs = content.get("runs") if isinstance(content, dict) else content
    return runs if isinstance(runs, list) and all(isinstance(run, dict) for run in runs) else None


def is_complete(record: dict[str, Any]) -> bool:
    """True if a record has all results of its run, including the curves over the steps, with the right types and lengths."""
    numbers = ("rotation_error_deg", "translation_error_x100", "seconds_per_iteration", "seconds_to_pose", "seconds_total")
    known = ("resolution", "run", "seed", "iterations")
    if not all(isinstance(record.get(name), dict) for name in ("settings", "environment")):
        return False
    if not all(isinstance(record.get(name), str) for name in ("object", "method", "reference")):
        return False
    if not all(isinstance(record.get(name), int) for name in known) or not isinstance(record.get("recovered"), bool):
        return False
    steps = record["iterations"]
    # Records of earlier versions lack the curve of the seconds.
    timed = {"seconds_curve": steps} if "seconds_curve" in record else {}
    lengths = {
        **timed,
        **{"start": len(start_pose(0, 0)), "final": len(start_pose(0, 0)), "loss_curve": steps},
        **{"rotation_error_curve": steps + 1, "translation_error_curve": steps + 1},
    }
    return all(name in record and is_number(record[name]) for name in numbers) and all(
        isinstance(record.get(name), list) and len(record[name]) == length and all(map(is_number, record[name]))
        for name, length in lengths.items()
    )


def is_number(value: Any) -> bool:  # Any: JSON
    """True for numbers, and for None, which stands for numbers that are not finite."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def essence(value: Any) -> Any:  # Any: JSON
    """Settings without residuals, whose last digits depend on the number of threads, and without verdicts on fairness."""
    if isinstance(value, dict):
        left_out = ("fair", "meets_fair_criterion")
        return {k: essence(v) for k, v in value.items() if not (k in left_out or k.endswith("_residual"))}
    return [essence(entry) for entry in value] if isinstance(value, list) else value


def make_record(
    method: Method, reference: Image, wanted: dict[str, Any], checkpoint: Path | None, on_step: Callable[[int, int], None]
) -> dict[str, Any]:
    """Make the run with the identity ``wanted``. Returns its record.

    The run descends from its start, and from other rotations while its images differ from the reference by more than `EXPLAINED`
    allows and steps change the pose. The record has the results of the best descent, and all descents in ``tries``.

    Args:
        on_step: called with the numbers of finished descents and of finished steps of the next one.
    """
    without = _mean_square(method.render(AWAY), reference)
    histories: list[History] = []
    left: list[float] = []
    for number, start in enumerate(starts_of(wanted)):
        path = checkpoint if checkpoint is None or not number else checkpoint.with_stem(f"{checkpoint.stem}-try{number}")
        step = functools.partial(on_step, number)
        histories.append(optimize(method, start, wanted["iterations"], checkpoint=path, settings=essence(wanted), on_step=step))
        left.append(_left(histories[-1], without))
        if left[-1] <= EXPLAINED or np.array_equal(histories[-1].final, histories[-1].parameters[0]):
            break
    best = int(np.argmin(left))
    results = _results(histories[best])
    results["seconds_total"] = sum(history.seconds_total for history in histories)
    before = sum(history.seconds_total for history in histories[:best])
    results["seconds_to_pose"] = _later(results["seconds_to_pose"], before)
    results["seconds_curve"] = records.plain(before + np.cumsum(histories[best].seconds))
    tries = [
        {"start": history.parameters[0], "final": history.final, "unexplained": rest}
        for history, rest in zip(histories, left, strict=True)
    ]
    results |= records.plain({"unexplained": left[best], "without_object": without, "tries": tries})
    return {**wanted, **results, "environment": _environment()}


def starts_of(wanted: dict[str, Any]) -> list[npt.NDArray[np.float64]]:
    """Starts (3,) of the descents of a run with the identity ``wanted``, the run's own first."""
    # To both sides in turn, a turn farther after two.
    turns = [TURN_DEG * ((k + 1) // 2) * (1 if k % 2 else -1) for k in range(wanted["settings"].get("tries", 1))]
    return [np.asarray(wanted["start"], np.float64) + [np.radians(turn), 0, 0] for turn in turns]


def _left(history: History, without: float) -> float:
    """Share of the loss without the object that the last steps have left; infinite if the descent failed."""
    last = float(history.loss[-_LAST:].mean())
    if not (np.isfinite(last) and np.isfinite(history.final).all()):
        return float("inf")
    return last / without if without > 0 else 1.0


def _mean_square(image: Image, reference: Image) -> float:
    return float(np.mean(np.square(image - reference, dtype=np.float64)))


def _later(seconds: float | None, before: float) -> float | None:
    return None if seconds is None else seconds + before


def _results(history: History) -> dict[str, Any]:
    rotation, translation = pose_errors(history.parameters)
    found = bool(rotation[-1] < RECOVERED_DEG and translation[-1] < RECOVERED_X100)
    return records.plain(
        {
            "final": history.final,
            "rotation_error_deg": rotation[-1],
            "translation_error_x100": translation[-1],
            "recovered": found,
            "found": found,
            "seconds_per_iteration": history.seconds_per_iteration,
            "seconds_total": history.seconds_total,
            "seconds_to_pose": seconds_to_pose(rotation, history.seconds),
            "loss_curve": history.loss,
            "rotation_error_curve": rotation,
            "translation_error_curve": translation,
        }
    )


def seconds_to_pose(rotation_deg: npt.NDArray[np.float64], seconds: npt.NDArray[np.float64]) -> float | None:
    """Seconds until the rotation error is at most 0.1 degrees and stays there, None if it never does."""
    outside = np.flatnonzero(~(rotation_deg <= TIME_TO_POSE_DEG))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(seconds[:first].sum()) if first < len(rotation_deg) else None


def seconds_to_stay(record: Mapping[str, Any], times: npt.NDArray[np.float64]) -> tuple[float, int] | None:
    """Seconds and step from which on a run with a record is at the pose, within the bounds of a recovered one, to its end.

    ``times``: (N + 1,) seconds of the poses of its curves. None if the run does not end there.
    """
    rotation, offset = (np.array(record[name], np.float64) for name in ("rotation_error_curve", "translation_error_curve"))
    outside = np.flatnonzero(~((rotation < RECOVERED_DEG) & (offset < RECOVERED_X100)))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return (float(times[first]), first) if first < len(rotation) else None


def _environment() -> dict[str, Any]:
    return {
        "shadowmap_dr": __version__,
        "mitsuba": mi.__version__,
        "drjit": DRJIT_VERSION,
        "variant": mi.variant(),
        "threads": dr.thread_count(),
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }
