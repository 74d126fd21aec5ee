"""The scripts in ``docs/examples``, shortened."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
SUPPORT = ROOT / "tests" / "support"
# As a script, but for how kernels are compiled.
QUICKLY = "import quick_kernels, runpy, sys; del sys.argv[0]; runpy.run_path(sys.argv[0], run_name='__main__')"


def output_of(script: str, *options: object) -> str:
    """Output of an example that runs for a moment. Its kernels are compiled as those of tests."""
    command = [sys.executable, "-c", QUICKLY, ROOT / "docs" / "examples" / script, *options]
    paths = os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")]).strip(os.pathsep)
    environment = {**os.environ, "PYTHONPATH": paths}
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=300, cwd=ROOT, env=environment)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_a_mesh_takes_the_shape_of_its_shadow(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")
    output = output_of("torch_mesh.py", "--steps", 40, "--size", 64, "--out", tmp_path / "out")
    before, after = map(float, re.search(r"loss ([0-9.]+) -> ([0-9.]+)", output).groups())
    assert after < 0.2 * before
    shadows = np.asarray(Image.open(tmp_path / "out" / "shadows.png"), np.float32).mean(2)
    start, end, wanted = (shadows[:, k * 64 : (k + 1) * 64] < 170 for k in range(3))
    assert 0.05 < wanted.mean() < 0.6
    assert (end != wanted).mean() < 0.3 * (start != wanted).mean()
    views = [np.asarray(Image.open(tmp_path / "out" / f"{name}.png"), np.float32) for name in ("before", "after")]
    assert views[0].shape == (384, 384, 3) and np.abs(views[0] - views[1]).mean() > 2


def test_optimisations_are_drawn_with_their_seconds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["hero", "--out", str(tmp_path / "hero.png"), "--size", "40", "--resolution", "24"])
    hero = runpy.run_path(str(ROOT / "docs" / "examples" / "hero.py"))
    hero["SHOWN"].update(pose=(0, 3), shape=(0, 3))
    hero["main"]()
    pixels = np.asarray(Image.open(tmp_path / "hero.png"), np.float32)
    assert pixels.shape == (2 * 44, 3 * 40 + 2, 3)
    for row in (pixels[:40], pixels[44:84]):  # target, start, end
        start, end = row[:, 41:81], row[:, 82:122]
        assert start.std() > 20 and 0.2 < np.abs(start - end).mean() < 60


def test_the_overview_has_a_pose(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ["overview", "--out", str(tmp_path / "overview.png"), "--size", "24", "--steps", "2"]
    monkeypatch.setattr(sys, "argv", command)
    overview = runpy.run_path(str(ROOT / "docs" / "examples" / "overview.py"))
    overview["SCENES"].clear()  # which are rendered by other tests
    overview["main"]()
    with Image.open(tmp_path / "overview.png") as picture:
        assert picture.width > 2 * picture.height and np.asarray(picture.convert("L")).std() > 30


def test_ways_to_render_are_timed_in_turns() -> None:
    output = output_of("plugin_speed.py", "--resolution", "16", "--rounds", "2")
    steps = dict(re.findall(r"^(.+): ([0-9.]+) ms a step", output, re.MULTILINE))
    assert (
        list(steps) == ["plug-in", "plug-in, recorded=False", "renderer, recorded", "params.update() alone"]
        and min(map(float, steps.values())) > 0
    )


def test_steps_of_all_kinds_are_timed() -> None:
    output = output_of("step_kinds.py", "--resolution", "16", "--seconds", "0")
    steps = dict(re.findall(r"^(.+): ([0-9.]+) ms a step", output, re.MULTILINE))
    assert len(steps) == 10 and "frozen" in steps and min(map(float, steps.values())) > 0


@pytest.mark.parametrize("setting", [[], ["--setting", "2/2/8/none/4"]])  # the fair one: ratios above a thousand
def test_steps_are_timed_in_turns(setting: list[str]) -> None:
    output = output_of("pose_speed.py", "--resolution", "16", "--rounds", "1", *setting)
    assert ("2/2/8 none, 4" in output) == bool(setting)
    steps = {name: float(value) for name, value in re.findall(r"^(\w+): ([0-9.]+) ms a step", output, re.MULTILINE)}
    assert steps.keys() == {"shadows", "rasterizer", "mitsuba"} and min(steps.values()) > 0
    ratios = {pair: float(value) for pair, value in re.findall(r"^(\w+ / \w+): ([0-9.]+)x$", output, re.MULTILINE)}
    assert ratios.keys() == {"mitsuba / shadows", "mitsuba / rasterizer", "shadows / rasterizer"}
    for pair, ratio in ratios.items():  # plain numbers, also above a thousand
        above, below = pair.split(" / ")
        assert ratio == pytest.approx(steps[above] / steps[below], rel=0.02, abs=0.06 if ratio < 10 else 0.6)


def test_steps_are_timed_again_and_again() -> None:
    output = output_of("step_phases.py", "--resolution", "16", "24", "--seconds", "0.1")
    times = re.findall(r"(\d+) threads: ([0-9.]+) ([0-9.]+)", output)
    assert times and times[-1][0] == "1" and all(float(value) > 0 for row in times for value in row)


def test_limits_are_measured() -> None:
    output = output_of("limits.py", "--size", "24", "--samples", "1")
    lines = re.findall(r"^(.+), 1 samples: cosine (-?[0-9.]+), scale (-?[0-9.]+)$", output, re.MULTILINE)
    assert len(lines) == 8
    found = {name: (float(cosine), float(scale)) for name, cosine, scale in lines}
    # The right direction, and not the right size.
    assert found["ball lit from the camera, grows"] == (pytest.approx(1, abs=0.01), pytest.approx(1.2, abs=0.1))
