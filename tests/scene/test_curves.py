"""Curves as tubes, before anything is rendered: against Mitsuba's rays, their topology, derivatives and bad input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients.scenes import camera, curve, floor, sun

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.raster.topology import NO_VERTEX, build_topology
from shadowmap_dr.scene.load import load, refresh
from shadowmap_dr.scene.shapes.curves import check_control_points
from shadowmap_dr.scene.shapes.sources import CurveSource, source_of

KINDS = ["bsplinecurve", "linearcurve"]
# No bend so sharp that one side of the tube lies in another part of it. The direction passes close by z.
GENTLE = [(-1.0, 0.3, 0.5, 0.05), (-0.4, 0.4, 0.0, 0.07), (0.3, 0.4, 0.1, 0.1), (0.8, 0.3, 0.9, 0.06), (0.75, 0.6, 1.7, 0.05)]
# Straight up, over and down again, in a plane that holds z.
STRAIGHT = [(x, 0, 0, 0.1) for x in range(4)]
ARCH = [(-1, 0, -2, 0.1), (-1, 0, -1, 0.1), (-1, 0, 0, 0.1), (-1, 0, 1, 0.1), (1, 0, 1, 0.1), (1, 0, 0, 0.1), (1, 0, -1, 0.1)]


def curve_source(kind: str, points: Any, tessellation: int = 32) -> tuple[CurveSource, np.ndarray]:
    return source_of("wire", curve(kind, "wire", points), None, tessellation)


def vertices(source: CurveSource) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions and normals (R, N + 1, 3), texture coordinates (R, N + 1, 2)."""
    own = source.own()
    arrays = (own.positions, own.normals, own.texcoords)
    count = source.layout.corners + 1
    return tuple(a.numpy().reshape(-1, count, width) for a, width in zip(arrays, (3, 3, 2), strict=True))


def joints(source: CurveSource) -> np.ndarray:
    """Circles that lie between two cones, of which one side is inside of them."""
    return getattr(source.plan, "before", mi.UInt32(0)).numpy() != getattr(source.plan, "after", mi.UInt32(0)).numpy()


@pytest.mark.parametrize("kind", KINDS)
def test_vertices_are_where_mitsubas_rays_hit(variant: str, kind: str) -> None:
    scene = mi.load_dict({"type": "scene", "wire": curve(kind, "wire", GENTLE)})
    source, _ = source_of("wire", scene.shapes()[0], None, 32)
    p, n, uv = (a.reshape(-1, a.shape[-1]).T for a in vertices(source))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(p) + 0.02 * mi.Vector3f(n), -mi.Vector3f(n)))
    off = np.abs(si.t.numpy() - 0.02)
    inner = np.repeat(np.broadcast_to(joints(source), source.layout.v.numpy().shape), source.layout.corners + 1)
    pole = np.repeat(source.layout.shift.numpy() > 0, source.layout.corners + 1)
    # Rays to a rim or a pole miss by rounding; the side of a joint that lies in the cones is not to be seen.
    use = ~inner & ~pole & si.is_valid().numpy() & (off < 0.01)
    assert use.sum() > 0.8 * np.sum(~inner & ~pole)
    assert off[use].max() < 1e-5
    assert np.linalg.norm(si.n.numpy() - n, axis=0)[use].max() < 2e-3
    difference = si.uv.numpy() - uv
    difference[0] -= np.round(difference[0])
    assert np.abs(difference[:, use]).max() < 1e-3
    # On the outer side of joints, too.
    outer = inner & si.is_valid().numpy() & (off < 1e-3)
    assert kind == "bsplinecurve" or outer.sum() > 0.3 * inner.sum()


