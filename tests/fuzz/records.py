"""Records and checkpoints of experiments, edited, cut or foreign, given to the functions that resume from them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, cast

import mitsuba as mi
import numpy as np
from fake_problems import Bowls
from rich.console import Console

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.art import gallery
from shadowmap_dr.experiments.bench import experiment as bench
from shadowmap_dr.experiments.bench import report as bench_report
from shadowmap_dr.experiments.bench.common import BenchOptions
from shadowmap_dr.experiments.lights import experiment as lights
from shadowmap_dr.experiments.pose import table
from shadowmap_dr.experiments.pose.record import stored_records
from shadowmap_dr.inverse.runs.loop import Method, optimize
from shadowmap_dr.inverse.runs.sweep import run_sweep
from shadowmap_dr.io import records
from shadowmap_dr.io.files import read_arrays

from .outcome import check
from .values import chance, changed_arrays, changed_json, mutated, npz, pick

_FOREIGN = (
    b"",
    b"{",
    b"[]",
    b"3",
    b'"text"',
    b"null",
    b'{"a": 1}',
    b'[{"a": []}]',
    b"\x00",
    b"[" * 50_000,
    b"\xff\xfe{",
    b"NaN",
    b"{}" * 9,
)

_POSE: dict[str, Any] = {
    **{"object": "spot", "method": "shadows", "reference": "own", "resolution": 8, "run": 0, "seed": 0, "iterations": 2},
    **{"settings": {}, "environment": {}, "start": [0, 0, 0], "final": [0, None, 0], "recovered": False},
    **{"rotation_error_deg": 1.0, "translation_error_x100": 1.0, "seconds_per_iteration": None, "shadow_only": False},
    **{"seconds_to_pose": None, "seconds_total": 1.0, "loss_curve": [1, 1], "normals": "face"},
    **{"rotation_error_curve": [1, 1, 1], "translation_error_curve": [1, 1, 1]},
}
_LIGHTS: dict[str, Any] = {
    **{"setting": "a", "lights": 1, "filter": "box", "filter_size": 3, "cone_deg": 60.0, "strategy": "plain", "starts": 1},
    **{"reference": "own", "objects": ["spot"], "runs": 1, "alignment_mean": 1.0, "alignment_std": 0.0, "alignment_least": 1.0},
    **{"share_from_0.995": 1.0, "curve_iterations": [0], "curve_mean": [1.0], "curve_std": [0.0]},
}


def run(rng: np.random.Generator, folder: Path) -> str:
    """Edit a record, and read it."""
    return pick(
        rng, (_pose, _lights, _bench, _gallery, _plain, _table, _sweep, _sweep, _checkpoint, _checkpoint, _art_checkpoint)
    )(rng, folder)


def _write(rng: np.random.Generator, path: Path, value: Any) -> bool:
    """Write a record, most times with faults. Returns True if it has none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if chance(rng, 0.1):
        path.write_text(json.dumps(value))
        return True
    if chance(rng, 0.15):
        path.write_bytes(pick(rng, _FOREIGN))
    elif chance(rng, 0.3):
        path.write_bytes(mutated(rng, json.dumps(value).encode()))
    else:
        path.write_text(json.dumps(changed_json(rng, value)))
    return False


def _pose(rng: np.random.Generator, folder: Path) -> str:
    sound = _write(rng, folder / "pose.json", [_POSE, {**_POSE, "run": 1}])
    found = stored_records(folder / "pose.json")
    check(not sound or len(found) == 2, f"{len(found)} of 2 records were read")
    return f"{len(found)} records"


def _lights(rng: np.random.Generator, folder: Path) -> str:
    sound = _write(rng, folder / "lights.json", {"summaries": [_LIGHTS, {**_LIGHTS, "setting": "b"}]})
    found = lights._stored(folder / "lights.json")
    check(not sound or len(found) == 2, f"{len(found)} of 2 summaries were read")
    return f"{len(found)} summaries"


def _bench(rng: np.random.Generator, folder: Path) -> str:
    unit = {"seconds": {name: {"median": 1.0, "q1": 1.0, "q3": 1.0} for name in ("shadows", "rasterizer")}, "resolution": 128}
    unit |= {"mitsuba": {"fair": True}, "ratio_of_medians": {"shadows / rasterizer": 1.0}}
    options = BenchOptions(out=folder / "bench.json", resume=chance(rng, 0.7))
    bench._write(options, {"format": bench.FORMAT, "sections": {"steps": {"units": {"step-128": unit}, "settings": {}}}})
    written = json.loads(options.out.read_text())
    if chance(rng, 0.5):
        del written["checks"]
    sound = _write(rng, options.out, written)
    found = bench._stored(options)
    made = bench_report.rows(found)
    check(not sound or len(made) == 2, f"{len(made)} of 2 rows")
    return f"{len(found['sections'])} sections"


def _gallery(rng: np.random.Generator, folder: Path) -> str:
    view = {"iou": 0.9}
    _write(
        rng, folder / "art.json", {"settings": {}, "views": [view], "mesh": {"inverted_triangles": 0}, "iou_curve": [[0, [0.9]]]}
    )
    return f"finished: {gallery._is_finished(folder / 'art.json')}"


