"""The section of the benchmark that runs the command `fit`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import pytest
from fit_problems import quick, record_of

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.bench import report as bench_report
from shadowmap_dr.experiments.bench.common import BenchOptions, Sizes
from shadowmap_dr.experiments.bench.fits import catalogue, section, trial
from shadowmap_dr.experiments.bench.fits.scenes import load_scene, write_scene


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def options(out: Path, **changes: Any) -> BenchOptions:
    return BenchOptions(out=out / "bench.json", only=("fits",), sizes=Sizes(fits=("bunny-pose",), fit_starts=2), **changes)


FAKE = """
import json, sys
from pathlib import Path
out = Path(sys.argv[sys.argv.index("--out") + 1])
start = int(out.parent.name.removeprefix("start-"))
if start == {failing}:
    sys.exit("Error: this went wrong.")
assert Path("scene.xml").is_file() and Path("photo.png").is_file()
out.mkdir()
(out / "fit.json").write_text(json.dumps(json.loads(Path({records!r}).read_text())[start]))
"""


@pytest.mark.parametrize("failing", [1, 5])
def test_the_section_runs_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int) -> None:
    problem = quick(catalogue.named(["bunny-pose"])[0])
    starts = [problem.start(k) for k in range(2)]
    records = [record_of(problem, start, at) for start, at in zip(starts, (problem.truth, starts[1]), strict=True)]
    (tmp_path / "records.json").write_text(json.dumps(records))
    script = tmp_path / "fake.py"
    script.write_text(FAKE.format(failing=failing, records=str(tmp_path / "records.json")))
    monkeypatch.setattr(section, "COMMAND", (sys.executable, str(script), "fit"))
    result = section.measure(options(tmp_path), problem, {}, lambda *_: None)
    assert [one["solved"] for one in result["starts"]] == [True, False]
    assert result["seconds"]["fit"]["count"] == 2 and result["vary"] == ["bunny:pose"]
    first, second = (trial.line(one) for one in result["starts"])
    assert ", solved, called found (1.0 % unexplained); bunny:pose rotation " in first
    assert ("failed: status 1: Error: this went wrong." if failing == 1 else "NOT SOLVED, called found") in second
    if failing == 1:
        assert "this went wrong" in result["starts"][1]["failed"]
    rows = bench_report.rows({"sections": {"fits": {"units": {"bunny-pose": result}}}})
    cells = {row.what: row for row in rows}
    assert cells["fit: bunny-pose"].ratio == "1 solved"
    assert cells["fits: solved"].ours == "50 %" and cells["fits: solved"].met is False
    assert cells["fits: called found, but not solved"].ours == ("0" if failing == 1 else "1")
    assert cells["fits: intervals that hold the truth"].ours == "100 %"


def test_a_command_that_always_fails_fails_the_unit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(section, "COMMAND", (sys.executable, "-c", "import sys; sys.exit('Error: broken.')"))
    result = section.measure(options(tmp_path), quick(catalogue.named(["bunny-pose"])[0]), {}, lambda *_: None)
    assert result["failed"].endswith("Error: broken.")
    rows = bench_report.rows({"sections": {"fits": {"units": {"bunny-pose": result}}}})
    assert rows[0].ours == "failed" and rows[1].ours == "0 %"


def test_meshes_of_the_user(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="no such folder"):
        options(tmp_path, meshes=tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ShadowmapError, match="holds no meshes"):
        section.units(options(tmp_path, meshes=tmp_path / "empty"))
    folder = tmp_path / "own meshes"
    folder.mkdir()
    (folder / "my part-2.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 2 0\nv 0 0 3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n")
    units = section.units(options(tmp_path, meshes=folder))
    assert [unit.name for unit in units] == ["bunny-pose", "mesh-my_part_2"]
    problem = catalogue.of_meshes(folder)[0]
    scene = load_scene(write_scene(problem.start(0), tmp_path / "scene"))
    assert "my_part_2" in {shape.id() for shape in scene.shapes()}