@pytest.mark.parametrize("points", [GENTLE, ARCH], ids=["gentle", "arch"])
@pytest.mark.parametrize("kind", KINDS)
def test_tubes_do_not_twist(variant: str, kind: str, points: Any) -> None:
    """From a circle to the next each corner turns with the curve and no more; the last corner is the first."""
    source, _ = curve_source(kind, points)
    p, _, uv = vertices(source)
    centre = p[:, :-1].mean(1, keepdims=True)
    proper = source.layout.shift.numpy() == 0
    outward = (p - centre)[proper]
    outward /= np.linalg.norm(outward, axis=-1, keepdims=True)
    between = np.einsum("rkc,rkc->rk", outward[1:], outward[:-1])
    normal = np.cross(outward[:, 0], outward[:, outward.shape[1] // 4])
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    bend = np.einsum("rc,rc->r", normal[1:], normal[:-1])
    assert (np.arccos(np.clip(between, -1, 1)) <= np.arccos(np.clip(bend, -1, 1))[:, None] + 2e-3).all()
    assert np.array_equal(p[:, 0], p[:, -1])
    # Texture coordinates do not jump.
    assert np.abs(np.diff(uv[..., 0], axis=0)).max() < 0.6 and np.allclose(np.diff(uv[..., 0], axis=1), 1 / source.layout.corners)


@pytest.mark.parametrize("points", [GENTLE, STRAIGHT], ids=["bent", "straight"])
@pytest.mark.parametrize("kind", KINDS)
def test_topology(variant: str, kind: str, points: Any) -> None:
    """B-splines are open at both ends, linear curves nowhere; no two circles coincide, and faces look outwards."""
    source, faces = curve_source(kind, points)
    p, n, _ = (a.reshape(-1, a.shape[-1]) for a in vertices(source))
    topology = build_topology(faces, p, mi.UInt32)
    opened = np.sum(topology.opposite.numpy().reshape(-1, 2)[:, 1] == NO_VERTEX)
    assert opened == (2 * source.layout.corners if kind == "bsplinecurve" else 0)
    corners = p[faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normal, axis=1)
    assert size.min() > 1e-7
    inside = np.broadcast_to(joints(source), source.layout.v.numpy().shape)[faces // (source.layout.corners + 1)].any(1)
    facing = (normal / size[:, None] * n[faces].mean(1)).sum(1)
    assert facing[~inside].min() > 0.8
    assert kind == "bsplinecurve" or 0.3 < inside.mean() < 0.8


def test_joints_do_not_show_on_a_straight_curve(variant: str) -> None:
    source, _ = curve_source("linearcurve", STRAIGHT)
    p, n, _ = vertices(source)
    sides = source.plan.cap.numpy() == 0
    assert sides.sum() > 10 and np.abs(n[sides][..., 0]).max() < 1e-6
    assert np.linalg.norm(p[sides][..., 1:], axis=-1) == pytest.approx(0.1, rel=2e-3)


def test_several_curves_are_not_joined(variant: str) -> None:
    blocks = [GENTLE, [(x + 3, y, z, r) for x, y, z, r in GENTLE]]
    for kind in KINDS:
        both = curve(kind, "wires", [*blocks[0], (), *blocks[1]])
        alone, alone_faces = curve_source(kind, GENTLE)
        source, faces = source_of("wires", both, None, 32)
        assert len(faces) == 2 * len(alone_faces)
        p, q = vertices(source)[0], vertices(alone)[0]
        assert np.allclose(p[: len(q)], q, atol=1e-6) and np.allclose(p[len(q) :], q + [3, 0, 0], atol=1e-6)
        assert np.allclose(vertices(source)[2][-1, 0, 1], 1) and np.allclose(vertices(source)[2][len(q) - 1, 0, 1], 0.5)


@pytest.mark.parametrize("kind", KINDS)
def test_surfaces_move_with_control_points(variant: str, kind: str) -> None:
    """Derivatives of vertices along the normal against differences. Along the surface vertices may slide: nobody sees it."""
    shape = curve(kind, "wire", GENTLE)
    source, _ = source_of("wire", shape, None, 32)
    params = mi.traverse(shape)
    rest = mi.Float(params["control_points"])
    way = mi.Float(np.random.default_rng(0).normal(size=dr.width(rest)).astype(np.float32) * np.tile([1, 1, 1, 0.2], len(GENTLE)))

    def at(t: Any) -> Any:
        params["control_points"] = rest + t * way
        params.update()
        return source.own()

    step = 2e-3
    p0, p1 = (vertices_of(at(mi.Float(t))) for t in (-step, step))
    normals = at(mi.Float(0)).normals.numpy().reshape(-1, 3)
    t = mi.Float(0)
    dr.enable_grad(t)
    attached = at(t).positions
    dr.forward(t)
    derivative = dr.grad(attached).numpy().reshape(-1, 3)
    along = (derivative * normals).sum(1)
    difference = ((p1 - p0) / (2 * step) * normals).sum(1)
    # The circles of a joint lie a little inside of the cones: their vertices slide across the surface's normal, too.
    tolerance = 0.01 if kind == "bsplinecurve" else 0.1
    assert np.abs(along - difference).max() < tolerance * np.abs(difference).max()
    assert np.linalg.norm(along - difference) < 0.03 * np.linalg.norm(difference)


def vertices_of(buffers: Any) -> np.ndarray:
    return buffers.positions.numpy().reshape(-1, 3)


DEGENERATE = {
    "ends given three times": [GENTLE[0]] * 3 + GENTLE + [GENTLE[-1]] * 3,
    "all at one place": [(0, 0, 0, 0.1)] * 5,
    "straight up": [(0, 0, z, 0.1) for z in range(5)],
    "there and back": [(0, 0, 0, 0.1), (1, 0, 0, 0.1), (0, 0, 0, 0.1), (1, 0, 0, 0.2), (0, 0, 0, 0.1)],
    "one sphere in another": [(0, 0, 0, 1.0), (0.1, 0, 0, 0.2), (0.2, 0.1, 0, 0.1), (3, 0, 0, 0.1)],
    "points": [(-1, 0, 0, 0.0), (0, 0.1, 0, 0.1), (1, 0, 0, 0.1), (2, 0, 0, 0.0)],
}


@pytest.mark.parametrize("points", DEGENERATE.values(), ids=DEGENERATE)
@pytest.mark.parametrize("kind", KINDS)
def test_degenerate_curves_are_finite(variant: str, kind: str, points: Any) -> None:
    shape = curve(kind, "wire", points)
    params = mi.traverse(shape)
    control_points = mi.Float(params["control_points"])
    dr.enable_grad(control_points)
    params["control_points"] = control_points
    params.update()
    source, _ = source_of("wire", shape, None, 16)
    own = source.own()
    assert np.allclose(np.linalg.norm(own.normals.numpy().reshape(-1, 3), axis=1), 1, atol=1e-4)
    assert np.isfinite(own.positions.numpy()).all() and np.isfinite(own.texcoords.numpy()).all()
    dr.backward(dr.sum(own.positions) + dr.sum(own.normals))
    assert np.isfinite(control_points.grad.numpy()).all() and np.any(control_points.grad.numpy())


def test_ends_given_three_times_have_the_curves_direction(variant: str) -> None:
    end, other = (0, 0, 0, 0.1), (1, 2, 3, 0.1)
    source, _ = curve_source("bsplinecurve", [end] * 3 + [other] * 3)
    p, n, _ = vertices(source)
    for circle in (0, -1):
        axis = np.cross(p[circle, 1] - p[circle, 0], p[circle, 3] - p[circle, 0])
        assert abs(axis @ (1, 2, 3)) / np.linalg.norm(axis) / np.sqrt(14) > 0.9999
        centre = np.array(other if circle else end)[:3]
        assert np.allclose(p[circle] - centre, 0.1 * n[circle], atol=1e-5)


def test_radius_and_place_are_read_again_through_an_instance(variant: str) -> None:
    group = {"type": "shapegroup", "wire": curve("linearcurve", "wire", GENTLE)}
    place = mi.ScalarTransform4f().translate([0, 2, 0]).scale([1, 1, -2])
    copy = {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}
    scene = mi.load_dict({"type": "scene", "group": group, "copy": copy})
    data = load(scene)
    (info,) = data.geometry.shapes
    assert info.flip_geometric and not info.flip_shading
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("control_points"))
    shift = mi.Float(0.25)
    dr.enable_grad(shift)
    points = params[key].numpy().reshape(-1, 4)
    params[key] = mi.Float(points.ravel()) + shift * mi.Float(np.tile([0, 0, 1, 0], len(points)).astype(np.float32))
    params.update()
    moved = refresh(data).geometry.positions
    difference = (moved - data.geometry.positions).numpy().reshape(-1, 3)
    assert np.allclose(difference, [0, 0, -0.5], atol=1e-5)
    dr.backward(dr.sum(moved))
    assert np.allclose(shift.grad.numpy(), -2 * info.vertex_count, rtol=1e-4)


def test_tessellation_of_curves(variant: str) -> None:
    shape = curve("bsplinecurve", "wire", GENTLE)  # two segments
    for tessellation, around, along in ((64, 32, 8), (16, 8, 2), (3, 3, 1)):
        source, faces = source_of("wire", shape, None, tessellation)
        assert source.layout.corners == around and len(faces) == 2 * 2 * along * around


def test_broken_curves_are_named(variant: str) -> None:
    points, segments = np.array(GENTLE), np.array([0, 1])
    check_control_points("wire", points, segments, 4)
    with pytest.raises(ShadowmapError, match="Segment 1 of curve 'wire' needs 5 control points, but there are only 4"):
        check_control_points("wire", points[:4], segments, 4)
    with pytest.raises(ShadowmapError, match="'wire' has no segments"):
        check_control_points("wire", points, segments[:0], 4)
    wanted = ((1, np.nan, "Control point 2 of curve 'wire'.*finite"), (3, -0.1, "point 2 of curve 'wire' has the radius -0.1"))
    for column, value, match in wanted:
        wrong = points.copy()
        wrong[2, column] = value
        with pytest.raises(ShadowmapError, match=match):
            check_control_points("wire", wrong, segments, 4)
    with pytest.raises(ShadowmapError, match="'wire' has the radius 0 at all control points"):
        check_control_points("wire", points * [1, 1, 1, 0], segments, 4)


def test_broken_curves_are_refused_when_they_are_loaded(variant: str) -> None:
    scene = mi.load_dict({"type": "scene", "wire": curve("linearcurve", "wire", GENTLE)})
    params = mi.traverse(scene)
    points = params["wire.control_points"].numpy().copy()
    points[4] = np.nan
    params["wire.control_points"] = mi.Float(points)
    params.update()
    with pytest.raises(ShadowmapError, match="Control point 1 of curve 'wire'"):
        load(scene)


def test_another_number_of_control_points_is_refused(variant: str) -> None:
    source, _ = curve_source("bsplinecurve", GENTLE)
    with pytest.raises(ShadowmapError, match="'wire' now has 5 control points instead of 9: load the scene again"):
        replace(source, count=9).own()


@pytest.mark.parametrize("kind", KINDS)
def test_renderer_gives_the_vertices_for_control_points(variant: str, kind: str) -> None:
    """The vertices that Mitsuba's parameters would give, attached; in a rendering, the same image but for a mesh's normals."""
    parts = {"camera": camera(32), "wire": curve(kind, "wire", GENTLE), "sun": sun(), "floor": floor()}
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    renderer = Renderer.from_scene(scene, shadow_map_resolution=64)
    params = mi.traverse(scene)
    bent = mi.Float(params["wire.control_points"])
    bent += 0.1 * dr.sin(mi.Float(dr.arange(mi.UInt32, dr.width(bent)))) * mi.Float([1, 1, 1, 0] * len(GENTLE))
    dr.enable_grad(bent)
    p = renderer.curve_vertices("wire", bent)
    image = renderer.render(vertex_positions={"wire": p})
    params["wire.control_points"] = dr.detach(bent)
    params.update()
    expected = Renderer.from_scene(scene, shadow_map_resolution=64)
    assert np.array_equal(p.numpy(), expected.data.geometry.shape_positions("wire").numpy().T.ravel())
    assert np.abs(image.numpy() - expected.render().numpy()).mean() < 0.05 * image.numpy().mean()
    dr.backward(dr.sum(p))
    slope = dr.grad(bent).numpy().reshape(-1, 4)
    vertices_each = len(p) // 3
    assert slope[:, 0].sum() == pytest.approx(vertices_each, rel=1e-3)  # moving all points moves all vertices
    with pytest.raises(ShadowmapError, match="Shape 'floor' is no curve"):
        renderer.curve_vertices("floor", bent)
    with pytest.raises(ShadowmapError, match=f"8 numbers for curve 'wire': give x, y, z and radius of {len(GENTLE)}"):
        renderer.curve_vertices("wire", mi.Float(np.zeros(8)))