def _plain(rng: np.random.Generator, folder: Path) -> str:
    """A record with digests."""
    path = folder / "record.json"
    record = {"settings": {"side": 8}, "runs": {"a": {"loss": 1.0}, "b": {"loss": [1, 2, None]}}}
    records.write_record(path, record, "runs")
    sound = _write(rng, path, json.loads(path.read_text()))
    fresh = {"settings": {"side": 8}, "runs": {}}
    found = records.read_record(path, fresh, {"runs": ("loss",)})
    check(found["settings"] == fresh["settings"] and isinstance(found["runs"], dict), "other settings")
    for key, entry in found["runs"].items():
        check(isinstance(entry, dict), f"the entry {key!r} is {entry!r}")
    check(not sound or len(found["runs"]) == 2, "entries are lost")
    return f"{len(found['runs'])} runs"


def _table(rng: np.random.Generator, folder: Path) -> str:
    """A list of records of poses, or a table made of it."""
    path = folder / "pose.json"
    path.write_text(json.dumps([_POSE, {**_POSE, "run": 1}]))
    try:
        made = table.rows(table.read([path]))
        value = {"rows": [row.plain() for row in made]} if chance(rng, 0.5) else [_POSE, {**_POSE, "run": 1}]
    except ShadowmapError:
        value = [_POSE]
    _write(rng, path, value)
    found = table.rows(table.read([path]))
    table.document(found)
    return f"{len(found)} rows"


def _sweep(rng: np.random.Generator, folder: Path) -> str:
    """Files of batches."""
    problem, quiet = Bowls(3, steps=10), Console(quiet=True)
    first = run_sweep([problem], folder, variant=mi.variant(), console=quiet)
    for path in sorted((folder / "batches").glob("*.json")):
        if chance(rng, 0.7):
            value = json.loads(path.read_text())
            if chance(rng, 0.4):
                value.pop("check")
            _write(rng, path, value)
    if chance(rng, 0.3):
        (folder / "batches" / pick(rng, ("x.json", "bowls-.json", "bowls-0-1.json", "bowls.checkpoint.npz"))).write_bytes(
            pick(rng, _FOREIGN)
        )
    again = run_sweep([problem], folder, variant=mi.variant(), resume=True, console=quiet)
    check(len(again["bowls"]) == len(first["bowls"]) == 3, f"{len(again['bowls'])} of 3 runs")
    return "3 runs"


class _Bowl:
    """Method that goes half the way to 1 in each step."""

    def __init__(self) -> None:
        self._now = np.zeros(2)

    def reset(self, start: Any) -> None:
        self._now = np.array(start, np.float64)

    def step(self) -> Any:
        self._now = 0.5 * (self._now + 1)
        return np.array([float(np.square(self._now - 1).sum())])

    def parameters(self) -> Any:
        return self._now.copy()

    def state(self) -> dict[str, Any]:
        return {"now": self._now}

    def load_state(self, state: Any) -> None:
        self._now = np.asarray(state["now"], np.float64).reshape(2).copy()


def _checkpoint(rng: np.random.Generator, folder: Path) -> str:
    path = folder / "a.checkpoint.npz"
    optimize(cast(Method, _Bowl()), [0.0, 0.0], 10, checkpoint=path)
    arrays = read_arrays(path)
    data = path.read_bytes()
    sound = chance(rng, 0.1)
    if not sound:
        path.write_bytes(mutated(rng, data) if chance(rng, 0.3) else npz(changed_arrays(rng, arrays)))
    history = optimize(cast(Method, _Bowl()), [0.0, 0.0], 20, checkpoint=path)
    check(history.parameters.shape == (21, 2) and history.loss.shape == (20,), f"{history.parameters.shape} parameters")
    check(history.seconds.shape == history.warm.shape == (20,), "times of other lengths")
    check(np.isfinite(history.final).all(), "final parameters are not finite")
    if sound:
        check(np.allclose(history.final, 1, atol=1e-5), f"the end is {history.final}")
    return f"{history.iterations} steps"


def _art_checkpoint(rng: np.random.Generator, folder: Path) -> str:
    from shadowmap_dr.experiments.art import run as art_run

    path = folder / "checkpoint.npz"
    frames = [art_run.Frame(step, np.zeros((4, 3), np.float32), np.array([[0, 1, 2]], np.uint32)) for step in (0, 50)]
    trace = art_run.Trace([1.0] * 50, [0.1] * 50, [True] * 50)
    trace.looks, trace.frames = [(0, [0.5]), (50, [0.6])], frames
    art_run._save(path, "x", trace, {"a": np.zeros(3)})
    arrays = read_arrays(path)
    path.write_bytes(mutated(rng, path.read_bytes()) if chance(rng, 0.3) else npz(changed_arrays(rng, arrays)))
    found, state = art_run._load(path, "x")
    check(all(frame.vertices.ndim == 2 and frame.faces.ndim == 2 for frame in found.frames), "frames of other shapes")
    check(
        all(frame.faces.size == 0 or frame.faces.max() < len(frame.vertices) for frame in found.frames), "faces without vertices"
    )
    check(len(found.loss) == len(found.seconds) == len(found.warm), "curves of different lengths")
    return f"{len(found.frames)} frames, {len(state)} arrays"
