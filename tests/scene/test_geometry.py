"""The merged triangle soup: replacing positions, vertex normals, gradients."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import small_scene

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.io import assets
from shadowmap_dr.jit.broadcast import broadcast_differentiable
from shadowmap_dr.jit.vectors import normalize_or
from shadowmap_dr.scene.geometry import vertex_normals
from shadowmap_dr.scene.load import SceneData, load


def two_shapes() -> SceneData:
    """A cube (24 vertices, with normals) between a flat mesh without normals and a rectangle."""
    flat = {"type": "ply", "filename": str(assets.mesh("teapot")), "face_normals": True}
    scene = mi.load_dict({"type": "scene", "flat": flat, "box": {"type": "cube"}, "wall": {"type": "rectangle"}}, optimize=False)
    return load(scene)


@pytest.mark.parametrize("mesh", ["bunny", "spot", "teapot", "drape"])
def test_vertex_normals_are_mitsubas(variant: str, mesh: str) -> None:
    shape = mi.load_dict({"type": "ply", "filename": str(assets.mesh(mesh))})
    faces = dr.unravel(mi.Vector3u, mi.UInt32(shape.faces_buffer()))
    ours = vertex_normals(mi.Float(shape.vertex_positions_buffer()), faces, shape.vertex_count()).numpy()
    shape.recompute_vertex_normals()
    assert np.allclose(ours, shape.vertex_normals_buffer().numpy(), atol=1e-5)


def test_vertex_normals_of_degenerate_faces(variant: str) -> None:
    positions = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0, 2, 0, 0, 5, 5, 5])
    dr.enable_grad(positions)
    normals = vertex_normals(positions, mi.Vector3u([0, 0, 1], [1, 1, 1], [2, 3, 1]), 5)
    assert np.allclose(normals.numpy().reshape(5, 3), [[0, 0, 1]] * 3 + [[1, 0, 0]] * 2)
    dr.backward(dr.sum(normals * dr.arange(mi.Float, 15)))
    assert np.all(np.isfinite(positions.grad.numpy()))


def test_vertex_normal_gradient(variant: str) -> None:
    data = two_shapes()
    start = data.geometry.shape_positions("box")
    wave = dr.sin(3 * start.yzx) if hasattr(start, "yzx") else dr.sin(3 * mi.Point3f(start.y, start.z, start.x))
    weight = mi.Normal3f(np.random.default_rng(1).normal(size=(3, 24)))

    def total(x: Any) -> Any:
        moved = data.geometry.with_positions({"box": start + x * wave})
        own = dr.arange(mi.UInt32, 24) + data.geometry.shape("box").vertex_start
        return dr.sum(dr.dot(dr.gather(mi.Normal3f, moved.normals, own), weight))

    x = mi.Float(0.2)
    dr.enable_grad(x)
    dr.backward(total(x))
    difference = (total(mi.Float(0.21)) - total(mi.Float(0.19))) / 0.02
    assert np.allclose(x.grad.numpy(), difference.numpy(), rtol=1e-2)


@pytest.mark.parametrize("form", ["flat", "tensor", "points", "numpy"])
def test_with_positions(variant: str, form: str) -> None:
    data = two_shapes()
    geometry = data.geometry
    info = geometry.shape("box")
    own = slice(3 * info.vertex_start, 3 * (info.vertex_start + info.vertex_count))
    target = np.random.default_rng(2).normal(size=(24, 3)).astype(np.float32)
    value = {
        "flat": lambda: mi.Float(target.ravel()),
        "tensor": lambda: mi.TensorXf(target),
        "points": lambda: mi.Point3f(target.T),
        "numpy": lambda: target,
    }[form]()
    before = geometry.positions.numpy().copy()
    moved = geometry.with_positions({"box": value})
    expected = before.copy()
    expected[own] = target.ravel()
    assert np.array_equal(moved.positions.numpy(), expected)
    assert np.array_equal(geometry.positions.numpy(), before)
    normals = moved.normals.numpy()
    others = np.ones(len(normals), bool)
    others[own] = False
    assert np.array_equal(normals[others], geometry.normals.numpy()[others])
    faces = data.sources[geometry.shapes.index(info)].shape.faces_buffer().numpy().reshape(-1, 3)
    p = target[faces]
    face_normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    # Two triangles of a cube's side share four vertices; check one corner that belongs to a single triangle.
    corner, count = np.unique(faces, return_counts=True)
    lone = corner[count == 1][0]
    face = np.flatnonzero((faces == lone).any(1))[0]
    assert np.allclose(normals[own].reshape(-1, 3)[lone], face_normal[face] / np.linalg.norm(face_normal[face]), atol=1e-5)


def test_several_shapes_and_gradients(variant: str) -> None:
    geometry = two_shapes().geometry
    names = [info.name for info in geometry.shapes]
    x, y = mi.Float(0.1), mi.Float(0.2)
    dr.enable_grad(x, y)
    start = {name: geometry.shape_positions(name) for name in names}
    moved = geometry.with_positions(
        {"box": start["box"] + mi.Vector3f(x, 0, 0), "wall": start["wall"] + mi.Vector3f(0, 2 * y, x)}
    )
    shift = (moved.positions - geometry.positions).numpy().reshape(-1, 3)
    for name, expected in {"box": [0.1, 0, 0], "wall": [0, 0.4, 0.1], "flat": [0, 0, 0]}.items():
        info = geometry.shape(name)
        assert np.allclose(shift[info.vertex_start : info.vertex_start + info.vertex_count], expected, atol=1e-6)
    dr.backward(dr.sum(moved.positions))
    assert np.allclose([x.grad[0], y.grad[0]], [24 + 4, 2 * 4])


def test_frozen_with_positions_and_uniform_value(variant: str) -> None:
    data = two_shapes()

    @dr.freeze
    def move(geometry: Any, x: Any) -> Any:
        return geometry.with_positions({"box": geometry.shape_positions("box") * x}).positions

    for i in range(5):
        x = mi.Float(1.0 + i)
        dr.make_opaque(x)
        result = move(data.geometry, x)
        if i == 2:
            recordings = move.n_recordings
    assert move.n_recordings == recordings
    info = data.geometry.shape("box")
    own = slice(3 * info.vertex_start, 3 * (info.vertex_start + info.vertex_count))
    assert np.allclose(result.numpy()[own], 5 * data.geometry.positions.numpy()[own])
    collapsed = data.geometry.with_positions({"box": mi.Point3f(1, 2, 3)}).positions.numpy()[own]
    assert np.array_equal(collapsed.reshape(-1, 3), [[1, 2, 3]] * 24)


@pytest.mark.parametrize("size", [23, 25])
def test_wrong_sizes_are_named(variant: str, size: int) -> None:
    geometry = two_shapes().geometry
    wrong = [
        dr.zeros(mi.Float, 3 * size),
        dr.zeros(mi.Point3f, size),
        dr.zeros(mi.TensorXf, (size, 3)),
        dr.zeros(mi.TensorXf, (3, 24)),
        "ball.ply",
        [[0, 1], [2]],
    ]
    for value in wrong:
        with pytest.raises(ShadowmapError, match="'box'"):
            geometry.with_positions({"box": value})
    with pytest.raises(ShadowmapError, match="'sphere'.*'box'"):
        geometry.with_positions({"sphere": dr.zeros(mi.Float, 3)})


def test_normalize_or(variant: str) -> None:
    vector = mi.Vector3f([0, 3], [0, 0], [0, 4])
    dr.enable_grad(vector)
    unit = normalize_or(vector, mi.Vector3f(0, 0, 1))
    assert np.allclose(unit.numpy().T, [[0, 0, 1], [0.6, 0, 0.8]])
    dr.backward(dr.sum(unit.x))
    assert np.allclose(vector.grad.numpy().T, [[0, 0, 0], [(1 - 0.36) / 5, 0, -0.48 / 5]])


@pytest.mark.parametrize("width", [1, 1000])
def test_spread_changes_neither_values_nor_gradients(variant: str, width: int) -> None:
    direction, matrix, angle = mi.Vector3f(1, 2, 3), mi.Matrix4f(np.arange(16.0).reshape(4, 4)), mi.Float(20.0)
    dr.make_opaque(direction, matrix, angle)
    lane = dr.linspace(mi.Float, 0, 1, width) if width > 1 else mi.Float(0.5)
    grads = []
    for use in (False, True):
        parts = [dr.detach(direction), dr.detach(matrix), dr.detach(angle)]
        dr.enable_grad(parts)
        turn = mi.Transform4f().rotate([0, 0.6, 0.8], parts[2])
        record = {"d": parts[0], "nested": (parts[1], turn, "name", 3, lane)}
        if use:
            record = broadcast_differentiable(record, width)
        assert np.allclose(record["d"].numpy().reshape(3, -1)[:, -1], [1, 2, 3])
        m, t, *_ = record["nested"]
        value = dr.dot(record["d"], mi.Vector3f(lane, lane**2, 1)) * m[1, 2] + lane * m[0, 3] + t.matrix[0, 1] * lane
        dr.backward(dr.sum(value))
        grads.append(np.concatenate([dr.grad(part).numpy().ravel() for part in parts]))
    assert np.any(grads[0] != 0)
    assert np.allclose(grads[0], grads[1], rtol=1e-4)


def mirrored(kind: str) -> dict[str, Any]:
    """A shape as parts of a scene, through a transformation that mirrors it."""
    T = mi.ScalarTransform4f
    place = T().translate([0, 0, 0.8]).rotate([1, 0.3, 0], 40).scale([-0.6, 0.6, 0.6])
    if kind != "instance":
        return {"mirrored": {"type": kind, "to_world": place, "bsdf": {"type": "diffuse"}}}
    group = {"type": "shapegroup", "ball": {"type": "ply", "filename": str(assets.mesh("suzanne")), "bsdf": {"type": "diffuse"}}}
    return {"group": group, "mirrored": {"type": "instance", "group": {"type": "ref", "id": "group"}, "to_world": place}}


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk", "rectangle", "instance"])
def test_normals_of_mirrored_shapes_stay_on_their_side(variant: str, kind: str) -> None:
    """Vertices that are replaced by the very same ones change nothing."""
    made = small_scene(ball=None, **mirrored(kind))
    renderer = Renderer.from_scene(made, shadow_method="none")
    (name,) = (shape.name for shape in renderer.data.geometry.shapes if shape.name.startswith("mirrored"))
    expected = np.array(renderer.render())
    same = renderer.render(vertex_positions={name: renderer.data.geometry.shape_positions(name)})
    # Mitsuba's normals of the mesh are summed in another order.
    np.testing.assert_allclose(np.array(same), expected, atol=0.01 if kind in ("sphere", "cylinder") else 1e-3)
