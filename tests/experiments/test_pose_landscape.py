"""Slices through the loss of a pose."""

from __future__ import annotations

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.pose import landscape as pose_landscape
from shadowmap_dr.experiments.pose.experiment import PoseOptions, run_pose
from shadowmap_dr.io import records


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


X, Y = np.meshgrid(np.linspace(-1, 1, 24), np.linspace(-1, 1, 24))


def bar(pose: np.ndarray) -> np.ndarray:
    """A blurred bar around a point beside the axis, so that a rotation moves it, too."""
    angle, x, y = pose
    u = np.cos(angle) * (X - x) + np.sin(angle) * (Y - y) - 0.3
    v = -np.sin(angle) * (X - x) + np.cos(angle) * (Y - y)
    return np.exp(-8 * u**2 - 2 * v**2)[..., None]


def test_best_offset_is_found_at_each_angle() -> None:
    angles = np.radians([-20, -10, 0, 10, 20])
    end = np.array([0.1, 0.2, -0.15])
    lines = pose_landscape.slices(bar, bar(np.zeros(3)), angles, end, steps=8)
    for i, angle in enumerate(angles):
        image = [np.mean((bar(np.array([angle, *offset])) - bar(np.zeros(3))) ** 2) for offset in ([0, 0], end[1:])]
        np.testing.assert_allclose([lines["target"][i], lines["end"][i]], image)
        # A grid around the offset that was found has nothing better.
        grid = lines["best_offset"][i] + 0.01 * np.array([[i, j] for i in range(-3, 4) for j in range(-3, 4)])
        around = [np.mean((bar(np.array([angle, *offset])) - bar(np.zeros(3))) ** 2) for offset in grid]
        assert lines["best"][i] <= min(around) * (1 + 1e-3) + 1e-12
    assert lines["best"][2] == 0 and (lines["best"][[0, 1, 3, 4]] > 1e-5).all()
    assert (lines["best"][[0, 4]] < 0.8 * lines["target"][[0, 4]]).all()


@pytest.mark.usefixtures("no_pictures")
def test_program_draws_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from typer.testing import CliRunner

    from shadowmap_dr.cli.main import app

    arguments = "pose --resolution 16 --iterations 2 --method shadows --reference own --out".split()
    assert CliRunner().invoke(app, [*arguments, str(tmp_path)]).exit_code == 0
    wanted = {"object": "spot", "resolution": 16, "method": "shadows", "run": 0}
    lines = pose_landscape.landscape(tmp_path, wanted, tmp_path / "a.png", count=3)
    assert lines["target"][1] < 1e-9 < lines["target"].max() and (lines["best"] <= lines["end"]).all()
    assert (tmp_path / "a.png").stat().st_size

    # Without shadows the same pose makes another image, and the target is not matched.
    without = pose_landscape.landscape(tmp_path, wanted, tmp_path / "b.png", renderer="rasterizer", count=3)
    assert without["target"][1] > 1e-6

    with pytest.raises(ShadowmapError, match="no run with object spot, resolution 16, method shadows, run 7"):
        pose_landscape.landscape(tmp_path, {**wanted, "run": 7}, tmp_path / "b.png")
    monkeypatch.setattr(sys, "argv", ["pose_landscape", str(tmp_path / "nothing")])
    with pytest.raises(SystemExit, match="no file"):
        pose_landscape.main()
    assert len(records.read_json(tmp_path / "pose.json")["runs"]) == 1


@pytest.mark.usefixtures("no_pictures")
def test_meshes_of_users_are_those_of_their_runs(tmp_path: Path) -> None:
    path = tmp_path / "brick.ply"
    trimesh.creation.box((1, 2, 3)).export(path)
    options = PoseOptions((str(path),), (16,), ("shadows",), iterations=2, reference="own", out=tmp_path / "runs")
    run_pose(options)
    wanted = {"object": "brick", "resolution": 16, "method": "shadows", "run": 0}
    lines = pose_landscape.landscape(options.out, wanted, tmp_path / "a.png", count=3)
    assert lines["target"][1] < 1e-9 < lines["target"].max()
    trimesh.creation.box((3, 2, 1)).export(options.out / "objects" / "brick.ply")
    with pytest.raises(ShadowmapError, match="brick is not the one of the run any more"):
        pose_landscape.landscape(options.out, wanted, tmp_path / "a.png", count=3)
    (options.out / "pose.json").write_text("{}")
    with pytest.raises(ShadowmapError, match="no list of records"):
        pose_landscape.landscape(options.out, wanted, tmp_path / "a.png", count=3)
