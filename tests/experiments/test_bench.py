"""The benchmark: structure of its record, resuming, errors. Sizes are tiny and no time is held against anything."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from bench_runs import options, run
from bench_sizes import TINY
from rich.console import Console

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.bench import breakdown as bench_breakdown
from shadowmap_dr.experiments.bench import common as bench_common
from shadowmap_dr.experiments.bench import experiment as bench
from shadowmap_dr.experiments.bench import raster as bench_raster
from shadowmap_dr.experiments.bench import report as bench_report
from shadowmap_dr.experiments.bench import sums as bench_sums
from shadowmap_dr.experiments.bench.common import Unit, run_child
from shadowmap_dr.experiments.common import meshes as bench_meshes
from shadowmap_dr.experiments.common import timing
from shadowmap_dr.io import assets
from shadowmap_dr.scene.load import load


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def assert_summary(entry: dict[str, Any]) -> None:
    assert entry.keys() == {"median", "q1", "q3", "min", "count"}
    assert 0 < entry["min"] <= entry["q1"] <= entry["median"] <= entry["q3"]


def test_rasterization(tmp_path: Path) -> None:
    units = run(options(tmp_path, "raster"))["sections"]["raster"]["units"]
    assert list(units) == [f"{m}@{r}" for m in ("teapot-1k", "even-20", "slivers-20", "screen-filling-10") for r in (8, 16)] + [
        "full spot-6k@16"
    ]
    for name in ("ours", "embree update and trace", "embree trace"):
        assert_summary(units["teapot-1k@8"]["seconds"][name])
    assert units["teapot-1k@8"]["triangles"] == bench_meshes.KINDS["teapot-1k"] + 2  # the wall
    assert units["teapot-1k@8"]["ratio_of_medians"].keys() == {"embree update and trace / ours", "embree trace / ours"}
    assert 0.5 < units["teapot-1k@8"]["pixels_covered"] <= 1
    assert "slivers-20 / even-20" in units["slivers-20@16"]["ratio_of_medians"]
    assert units["full spot-6k@16"]["seconds"].keys() == {"rasterize", "rasterize and interpolate", "forward and backward"}
    for unit in units.values():
        assert unit["wall_seconds"] > 0 and {"load_before", "load_after", "cores_used_by_others"} <= unit.keys()


def test_growth(tmp_path: Path) -> None:
    units = run(options(tmp_path, "scaling"))["sections"]["scaling"]["units"]
    assert list(units) == ["resolution", "lights", "large", "batch"]
    points = units["resolution"]["points"]
    assert [point["size"] for point in points] == [64, 256]
    for point in [*points, units["large"]]:
        assert_summary(point["seconds"])
        assert 2**26 < point["peak_memory_imports"] <= point["peak_memory"] < 2**32
    expected = np.log(points[1]["seconds"]["median"] / points[0]["seconds"]["median"]) / np.log(4)
    assert units["resolution"]["exponent"] == pytest.approx(expected)
    for compared in (units["lights"]["in turns"], units["lights"]["in turns, larger images"]["16"]):
        assert compared["ratio_of_medians"].keys() == {"2 / 1"}
    for kind in ("raster", "sensors"):
        assert units["batch"][kind]["throughput_over_single_steps"]["1"] == 1
        assert units["batch"][kind]["throughput_over_single_steps"]["2"] > 0


def test_sums(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cases = (
        bench_sums.Sum("sun", "texture", "floor.bsdf.reflectance.data"),
        bench_sums.Sum("point", "diffuse", "light.position"),
    )
    monkeypatch.setattr(bench_sums, "SUMS", cases)
    measure = bench_sums.measure_sum
    monkeypatch.setattr(bench_sums, "run_child", lambda name, arguments, seconds: measure(**arguments, emit=lambda result: None))
    record = run(options(tmp_path, "sums"))
    units = record["sections"]["sums"]["units"]
    assert [[entry["mode"] for entry in units[str(case)]["sums"]] for case in cases] == [
        ["plug-in", "recorded"],
        ["plug-in", "recorded", "renderer", "frozen"],
    ]
    entries = [entry for unit in units.values() for entry in unit["sums"]]
    assert all(entry["ratio"] == pytest.approx(1, rel=bench_sums.TOLERANCE) for entry in entries)
    rows = [row for row in bench_report.rows(record) if row.what.startswith("sum")]
    assert len(rows) == 6 and all(row.met for row in rows)


def test_passes(tmp_path: Path) -> None:
    units = run(options(tmp_path, "breakdown"))["sections"]["breakdown"]["units"]
    assert list(units) == ["shadows-16", "rasterizer-16"]
    with_shadows, without = ([entry["pass"] for entry in unit["passes"]] for unit in units.values())
    assert with_shadows == [name for name, _ in bench_breakdown.PASSES] + [bench_breakdown.REST]
    assert without == [name for name in with_shadows if not name.startswith("shadow ")]
    for unit in units.values():
        for name in ("frozen", "not frozen"):
            assert_summary(unit[name]["seconds"])
            assert unit[name]["kernels"] > 10 and 0 <= unit[name]["share_outside_kernels"] < 1
        for entry in unit["passes"]:
            assert entry["forward_seconds"] + entry["backward_seconds"] > 0
        hits = next(entry for entry in unit["passes"] if entry["pass"] == "hits")
        assert hits["forward_seconds"] > 0 and hits["backward_seconds"] > 0


def test_passes_exist() -> None:
    for _, place in bench_breakdown.PASSES:
        owner, name = bench_breakdown.find(place)
        assert callable(getattr(owner, name)), place


def test_running_the_passes_one_by_one_changes_no_derivative(tmp_path: Path) -> None:
    from shadowmap_dr.experiments.bench.scaling import Case

    fit = Case(mesh="teapot-1k", resolution=16).fit(tmp_path)
    bench_breakdown.unfrozen_step(fit)
    expected = fit.state()
    fit.reset(np.zeros(3))
    place = bench_breakdown.Recorder()
    with pytest.MonkeyPatch.context() as patch, bench_breakdown._history():
        for label, path in bench_breakdown.PASSES:
            owner, name = bench_breakdown.find(path)
            patch.setattr(owner, name, place.wrap(label, getattr(owner, name)))
        bench_breakdown.unfrozen_step(fit)
    np.testing.assert_allclose(fit.state()["m"], expected["m"], rtol=1e-3, atol=1e-6)


def test_steps_and_poses(tmp_path: Path) -> None:
    record = run(options(tmp_path, "steps"))
    step, pose = record["sections"]["steps"]["units"].values()
    for name in ("shadows", "rasterizer", "mitsuba"):
        assert_summary(step["seconds"][name])
        assert pose["methods"][name]["starts"] <= 1
    assert {"mitsuba / shadows", "shadows / rasterizer"} <= step["ratio_of_medians"].keys()
    assert isinstance(step["mitsuba"]["fair"], bool) and step["mitsuba"]["setting"]["sppi"] >= 1
    run_ = pose["methods"]["shadows"]["runs"][0]
    assert run_["iterations"] == 3 and not run_["cut_short"] and len(run_["start"]) == len(run_["final"]) == 3
    assert pose["cut"]["mitsuba_seconds"] == 1.0
    assert pose["reference"] == "own"


def test_limit_for_mitsuba_cuts_runs_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from shadowmap_dr.experiments.bench import steps as bench_steps

    class Slow:
        setting = bench_steps_setting()

        class proxy:  # noqa: N801
            @staticmethod
            def record() -> dict[str, Any]:
                return {}

        def reset(self, start: Any) -> None:
            self.value = np.array(start)

        def step(self) -> float:
            time.sleep(0.02)
            return 1.0

        def parameters(self) -> Any:
            return self.value

        def recordings(self) -> int:
            return 1

    monkeypatch.setattr(bench_steps, "_methods", lambda *_: ({"shadows": Slow(), "mitsuba": Slow()}, None))
    monkeypatch.setattr(bench_steps, "_problem", lambda *_: (None, None, None))
    from dataclasses import replace

    chosen = options(tmp_path, "steps", sizes=replace(TINY, starts=2, iterations=5), mitsuba_seconds=0.05)
    result = bench_steps.measure_poses(chosen, 16, {}, lambda *_: None)
    assert result["cut"]["mitsuba_starts_cut_short"] == [0] and result["cut"]["mitsuba_starts_not_run"] == [1]
    assert result["methods"]["mitsuba"]["runs"][0]["seconds_to_pose"] is None
    assert [entry["iterations"] for entry in result["methods"]["shadows"]["runs"]] == [5, 5]


def bench_steps_setting() -> Any:
    from mitsuba_baselines.pose import ProjectiveSetting

    return ProjectiveSetting(1, 1, 1)


def units_that_count(calls: list[str], names: tuple[str, ...] = ("a", "b")) -> Any:
    def unit(name: str) -> Unit:
        def measure(done: Any, update: Any) -> dict[str, Any]:
            calls.append(name)
            update(1, 2, "half")
            return {"case": {}, "failed_on_purpose": len(done)}

        return Unit(name, measure)

    return lambda chosen: [unit(name) for name in names]


@pytest.fixture
def no_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """The records of invented units cannot be shown."""
    monkeypatch.setattr(bench_report, "rows", lambda record: [])
    monkeypatch.setattr(bench_report, "plot", lambda path, record: None)


def test_complete_units_are_kept_on_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None) -> None:
    calls: list[str] = []
    monkeypatch.setitem(bench.UNITS, "raster", units_that_count(calls))
    quiet = Console(quiet=True)
    bench.run_bench(options(tmp_path, "raster"), console=quiet)
    assert calls == ["a", "b"]
    bench.run_bench(options(tmp_path, "raster", resume=True), console=quiet)
    assert calls == ["a", "b"]
    monkeypatch.setitem(bench.UNITS, "raster", units_that_count(calls, ("a", "b", "c")))
    bench.run_bench(options(tmp_path, "raster", resume=True), console=quiet)
    assert calls == ["a", "b", "c"]
    bench.run_bench(options(tmp_path, "raster", resume=True, quick=True), console=quiet)  # with other options
    assert calls == ["a", "b", "c"] * 2
    bench.run_bench(options(tmp_path, "raster"), console=quiet)
    assert calls == ["a", "b", "c"] * 3


def test_other_sections_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None) -> None:
    for name in ("raster", "scaling"):
        monkeypatch.setitem(bench.UNITS, name, units_that_count([]))
    quiet = Console(quiet=True)
    first = bench.run_bench(options(tmp_path, "raster"), console=quiet)
    second = bench.run_bench(options(tmp_path, "scaling"), console=quiet)
    assert second["sections"]["raster"] == first["sections"]["raster"] and list(second["sections"]) == ["raster", "scaling"]


def test_failed_unit_is_recorded_and_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[str] = []

    def fail(done: Any, update: Any) -> dict[str, Any]:
        raise RuntimeError("no such\nthing")

    units = units_that_count(calls, ("b",))
    monkeypatch.setitem(bench.UNITS, "raster", lambda chosen: [Unit("a", fail), *units(chosen)])
    monkeypatch.setattr(bench_report, "_raster_rows", lambda key, unit: [])
    monkeypatch.setattr(bench_report, "plot", lambda path, record: None)
    record = bench.run_bench(options(tmp_path, "raster"), console=Console(quiet=True))
    assert bench.failures(record, ("raster",)) == ["raster a: no such thing"]
    assert calls == ["b"] and [row["what"] for row in record["figures"]] == ["raster a"]
    monkeypatch.setitem(bench.UNITS, "raster", units_that_count(calls))
    bench.run_bench(options(tmp_path, "raster", resume=True), console=Console(quiet=True))
    assert calls == ["b", "a"]


SCRIPT = """
import sys, time
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/../support"]
import mitsuba as mi, test_bench as t
from pathlib import Path
mi.set_variant("llvm_ad_rgb")
def slow(done, update):
    time.sleep(60)
