"""The comparison of shadow maps: its measures, its scenes, and a small run."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.maps import experiment as maps
from shadowmap_dr.experiments.maps import scenes as maps_scenes
from shadowmap_dr.experiments.maps.experiment import MapsOptions, run_maps
from shadowmap_dr.experiments.maps.metrics import Texel, contour_shift, metrics, texel_in_pixels
from shadowmap_dr.shadow import directional_view


def disk(radius: float, size: int = 200, x: float = 0.0) -> np.ndarray:
    """Visibility around the shadow of a disk, anti-aliased."""
    line = np.arange(size) - (size - 1) / 2
    distance = np.hypot(line[None] - x, line[:, None])
    return np.clip(distance - radius + 0.5, 0, 1).astype(np.float32)


def test_contour_shift_is_a_distance() -> None:
    everywhere = np.ones((200, 200), bool)
    assert contour_shift(disk(50), disk(50), everywhere) == 0
    for shift in (0.5, 1.0, 3.0):
        assert contour_shift(disk(50 + shift), disk(50), everywhere) == pytest.approx(shift, rel=0.15)
    # A disk that moves sideways: the mean of |cos| around the circle.
    assert contour_shift(disk(50, x=2.0), disk(50), everywhere) == pytest.approx(2 * 2 / np.pi, rel=0.1)


@pytest.mark.parametrize("shift", [0.3, 2.0])
@pytest.mark.parametrize("degrees", [0, 22.5, 40, 70])
def test_contour_shift_of_straight_edges(degrees: float, shift: float) -> None:
    """Whatever their direction, and also where it is less than a pixel."""
    across, rows = np.meshgrid(np.arange(300) + 0.5, np.arange(300) + 0.5)
    distance = np.cos(np.radians(degrees)) * (across - 150.3) + np.sin(np.radians(degrees)) * (rows - 150.3)
    edge, moved = (np.clip(distance + d + 0.5, 0, 1).astype(np.float32) for d in (0.0, shift))
    assert contour_shift(moved, edge, np.ones((300, 300), bool)) == pytest.approx(shift, rel=0.06, abs=0.05)


def test_what_is_masked_out_shifts_no_contour() -> None:
    mask = np.ones((200, 200), bool)
    mask[:, 120:] = False
    found = contour_shift(np.where(mask, disk(51), 1), np.where(mask, disk(50), 0), mask)
    assert found == pytest.approx(contour_shift(disk(51), disk(50), mask), rel=1e-6) and found == pytest.approx(1, rel=0.1)


def test_shift_and_footprint_are_in_texels() -> None:
    mask = np.ones((200, 200), bool)
    shifts = [metrics(disk(51), disk(50), mask, Texel(size, size), 3)["contour_shift_texels"] for size in (1.0, 4.0)]
    assert shifts[0] == pytest.approx(4 * shifts[1]) and shifts[0] == pytest.approx(1, rel=0.15)
    # Light as far from an edge as a filter of large texels reaches is no bleeding.
    leaking = np.maximum(disk(60), np.clip(disk(50), 0, 0.3))
    bleeding = [metrics(leaking, disk(60), mask, Texel(size, size), 3)["bleeding"] for size in (1.0, 4.0)]
    assert bleeding[0] > 0.04 and bleeding[1] == 0


def test_texels_are_measured_on_the_receiver(variant: str) -> None:
    """A floor under slanted light, of which the map covers more than the camera sees."""
    scene = maps_scenes.build("overlap", 64)
    renderer = maps._renderer(scene, "evsm4", MapsOptions(resolution=64, map_resolution=32))
    p_world = maps._positions(scene)
    texel = maps._texel("overlap", p_world, renderer, np.ones((64, 64), bool))
    dx, dy, dz = maps_scenes.SCENES["overlap"][1]
    # On the floor an area is as much larger as the light is slanted; pixels are all alike.
    half_x, half_y = float(renderer.frusta.half_x[0]), float(renderer.frusta.half_y[0])
    area = (2 * half_x / 32) * (2 * half_y / 32) * np.sqrt(dx**2 + dy**2 + dz**2) / abs(dy) / (2 * maps_scenes.HALF / 64) ** 2
    assert texel.size == pytest.approx(np.sqrt(area), rel=1e-3)
    assert texel.size < texel.longest < 1.5 * texel.size
    finer = texel_in_pixels(p_world, directional_view(mi.Vector3f(dx, dy, dz)), renderer.frusta, 64, np.ones((64, 64), bool))
    assert (finer.size, finer.longest) == pytest.approx((texel.size / 2, texel.longest / 2), rel=1e-4)


def test_metrics_tell_bleeding_from_acne() -> None:
    texel = Texel(2.0, 2.0)
    mask, reference = np.ones((200, 200), bool), disk(60)
    perfect = metrics(reference, reference, mask, texel, 3)
    assert all(perfect[name] == 0 for name in ("rmse", "rmse_shadowed", "bleeding", "acne", "contour_shift_texels"))
    bleeding = metrics(np.maximum(reference, 0.1), reference, mask, texel, 3)
    assert bleeding["bleeding"] == pytest.approx(0.1, rel=1e-3) and bleeding["acne"] == 0
    assert bleeding["rmse_shadowed"] == pytest.approx(0.1, rel=0.05)
    acne = metrics(np.minimum(reference, 0.95), reference, mask, texel, 3)
    assert acne["acne"] == pytest.approx(0.05, rel=1e-3) and acne["bleeding"] == 0
    # A blurred edge is neither.
    blurred = metrics(np.clip((disk(60) - 0.5) * 0.2 + 0.5 + 0.3 * (disk(60) - 0.5), 0, 1), reference, mask, texel, 3)
    assert blurred["contour_shift_texels"] == 0


@pytest.mark.parametrize("name", maps_scenes.SCENES)
def test_scenes_have_light_and_shadow(variant: str, name: str) -> None:
    reference, mask = maps.reference_visibility(maps_scenes.build(name, 48), 16)
    assert mask.mean() > 0.7
    assert 0.02 < (reference[mask] < 0.1).mean() < 0.9 and (reference[mask] > 0.9).mean() > 0.1


def test_small_run(variant: str, tmp_path: Path) -> None:
    options = MapsOptions(
        scenes=("overlap",),
        candidates=("plain vsm", "evsm4"),
        resolution=64,
        map_resolution=64,
        reference_spp=16,
        rounds=3,
        pose_runs=1,
        out=tmp_path / "m",
    )
    record = run_maps(options)
    stored = json.loads((tmp_path / "m" / "maps.json").read_text())
    assert {"shadowmap_dr", "machine", "settings"} <= stored.keys()
    assert stored["scenes"].keys() == {"overlap"} and (tmp_path / "m" / "maps.png").stat().st_size > 1000
    vsm, evsm = (record["scenes"]["overlap"][label] for label in ("plain vsm", "evsm4"))
    assert vsm["seconds_over_plain_vsm"] == 1 and np.isfinite(evsm["seconds"])
    assert evsm["rmse"] < vsm["rmse"] < 0.2
    assert min(vsm["derivative_cosine"], evsm["derivative_cosine"]) > 0.85
    # Maps of 64 texels are too coarse for the last tenth of a degree.
    assert all(entry["runs"] == 1 and entry["median_rotation_deg"] < 2 for entry in record["poses"].values())
    poses = maps.poses_table(record)
    assert maps.table(record).row_count == 2 and poses is not None and poses.row_count == 2


def test_scenes_follow_the_offset(variant: str) -> None:
    left, right = (mi.traverse(maps_scenes.build("fence", 16, x)) for x in (0.0, 0.25))
    moved = right["fence.vertex_positions"].numpy() - left["fence.vertex_positions"].numpy()
    np.testing.assert_allclose(moved.reshape(-1, 3), [[0.25, 0, 0]] * (len(moved) // 3), atol=1e-6)


@pytest.mark.parametrize(
    ("change", "word"), [({"scenes": ("moon",)}, "moon"), ({"candidates": ()}, "method"), ({"resolution": 4}, "resolution")]
)
def test_bad_options_are_named(change: dict[str, tuple[str, ...]], word: str) -> None:
    with pytest.raises(ShadowmapError, match=word):
        MapsOptions(**change)
