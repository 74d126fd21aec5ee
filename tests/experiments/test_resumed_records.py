"""Files of earlier calls that were edited, cut, or written by others: one warning, and the runs are made again."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import pytest
from fake_problems import Bowls
from rich.console import Console

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.art import gallery
from shadowmap_dr.experiments.bench import experiment as bench
from shadowmap_dr.experiments.bench.common import BenchOptions
from shadowmap_dr.experiments.faces import experiment as faces
from shadowmap_dr.experiments.faces.experiment import FaceOptions
from shadowmap_dr.experiments.faces.problem import default_model
from shadowmap_dr.experiments.gradients import convergence
from shadowmap_dr.experiments.gradients.convergence import ConvergenceOptions
from shadowmap_dr.experiments.lights import experiment as lights
from shadowmap_dr.experiments.pose.record import stored_records
from shadowmap_dr.inverse import run_sweep

FOREIGN = ["", "{", "[", "3", '"text"', "null", '{"a": 1}', "[1, 2]", '[{"a": []}]', "\x00", "[" * 50_000]

POSE: dict[str, Any] = {
    **{"object": "spot", "method": "shadows", "reference": "own", "resolution": 8, "run": 0, "seed": 0, "iterations": 2},
    **{"settings": {}, "environment": {}, "start": [0, 0, 0], "final": [0, None, 0], "recovered": False},
    **{"rotation_error_deg": 1.0, "translation_error_x100": 1.0, "seconds_per_iteration": None},
    **{"seconds_to_pose": None, "seconds_total": 1.0, "loss_curve": [1, 1]},
    **{"rotation_error_curve": [1, 1, 1], "translation_error_curve": [1, 1, 1]},
}

LIGHTS: dict[str, Any] = {
    **{"setting": "a", "lights": 1, "filter": "box", "filter_size": 3, "cone_deg": 60.0, "strategy": "plain", "starts": 1},
    **{"reference": "own", "objects": ["spot"], "runs": 1, "alignment_mean": 1.0, "alignment_std": 0.0, "alignment_least": 1.0},
    **{"share_from_0.995": 1.0, "curve_iterations": [0], "curve_mean": [1.0], "curve_std": [0.0]},
}


def _warned(path: Path, content: str, read: Any) -> Any:
    path.write_text(content)
    with pytest.warns(UserWarning, match=path.name) as caught:
        result = read()
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    return result


@pytest.mark.parametrize("content", FOREIGN)
def test_foreign_files_are_set_aside(tmp_path: Path, content: str) -> None:
    path = tmp_path / "a.json"
    options = BenchOptions(out=path, resume=True)
    assert _warned(path, content, lambda: stored_records(path)) == []
    assert _warned(path, content, lambda: lights._stored(path)) == []
    assert _warned(path, content, lambda: bench._stored(options)) == {"sections": {}}
    assert _warned(path, content, lambda: gallery._is_finished(path)) is False
    path.write_text(content)
    with pytest.raises(ShadowmapError, match=r"a\.json is no record of a benchmark"):
        bench._stored(BenchOptions(out=path))
    assert path.read_text() == content


@pytest.mark.parametrize("name", sorted(POSE))
@pytest.mark.parametrize("value", ["", [], {}, [None, "x"], {"x": 1}])
def test_edited_records_of_poses_are_made_again(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "pose.json"
    edited = {**POSE, name: value}
    if isinstance(value, type(POSE[name])) and not isinstance(value, list):
        pytest.skip("of the right type")
    assert _warned(path, json.dumps([POSE, edited]), lambda: stored_records(path)) == [POSE]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        path.write_text(json.dumps([POSE]))
        assert stored_records(path) == [POSE]


@pytest.mark.parametrize("name", ["setting", "objects", "runs", "curve_mean", "alignment_mean", "cone_deg"])
@pytest.mark.parametrize("value", [None, {}, [None]])
def test_edited_summaries_of_lights_are_left_out(tmp_path: Path, name: str, value: object) -> None:
    path = tmp_path / "lights.json"
    content = json.dumps({"summaries": [LIGHTS, {**LIGHTS, name: value}]})
    assert _warned(path, content, lambda: lights._stored(path)) == [LIGHTS]


@pytest.mark.parametrize("checked", [True, False])
@pytest.mark.parametrize(
    "unit", [{}, {"resolution": 8}, {"resolution": 8, "seconds": {"shadows": {"median": None}}}, {"failed": 3, "x": 1}]
)
def test_edited_sections_of_benchmarks_are_measured_again(tmp_path: Path, unit: dict[str, Any], checked: bool) -> None:
    path = tmp_path / "bench.json"
    options = BenchOptions(out=path, resume=True)
    sound = {"units": {"step-8": {"failed": "it was too large"}}, "settings": {}}
    bench._write(options, {"format": bench.FORMAT, "sections": {"steps": sound, "raster": sound}})
    record = json.loads(path.read_text())
    assert bench._stored(options)["sections"] == {"steps": sound, "raster": sound}
    record["sections"]["steps"]["units"]["step-8"] = unit
    if not checked:
        del record["checks"]
    edited = checked or "failed" not in unit
    if edited:
        assert _warned(path, json.dumps(record), lambda: bench._stored(options))["sections"] == {"raster": sound}


def test_batches_without_a_digest_are_made_again(tmp_path: Path) -> None:
    problem = Bowls(2, steps=10)
    runs = {"variant": "llvm_ad_rgb", "console": Console(quiet=True)}
    made = run_sweep([problem], tmp_path, **runs)
    (path,) = (tmp_path / "batches").glob("*.json")
    batch = json.loads(path.read_text())
    del batch["check"], batch["records"][0][next(iter(batch["records"][0]))]
    path.write_text(json.dumps(batch))
    with pytest.warns(UserWarning, match="was edited or is damaged: its runs are made again"):
        again = run_sweep([problem], tmp_path, resume=True, **runs)
    assert [record.keys() for record in again["bowls"]] == [record.keys() for record in made["bowls"]]


CONVERGENCE: dict[str, Any] = {
    **{"occluder": "ring", "camera": "perspective", "filter": 3, "displacement": 0.1, "texel": 0.01, "error_texels": 0.1},
    **{
        "recovered": True,
        "seconds_per_iteration": 0.1,
        "error_curve_texels": [1.0, 0.1],
        "loss_curve": [1.0],
        "candidate": "msm",
    },
}


@pytest.mark.parametrize(
    ("name", "value"),
    [("candidate", 3), ("occluder", []), ("camera", []), ("displacement", "x"), ("error_curve_texels", [[1], 2])],
)
def test_edited_runs_of_occluders_are_made_again(tmp_path: Path, name: str, value: object) -> None:
    options = ConvergenceOptions(out=tmp_path, resume=True)
    path = tmp_path / "convergence.json"
    settings = convergence._started(path, options)["settings"]
    runs = {"good": CONVERGENCE, "edited": {**CONVERGENCE, name: value}}
    found = _warned(path, json.dumps({"settings": settings, "runs": runs}), lambda: convergence._started(path, options))
    assert found["runs"] == {"good": CONVERGENCE}


def test_edited_runs_of_heads_are_made_again(tmp_path: Path) -> None:
    names = ("mode", "lights", "seed", "distance", "start_distance", "image_error", "weight_error", "final", "true", "loss_curve")
    options, model, path = FaceOptions(out=tmp_path, resume=True), default_model(None), tmp_path / "faces.json"
    settings = faces._started(path, options, model)["settings"]
    content = json.dumps({"settings": settings, "runs": {"edited": dict.fromkeys(names, {"a": 1})}})
    assert _warned(path, content, lambda: faces._started(path, options, model))["runs"] == {}
