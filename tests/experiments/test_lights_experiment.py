"""The light experiment: protocol, matching, records, files, resuming."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from rich.console import Console
from typer.testing import CliRunner

from shadowmap_dr.cli.main import app
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.lights import speed
from shadowmap_dr.experiments.lights.experiment import LightOptions, run_lights, summary
from shadowmap_dr.experiments.lights.problem import LightProblem, curve_iterations
from shadowmap_dr.experiments.lights.scene import alignment, random_directions, target_and_starts
from shadowmap_dr.inverse.light_directions.shading import with_shadow
from shadowmap_dr.io import assets
from shadowmap_dr.shadow.filters import filter_kernel


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def options(out: Path, **changes: Any) -> LightOptions:
    small: dict[str, Any] = {
        "objects": ("teapot",), "runs": 3, "iterations": 10, "resolution": 24, "map_resolution": 32, "out": out
    }  # fmt: skip
    return LightOptions(**{**small, **changes})


def test_alignment_matches_greedily_and_one_to_one() -> None:
    generator = np.random.default_rng(0)
    for _ in range(20):
        target, found = (random_directions(generator, 4, 170) for _ in range(2))
        pairs, left, right = [], set(range(4)), set(range(4))
        while left:
            i, j = max(itertools.product(left, right), key=lambda ij: target[ij[0]] @ found[ij[1]])
            pairs.append(target[i] @ found[j])
            left.remove(i)
            right.remove(j)
        assert alignment(target, found) == pytest.approx(np.mean(pairs))
        assert alignment(target, 3 * target[::-1]) == pytest.approx(1)


def test_directions_fill_their_cone_evenly() -> None:
    found = random_directions(np.random.default_rng(1), 4000, 60)
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    assert found[:, 1].min() >= np.cos(np.radians(30)) - 1e-9
    # By solid angle: cosines are uniform.
    assert found[:, 1].mean() == pytest.approx((1 + np.cos(np.radians(30))) / 2, abs=2e-3)
    assert np.abs(found[:, [0, 2]].mean(0)).max() < 0.02


def test_targets_and_starts_come_from_the_run_alone() -> None:
    one, other = (LightProblem("spot", 2, 9, filter_size=size, starts=s).directions([4, 7]) for size, s in ((3, 1), (15, 3)))
    assert np.array_equal(one[0], other[0]) and np.array_equal(one[1][:, 0], other[1][:, 0])
    assert not np.array_equal(one[0][0], one[0][1])
    assert not np.allclose(one[0], one[1][:, 0])
    assert np.array_equal(target_and_starts(0, 4, 2)[0], one[0][0])
    assert not np.array_equal(target_and_starts(1, 4, 2)[0], one[0][0])


def test_records_files_and_resuming(tmp_path: Path) -> None:
    summaries = run_lights(options(tmp_path, lights=(1, 2), filter_sizes=(3, 0)))
    stored = json.loads((tmp_path / "lights.json").read_text())
    assert stored.keys() == {"shadowmap_dr", "machine", "settings", "summaries"} and stored["settings"]["runs"]
    assert stored["summaries"] == summaries and len(summaries) == 4
    for entry in summaries:
        assert entry["alignment_mean"] == pytest.approx(entry["curve_mean"][-1], abs=1e-5)
        assert entry["curve_iterations"][-1] == 10 and entry["alignment_mean"] > entry["curve_mean"][0]
    for name in ("lights.png", "pictures.png"):
        assert (tmp_path / name).stat().st_size > 1000
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "batches").iterdir()}
    assert len(files) == 4
    record = json.loads(min(files).read_text())["records"][0]
    assert record["alignment"] == pytest.approx(alignment(record["target"], record["final"]))
    # A new setting beside the old ones, whose files stay as they are.
    more = run_lights(options(tmp_path, filter_sizes=(5,), resume=True))
    assert len(json.loads((tmp_path / "lights.json").read_text())["summaries"]) == 5 and len(more) == 5
    assert all(path.stat().st_mtime_ns == time for path, time in files.items())
    assert str(tmp_path) not in (tmp_path / "lights.json").read_text()


def test_runs_with_another_content_of_a_mesh_file_are_made_again(tmp_path: Path) -> None:
    path = tmp_path / "thing.ply"
    found = []
    for name in ("spot", "teapot"):
        path.write_bytes(assets.mesh(name).read_bytes())
        found.append(run_lights(options(tmp_path, objects=(str(path),), resume=True))[-1])
    anew = run_lights(options(tmp_path / "anew", objects=(str(path),)))[-1]
    assert found[1]["alignment_mean"] == anew["alignment_mean"] != found[0]["alignment_mean"]
    assert "object_digest" not in LightProblem("spot", 1, 1).settings()


def test_settings_without_effect_make_no_other_runs(tmp_path: Path) -> None:
    first = run_lights(options(tmp_path, filter_sizes=(3, 0)))
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "batches").iterdir()}
    # Boxes and samples: the shadows are others, what has none is the same, and so are targets that are not path-traced.
    again = run_lights(options(tmp_path, filter_sizes=(3, 0), filter="box", map_resolution=64, spp=4, resume=True))
    assert all(path.stat().st_mtime_ns == time for path, time in files.items())
    assert len(list((tmp_path / "batches").iterdir())) == len(files) + 1
    assert [(entry["filter_size"], entry["filter"]) for entry in again] == [(3, "gaussian"), (3, "box"), (0, "gaussian")]
    assert again[2] == first[1]
    other, same = (LightProblem("spot", 1, 1, spp=spp, reference="mitsuba") for spp in (4, 16))
    assert other.name != same.name and other.settings() != same.settings()


def test_fewer_runs_or_objects_do_not_shrink_a_summary(tmp_path: Path) -> None:
    (first,) = run_lights(options(tmp_path, objects=("teapot", "spot"), filter_sizes=(0,), runs=2))
    for changes in ({"runs": 1}, {"objects": ("spot",), "runs": 2}):
        (again,) = run_lights(options(tmp_path, filter_sizes=(0,), resume=True, **changes))
        assert again == first
    (more,) = run_lights(options(tmp_path, objects=("suzanne",), filter_sizes=(0,), runs=2, resume=True))
    assert more["objects"] == ["teapot", "spot", "suzanne"] and more["runs"] == 2
    # More runs of one object: no summary can have all of them for all objects.
    (longer,) = run_lights(options(tmp_path, objects=("spot",), filter_sizes=(0,), runs=3, resume=True))
    assert longer["objects"] == ["spot"] and longer["runs"] == 3


def test_curves_end_with_the_last_step() -> None:
    assert curve_iterations(10) == [0, 5, 10] and curve_iterations(9) == [0, 5, 9] and curve_iterations(3) == [0, 3]
    problem = LightProblem("teapot", 1, 2, filter_size=0, resolution=16, iterations=3)
    records = problem.run_batch(problem.build(), range(2), None, lambda done: None)
    for record in records:
        curve = record["alignment_curve"]
        assert len(curve) == 2 and curve[-1] == pytest.approx(record["alignment"], abs=1e-5)
    assert summary([problem], [records])["curve_iterations"] == [0, 3]


def test_coarse_first_has_a_larger_filter_even_if_there_is_none_later() -> None:
    problem = LightProblem("teapot", 1, 1, filter_size=1, map_resolution=32, resolution=8, strategy="coarse")
    scene = problem.build().scene
    shadows = [with_shadow(scene, filter_size=stage.filter_size or 1).shadow for stage in problem.stages]
    assert [len(filter_kernel(s.filter, s.filter_size)) for s in shadows] == [15, 1]


def test_mesh_files_are_brought_into_view(tmp_path: Path) -> None:
    name = str(tmp_path / "far away.ply")
    mesh = trimesh.load(assets.mesh("spot"), process=False)
    mesh.apply_scale(37)
    mesh.apply_translation([900, -50, 3])
    mesh.export(name)
    size = {"filter_size": 3, "resolution": 24, "map_resolution": 32}
    moved, spot = (LightProblem(thing, 1, 1, **size) for thing in (name, "spot"))
    assert " " not in moved.name
    images = [problem.build().render(problem.directions([0])[0]) for problem in (moved, spot)]
    # The package's has another centre than that of its box, by less than a pixel.
    assert np.abs(images[0] - images[1]).mean() < 0.02
    trimesh.Trimesh(np.ones((3, 3)), [[0, 1, 2]], process=False).export(name)
    with pytest.raises(ShadowmapError, match="no extent: all its vertices lie at \\(1.0, 1.0, 1.0\\)"):
        moved.build()


def test_more_starts_never_end_worse() -> None:
    records = {}
    for starts in (1, 3):
        problem = LightProblem("teapot", 1, 3, resolution=24, map_resolution=32, iterations=15, starts=starts, cone_deg=150)
        records[starts] = problem.run_batch(problem.build(), range(3), None, lambda done: None)
    for one, several in zip(records[1], records[3], strict=True):
        assert several["loss"] <= one["loss"] * (1 + 1e-3)
        assert one["target"].tolist() == several["target"].tolist()
    assert any(several["loss"] < 0.9 * one["loss"] for one, several in zip(records[1], records[3], strict=True))


def test_path_traced_targets_show_the_same_lights() -> None:
    problem = LightProblem("teapot", 2, 1, resolution=32, map_resolution=128, reference="mitsuba", spp=16)
    batch, (targets, starts) = problem.build(), problem.directions([0])
    traced, own = problem.target_images(batch, targets, [0])[0], batch.render(targets)[0]
    assert np.abs(traced - own).mean() < 0.01 * own.mean()
    assert np.abs(traced - own).mean() < 0.2 * np.abs(traced - batch.render(starts[:, 0])[0]).mean()


def test_bad_input_is_named(tmp_path: Path) -> None:
    for changes, message in (
        ({"lights": (6,)}, "lights.* is 6"),
        ({"objects": ()}, "no object"),
        ({"filter_sizes": (3, 3)}, "twice"),
        ({"runs": 0}, "runs.* is 0"),
        ({"cone_deg": 200.0}, "--cone. is 200"),
        ({"reference": "other"}, "'other'"),
        ({"strategy": "fine"}, "'fine'"),
        ({"objects": ("nothing",)}, "no mesh 'nothing'"),
        ({"filter_sizes": (4,)}, "odd number"),
        ({"strategy": "coarse", "map_resolution": 16}, "filter size 15 is too large"),
        ({"filter": "none"}, "no filter 'none'"),
        ({"threads": 10**8}, "100000000 threads"),
        ({"spp": 10**11}, "spp.* is 100000000000"),
        ({"scheduler": "nobody"}, "'nobody'"),
    ):
        with pytest.raises(ShadowmapError, match=message):
            run_lights(options(tmp_path, **changes))


def test_command_line(tmp_path: Path) -> None:
    small = ["--object", "teapot", "--runs", "2", "--iterations", "3", "--resolution", "16", "--map-resolution", "32"]
    runner = CliRunner()
    for extra, shadows in (([], [True, False]), (["--no-shadows"], [False]), (["--shadows", "--filter-size", "5"], [True])):
        out = tmp_path / str(len(extra))
        result = runner.invoke(app, ["lights", *small, *extra, "--out", str(out)])
        assert result.exit_code == 0, result.output
        assert [e["shadows"] for e in json.loads((out / "lights.json").read_text())["summaries"]] == shadows


def test_times_show_how_far_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    def alternate(contenders: Any, on_call: Any) -> dict[str, list[float]]:
        on_call(1, 2, "reverse")
        return {name: [1.0] for name in contenders}

    monkeypatch.setattr(speed.timing, "alternate", alternate)
    console = Console(file=io.StringIO(), force_terminal=True, width=90)
    problem = LightProblem("spot", 1, 2, resolution=16, map_resolution=16)
    times = speed.measure(problem, (1,), console=console)
    assert times["seconds"].keys() == {"batch of 1", "reverse", "renderer"}
    shown = console.file.getvalue()
    assert "1/2" in shown and "reverse" in shown


def test_sweeps_of_workers_show_how_far_they_are(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="distributed is not installed: pip install '.[distributed]'")
    cluster = contextlib.nullcontext(SimpleNamespace(scheduler_address="tcp://nowhere:1"))
    monkeypatch.setattr(distributed, "LocalCluster", lambda **settings: cluster)
    monkeypatch.setattr(speed, "run_sweep", lambda *arguments, **settings: None)
    console = Console(file=io.StringIO(), force_terminal=True, width=90)
    found = speed.measure_workers(LightProblem("spot", 1, 2, resolution=16, map_resolution=16), (1, 2), tmp_path, console=console)
    assert found["speed_up"].keys() == {"1", "2"} and found["runs"] == 2
    shown = console.file.getvalue()
    assert "4/4" in shown and "2 workers, timed" in shown
