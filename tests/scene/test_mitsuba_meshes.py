"""Buffers of meshes by the names of Mitsuba 3.9, and by those of its development branch, for which a stand-in is here."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.scene.mitsuba_meshes import (
    has_reversed_faces,
    make_mesh,
    mesh_buffers,
    mesh_names,
    positions_in,
    set_positions,
)

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


class NextMesh:
    """A mesh as in Mitsuba's development branch: tensors, rows that vertices share, a constructor that takes the buffers."""

    def __init__(self, name: str, *, faces: Any, positions: Any, props: Any = None, position_index: Any = None) -> None:
        self._faces, self._positions, self._index = faces, positions, position_index

    def faces(self) -> Any:
        return self._faces

    def positions(self) -> Any:
        return self._positions

    def normals(self) -> Any:
        return mi.TensorXf(dr.zeros(mi.Float, 0), (0, 3))

    def texcoords(self) -> Any:
        return mi.TensorXf(dr.zeros(mi.Float, 0), (0, 2))

    def position_index(self) -> Any:
        return mi.UInt32() if self._index is None else self._index


@pytest.mark.parametrize("later", [False, True])
def test_buffers_of_a_new_mesh_are_those_given(variant: str, later: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if later:
        monkeypatch.setattr(mi, "Mesh", NextMesh)
    buffers = mesh_buffers(make_mesh("sheet", POINTS, FACES))
    np.testing.assert_array_equal(buffers.positions.numpy().reshape(-1, 3), POINTS)
    np.testing.assert_array_equal(buffers.faces.numpy().reshape(-1, 3), FACES)
    assert len(buffers.normals) == len(buffers.texcoords) == 0
    assert [type(buffer) for buffer in buffers] == [mi.UInt32, mi.Float, mi.Float, mi.Float]


def test_names_follow_the_version(variant: str) -> None:
    mesh = make_mesh("sheet", POINTS, FACES)
    table = mi.traverse(mesh)
    assert mesh_names(mesh).positions == "vertex_positions"
    assert mesh_names(mesh).positions in table
    later = NextMesh("sheet", faces=mi.TensorXu(FACES), positions=mi.TensorXf(POINTS))
    assert tuple(mesh_names(later)) == ("positions", "normals", "texcoords")


def test_shared_rows_are_given_to_each_vertex_and_gather_its_gradients(variant: str) -> None:
    """Two vertices of one position: its gradient is the sum of theirs."""
    rows = mi.TensorXf(POINTS)
    dr.enable_grad(rows)
    mesh = NextMesh("sheet", faces=mi.TensorXu(FACES), positions=rows, position_index=mi.UInt32([0, 1, 2, 3, 1]))
    positions = mesh_buffers(mesh).positions
    np.testing.assert_array_equal(positions.numpy().reshape(-1, 3), POINTS[[0, 1, 2, 3, 1]])
    dr.backward(dr.sum(positions * dr.arange(mi.Float, 15)))
    np.testing.assert_allclose(np.array(dr.grad(rows))[1], [3 + 12, 4 + 13, 5 + 14])


def test_flipped_normals_count_once(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The development branch reverses the faces of a mesh itself; other shapes keep the flag."""
    sphere = mi.load_dict({"type": "sphere", "flip_normals": True})
    cube = mi.load_dict({"type": "cube", "flip_normals": True})
    assert has_reversed_faces(sphere)
    assert has_reversed_faces(cube)
    monkeypatch.setattr(mi, "Mesh", NextMesh)
    assert has_reversed_faces(sphere)
    assert not has_reversed_faces(NextMesh("sheet", faces=mi.TensorXu(FACES), positions=mi.TensorXf(POINTS)))


class Table(dict):
    """Parameters of a scene of the development branch."""


@pytest.mark.parametrize("shape", ["", "box"])
def test_vertices_of_a_table_are_read_and_written_in_its_own_form(variant: str, shape: str) -> None:
    flat = mi.Float(POINTS.ravel())
    scene = mi.load_dict({"type": "scene", "box": make_mesh("box", POINTS, FACES)}, optimize=False)
    now = mi.traverse(scene if shape else scene.shapes()[0])
    name = f"{shape}.positions".lstrip(".")
    later = Table({name: mi.TensorXf(POINTS)})
    for table in (now, later):
        np.testing.assert_array_equal(positions_in(table, shape).numpy(), POINTS.ravel())
        set_positions(table, 2 * flat, shape)
        np.testing.assert_array_equal(positions_in(table, shape).numpy(), 2 * POINTS.ravel())
    assert later[name].shape == (4, 3)
