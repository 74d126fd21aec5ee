"""Faces that hide their backs: which they are, and that leaving out the backs changes nothing."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from shadowmap_dr.experiments.lights.scene import make_scene, target_and_starts
from shadowmap_dr.inverse import LightBatch, StillScene
from shadowmap_dr.raster import build_topology, drawing_order, outward_faces
from shadowmap_dr.rendering.renderer import Renderer

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
OUTWARD = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def found(faces: np.ndarray, positions: np.ndarray) -> list[bool]:
    return outward_faces(build_topology(faces, positions, mi.UInt32), positions).tolist()


def test_closed_parts_that_are_turned_outwards() -> None:
    assert found(OUTWARD, CORNERS) == [True] * 4
    assert found(OUTWARD, CORNERS + 1000) == [True] * 4
    assert found(OUTWARD[:, ::-1], CORNERS) == [False] * 4
    assert found(OUTWARD[:3], CORNERS) == [False] * 3
    one_turned = OUTWARD.copy()
    one_turned[2] = one_turned[2, ::-1]
    assert found(one_turned, CORNERS) == [False] * 4
    # Two faces on one: an edge with three.
    assert found(np.concatenate([OUTWARD, OUTWARD[:1]]), CORNERS) == [False] * 5
    both = np.concatenate([OUTWARD, OUTWARD[:3] + 4])
    assert found(both, np.concatenate([CORNERS, CORNERS + 5])) == [True] * 4 + [False] * 3
    # Corners that lie at the same place are one.
    assert found(np.arange(12).reshape(4, 3), CORNERS[OUTWARD].reshape(-1, 3)) == [True] * 4


@pytest.mark.parametrize("name", ["bunny", "hand", "spot"])
def test_images_are_the_same_without_backs(name: str) -> None:
    scene = StillScene.of(Renderer.from_scene(make_scene(name, 1, 64), shadow_method="vsm", shadow_map_resolution=128))
    hidden = np.array(scene.outward)
    assert hidden.sum() > 2000 and not hidden.all()  # not the floor
    lights = np.stack([target_and_starts(0, run, 1, cone_deg=120)[0] for run in range(6)])
    images = LightBatch(scene).render(lights)
    complete = LightBatch(dataclasses.replace(scene, outward=mi.Bool(np.zeros(len(hidden), bool)))).render(lights)
    # A texel on an outline may see the back of a fold that is turned inside out.
    difference = np.abs(images - complete).max(-1)
    assert (difference > 1e-3).mean() < 2e-4 and difference.mean() < 1e-5
    # The other way round it does matter.
    backs = LightBatch(dataclasses.replace(scene, faces=_reversed(scene.faces))).render(lights)
    assert np.abs(backs - complete).mean() > 1e-4


def _reversed(faces: mi.UInt32) -> mi.UInt32:
    corner = dr.arange(mi.UInt32, dr.width(faces))
    return dr.gather(mi.UInt32, faces, corner // 3 * 3 + (2 - corner % 3))


def test_neighbours_in_drawing_order_face_the_same_way_and_have_the_same_size():
    mesh = trimesh.creation.icosphere(3)
    scattered = np.random.default_rng(0).permutation(mesh.faces)
    a, b, c = (mesh.vertices[scattered[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    turned = normal @ [0.3, 0.8, -0.5] > 0

    def packets(order: np.ndarray) -> tuple[float, float]:
        """Share of packets that face one way only, and by how much the sizes of a packet differ."""
        packets = order[: len(order) // 16 * 16].reshape(-1, 16)
        alike = turned[packets].all(1) | ~turned[packets].any(1)
        return alike.mean(), np.median(size[packets].max(1) / size[packets].min(1)) - 1

    order = drawing_order(scattered, mesh.vertices)
    assert sorted(order) == list(range(len(order)))
    (alike, spread), (before, spread_before) = packets(order), packets(np.arange(len(order)))
    assert alike > 0.5 > 0.1 > before and spread < 0.5 * spread_before
