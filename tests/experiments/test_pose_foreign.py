"""Meshes as users bring them, and how often their poses are found."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.experiments.pose import foreign
from shadowmap_dr.experiments.pose.foreign_meshes import MAKERS, UNWELDED, write
from shadowmap_dr.io.meshes import read_mesh

SLOW = ("dense-scan", "rock")


def test_there_are_enough_meshes_of_all_kinds() -> None:
    assert len(MAKERS) >= 20 and set(UNWELDED) < set(MAKERS)


@pytest.mark.filterwarnings("ignore:.*welded")
@pytest.mark.parametrize("name", [name for name in MAKERS if name not in SLOW])
def test_meshes_can_be_read_and_turning_changes_their_looks(name: str, tmp_path: Path) -> None:
    path = write(name, tmp_path)
    assert path.suffix == (".stl" if name in UNWELDED else ".ply")
    vertices, faces = read_mesh(path)
    again, _ = read_mesh(write(name, tmp_path / "again"))
    np.testing.assert_array_equal(vertices, again)
    target = _silhouettes(vertices, faces, 0)
    for degrees in (-60, -45, -30, -15, 15, 30, 45, 60):
        other = _silhouettes(vertices, faces, degrees)
        # No other pose looks like the target.
        assert np.count_nonzero(target != other) > 0.07 * np.count_nonzero(target), degrees


def _silhouettes(vertices: np.ndarray, faces: np.ndarray, degrees: float) -> np.ndarray:
    """Texels (2, 64, 64) in which points of a turned mesh's facets lie, seen along z, as a shadow is, and from the side."""
    rng = np.random.default_rng(0)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    weights = rng.dirichlet((1, 1, 1), 60_000)
    points = np.einsum("nk,nkc->nc", weights, corners[rng.choice(len(faces), len(weights), p=area / area.sum())])
    turns = np.radians([degrees, degrees + 60])
    x = np.cos(turns)[:, None] * points[:, 0] + np.sin(turns)[:, None] * points[:, 2]
    return np.stack([np.histogram2d(points[:, 1], across, bins=64, range=[[-1.5, 1.5]] * 2)[0] > 0 for across in x])


@pytest.mark.filterwarnings("ignore:.*welded")
def test_runs_are_counted_kept_and_added(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mi.set_variant("llvm_ad_rgb")
    small = ["--out", str(tmp_path), "--resolution", "16", "--mesh", "letters", "--iterations", "4"]
    foreign.main([*small, "--setting", "1", "--runs", "1"])
    first = json.loads((tmp_path / "foreign.json").read_text())
    assert len(first["letters"]["1"]["runs"]) == 1
    foreign.main([*small, "--setting", "1", "--setting", "auto", "--runs", "2"])
    found = json.loads((tmp_path / "foreign.json").read_text())["letters"]
    assert found["1"]["runs"][0] == first["letters"]["1"]["runs"][0]
    assert [len(found[setting]["runs"]) for setting in ("1", "auto")] == [2, 2]
    assert found["1"]["search"] == {"samples": 1, "blur": 0.0, "tries": 1, "optimiser": "adam"}
    assert found["auto"]["search"]["samples"] == 16 and found["auto"]["search"]["blur"] == 1
    assert Image.open(tmp_path / "foreign.png").size == (6 * 16, 16)
    lines = (tmp_path / "foreign.md").read_text().splitlines()
    assert lines[0] == "| mesh | faces | narrow [px] | 1 sample: found, s | default: found, s | samples | tries |"
    assert lines[2].startswith("| letters | 564 | ") and lines[3].startswith("| all 1 |")
    assert capsys.readouterr().out.count("letters, 1:") == 2