t.bench.UNITS["raster"] = lambda chosen: [*t.units_that_count([])(chosen), t.Unit("slow", slow)]
t.bench.run_bench(t.options(Path(sys.argv[2]), "raster"), console=t.Console(quiet=True))
"""


def test_killed_process_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, no_report: None) -> None:
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(Path(__file__).parent), str(tmp_path)])
    path, deadline = tmp_path / "bench.json", time.monotonic() + 120
    while not (path.exists() and "b" in json.loads(path.read_text())["sections"]["raster"]["units"]):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    calls: list[str] = []
    monkeypatch.setitem(bench.UNITS, "raster", units_that_count(calls, ("a", "b", "slow")))
    # The number of threads that this process uses may be another one than a fresh process's.
    monkeypatch.setattr(bench, "_settings", lambda chosen: json.loads(path.read_text())["sections"]["raster"]["settings"])
    bench.run_bench(options(tmp_path, "raster", resume=True), console=Console(quiet=True))
    assert calls == ["slow"]


@pytest.mark.parametrize("content", ["[]", "{}", '{"format": "else", "sections": {}}', "no JSON"])
def test_a_file_that_is_no_record_is_left_alone(tmp_path: Path, content: str) -> None:
    path = tmp_path / "bench.json"
    path.write_text(content)
    with pytest.raises(ShadowmapError, match="bench.json"):
        bench.run_bench(options(tmp_path, "raster"), console=Console(quiet=True))
    assert path.read_text() == content


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"only": ("magic",)}, "magic"),
        ({"only": ()}, "no section"),
        ({"mitsuba_seconds": 0.0}, "0.0"),
        ({"mitsuba_seconds": float("nan")}, "nan"),
    ],
)
def test_unusable_options(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ShadowmapError, match=message):
        options(tmp_path, **{"only": ("raster",), **changes})


def test_child_that_fails_or_hangs(tmp_path: Path) -> None:
    case = {"resolution": 8, "mesh": "no-such-mesh"}
    result = run_child("bench.scaling:measure_case", {"case": case, "work": str(tmp_path), "rounds": 1}, 100)
    assert "no-such-mesh" in result["failed"] or "mesh" in result["failed"]
    assert run_child("bench.scaling:measure_case", {}, 0.01)["failed"].startswith("ended after")


@pytest.mark.parametrize("kind", ["teapot-1k", "spot-23k", "torus-48k", "slivers-50", "even-50", "screen-filling-7", "bunny*1"])
def test_meshes(kind: str, tmp_path: Path) -> None:
    mesh = bench_meshes.make(kind)
    assert len(mesh.faces) == bench_meshes.KINDS.get(
        kind, {"slivers-50": 50, "even-50": 50, "screen-filling-7": 7, "bunny*1": 4 * 3674}.get(kind)
    )
    assert mesh.faces.max() == len(mesh.vertices) - 1 and np.isfinite(mesh.vertices).all()
    corners = mesh.vertices[mesh.faces].astype(float)
    assert (np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) > 0).mean() > 0.99
    assert bench_meshes.stored(kind, tmp_path).stat().st_size == bench_meshes.stored(kind, tmp_path).stat().st_size > 0


def test_even_triangles_cover_as_many_pixels_as_slivers() -> None:
    """Pixel centres of a small image, counted one triangle at a time."""
    axis = (np.arange(96) + 0.5) / 48 - 1
    x, y = np.meshgrid(axis, axis)

    def covered(kind: str) -> int:
        matrix = np.array(load(bench_meshes.scene(assets.mesh("spot"), 96)).sensors[0][0].view_projection)[:, :, 0]
        mesh = bench_meshes.make(kind)
        clip = np.c_[mesh.vertices, np.ones(len(mesh.vertices))] @ matrix.T
        total = 0
        for a, b, c in (clip[:, :2] / clip[:, 3:])[mesh.faces]:
            sides = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0]) for p, q in ((a, b), (b, c), (c, a))]
            total += int(np.sum(np.all(np.array(sides) > 0, axis=0) | np.all(np.array(sides) < 0, axis=0)))
        return total

    assert covered("even-2000") == pytest.approx(covered("slivers-2000"), rel=0.1)


def test_subdivision_keeps_surface_and_closedness() -> None:
    mesh = bench_meshes.make("bunny")
    fine = bench_meshes.subdivided(mesh)

    def area(m: bench_meshes.Mesh) -> float:
        a, b, c = (m.vertices[m.faces[:, k]].astype(float) for k in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())

    assert area(fine) == pytest.approx(area(mesh), rel=1e-4)
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert len(fine.vertices) == len(mesh.vertices) + len(np.unique(edges, axis=0))


def test_screen_filling_triangles_hide_the_scene(tmp_path: Path) -> None:
    chosen = options(tmp_path, "raster")
    data = bench_raster.raster_scene(chosen, "screen-filling-5", 16)
    offset = next(bench_raster.offsets())
    triangle = np.array(bench_raster._visible(data.p_rest, data.moving, data.matrix, data.faces, offset, size=16)[0])
    assert len(np.unique(triangle)) == 1 and triangle[0] >= 2


def test_rasterization_and_rays_see_the_same(tmp_path: Path) -> None:
    chosen = options(tmp_path, "raster")
    data = bench_raster.raster_scene(chosen, "spot-6k", 32)
    hit = data.scene.ray_intersect_preliminary(bench_raster.camera_rays(data.scene, 32))
    offset = mi.Float([0.0])
    triangle = np.array(bench_raster._visible(data.p_rest, data.moving, data.matrix, data.faces, offset, size=32)[0])
    seen, struck = triangle != 0xFFFFFFFF, np.array(hit.is_valid())
    assert (seen == struck).mean() > 0.99
    first = np.array(data.faces).reshape(-1, 3)[triangle[seen & struck], 0]
    moving = np.array(data.moving)[first] == 1
    assert 0.05 < moving.mean() < 0.95
    prim = np.array(hit.prim_index)[seen & struck]
    # The wall's two triangles are the only ones with such small numbers that are likely to be seen.
    assert (moving == (prim >= 2)).mean() > 0.98


def test_contenders_take_turns() -> None:
    calls: list[str] = []
    contenders = {
        "a": timing.Contender(lambda: calls.append("a"), rounds=4, warm_up=1, settle=1, burst=2),
        "b": timing.Contender(lambda: calls.append("b"), rounds=2, warm_up=1, settle=0, burst=1),
    }
    seen: list[int] = []
    samples = timing.alternate(contenders, lambda done, total, name: seen.append(done))
    assert "".join(calls) == "ab" + "aaab" * 2
    assert [len(samples[name]) for name in "ab"] == [4, 2]
    assert seen == sorted(seen) and seen[-1] == 8


def test_slow_contender_is_measured_once() -> None:
    slow = timing.Contender(lambda: time.sleep(0.03), rounds=10, seconds=0.01)
    samples = timing.alternate({"slow": slow, "fast": timing.Contender(lambda: None, rounds=3)})
    assert len(samples["slow"]) == 1 and len(samples["fast"]) == 3


def test_statistics() -> None:
    result = timing.compare({"a": [3.0, 1.0, 2.0], "b": [4.0, 4.0]}, [("b", "a"), ("c", "a")])
    assert result["seconds"]["a"] == {"median": 2, "q1": 1.5, "q3": 2.5, "min": 1, "count": 3}
    assert result["ratio_of_medians"] == {"b / a": 2}
    assert timing.exponent([1, 10, 100], [2, 20, 200]) == pytest.approx(1)
    assert timing.exponent([5, 5], [1, 2]) is None
    assert timing.peak_memory() > 2**25
    others = timing.OtherWork()  # counts in ticks of 10 ms
    time.sleep(0.5)
    cores = others.cores()
    assert cores is None or 0 <= cores <= (os.cpu_count() or 1) + 1


def test_sections_of_the_options_and_of_the_benchmark_agree() -> None:
    assert tuple(bench.UNITS) == bench_common.SECTIONS
    for sizes in (bench_common.FULL, bench_common.QUICK):
        for name in (*sizes.meshes, *sizes.worst, *sizes.series["triangles"]):
            assert name in bench_meshes.KINDS


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.00397, "3.97 ms"),
        (0.9992, "999 ms"),
        (0.9997, "1 s"),
        (218.4, "218 s"),
        (999.4, "999 s"),
        (999.7, "1000 s"),
        (2345.6, "2346 s"),
    ],
)
def test_times_are_plain_numbers(seconds: float, text: str) -> None:
    assert bench_report._time(seconds) == text
