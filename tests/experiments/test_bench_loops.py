"""The benchmark of loops, steps of the plug-in and of PyTorch, and first derivatives: structure of its record."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import mitsuba as mi
import pytest
from bench_runs import options, run

from shadowmap_dr.experiments.bench import first as bench_first
from shadowmap_dr.experiments.bench import loops as bench_loops
from shadowmap_dr.experiments.bench import report as bench_report
from shadowmap_dr.experiments.bench import torch_steps as bench_torch


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def test_loops(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = dataclasses.replace(bench_loops.LOOPS["clipped colours"], count=5)
    monkeypatch.setattr(bench_loops, "LOOPS", {"clipped colours": loop})
    record = run(options(tmp_path, "loops"))
    unit = record["sections"]["loops"]["units"]["clipped colours"]
    assert unit["seconds"].keys() == unit["errors"].keys() == {"ours", "original"}
    assert unit["original"] == {"type": "prb", "max_depth": 2} and unit["ratio_of_medians"]["original / ours"] > 0
    assert all(entry["last"] < entry["first"] for entry in unit["errors"].values()) and unit["ratio_of_totals"] > 0


def test_loops_by_projective_integrators_have_a_third_contender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    original = {"type": "direct_projective", "guiding": "none"}
    loop = dataclasses.replace(bench_loops.LOOPS["object pose"], original=original, count=4, size=8)
    assert loop.bar < 1 and bench_loops.LOOPS["object pose"].original == {"type": "direct_projective"}
    monkeypatch.setattr(bench_loops, "LOOPS", {"object pose": loop})
    record = run(options(tmp_path, "loops"))
    unit = record["sections"]["loops"]["units"]["object pose"]
    assert unit["seconds"].keys() == unit["errors"].keys() == {"ours", "original", "sppi 0"}
    rows = [row for row in bench_report.rows(record) if row.what == "loop: object pose"]
    assert [row.other.split(" ")[0] for row in rows] == ["direct_projective", "direct_projective,"] and all(
        row.aim for row in rows
    )


def test_memory_of_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bench_loops, "_SETTLED", 10)
    found = bench_loops.measure_memory("kept parameters", 8, 13, lambda result: None)
    assert found["steps"] == 13 and found["settled"] > 0 and found["later"] > 0


def test_first_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {"bench.first:measure_first": bench_first.measure_first}
    monkeypatch.setattr(bench_first, "run_child", lambda name, arguments, seconds: calls[name](**arguments, emit=None))
    record = run(options(tmp_path, "first"))
    units = record["sections"]["first"]["units"]
    assert list(units) == ["4 instances of 2 groups, 4 shapes, 3 lights", "pose, no kernels"]
    unit, cold = units.values()
    assert cold["seconds"].keys() == {"ours", "direct_projective"} == cold["ends"].keys()
    for method, ends in cold["ends"].items():
        assert list(ends) == ["Python", "imports", "scene", "image", "derivative"]
        assert 0 < ends["Python"] < ends["imports"] < ends["derivative"] == cold["seconds"][method]["median"]
    assert unit["seconds"].keys() == unit["uncompiled"].keys() == {"ours", "direct", "backward"}
    rows = [row for row in bench_report.rows(record) if row.what.startswith("first")]
    assert [row.what for row in rows] == ["first picture", "first derivative", "first derivative"] and all(
        row.aim for row in rows
    )


def test_steps_of_the_plugin(tmp_path: Path) -> None:
    record = run(options(tmp_path, "plug-in"))
    units = record["sections"]["plug-in"]["units"]
    assert list(units) == ["camera@8", "reflectance@8", "vertices, 2 spp@8", "vertices, 2 points@8"]
    for unit in units.values():
        assert (
            unit["seconds"].keys() == {"plug-in", "not recorded", "renderer", "update"} and unit["over_renderer_and_update"] > 0
        )
    rows = [row for row in bench_report.rows(record) if row.what.startswith("plug-in")]
    assert len(rows) == 8 and [bool(row.aim) for row in rows] == [True, False] * 4


def test_steps_through_pytorch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    measure = bench_torch.measure_torch
    monkeypatch.setattr(bench_torch, "run_child", lambda name, arguments, seconds: measure(**arguments, emit=lambda result: None))
    record = run(options(tmp_path, "torch"))
    (unit,) = record["sections"]["torch"]["units"].values()
    assert unit["seconds"].keys() == {"torch", "renderer"}
    (row,) = (row for row in bench_report.rows(record) if row.what == "PyTorch: vertices")
    assert row.size == "8" and row.aim
