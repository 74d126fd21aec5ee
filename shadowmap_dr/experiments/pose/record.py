"""The record of a run of pose estimation: its identity and its results."""

from __future__ import annotations

import os
from collections.abc import Callable
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
from .methods import fairness
from .scene import PoseProblem, ReferenceKind, pose_errors, start_pose

RECOVERED_DEG, RECOVERED_X100 = 0.2, 0.3
TIME_TO_POSE_DEG = 0.1


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
    lengths = {
        **{"start": len(start_pose(0, 0)), "final": len(start_pose(0, 0)), "loss_curve": steps},
        **{"rotation_error_curve": steps + 1, "translation_error_curve": steps + 1},
    }
    return all(name in record and _is_number(record[name]) for name in numbers) and all(
        isinstance(record.get(name), list) and len(record[name]) == length and all(map(_is_number, record[name]))
        for name, length in lengths.items()
    )


def _is_number(value: Any) -> bool:  # Any: JSON
    """True for numbers, and for None, which stands for numbers that are not finite."""
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def essence(value: Any) -> Any:  # Any: JSON
    """Settings without residuals, whose last digits depend on the number of threads, and without verdicts on fairness."""
    if isinstance(value, dict):
        left_out = ("fair", "meets_fair_criterion")
        return {k: essence(v) for k, v in value.items() if not (k in left_out or k.endswith("_residual"))}
    return [essence(entry) for entry in value] if isinstance(value, list) else value


def make_record(
    method: Method, wanted: dict[str, Any], checkpoint: Path | None, on_step: Callable[[int], None]
) -> dict[str, Any]:
    """Make the run with the identity ``wanted``. Returns its record."""
    iterations, start = wanted["iterations"], wanted["start"]
    history = optimize(method, start, iterations, checkpoint=checkpoint, settings=essence(wanted), on_step=on_step)
    return {**wanted, **_results(history), "environment": _environment()}


def _results(history: History) -> dict[str, Any]:
    rotation, translation = pose_errors(history.parameters)
    return records.plain(
        {
            "final": history.final,
            "rotation_error_deg": rotation[-1],
            "translation_error_x100": translation[-1],
            "recovered": bool(rotation[-1] < RECOVERED_DEG and translation[-1] < RECOVERED_X100),
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


def _environment() -> dict[str, Any]:
    return {
        "shadowmap_dr": __version__,
        "mitsuba": mi.__version__,
        "drjit": DRJIT_VERSION,
        "variant": mi.variant(),
        "threads": dr.thread_count(),
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }
