"""Shapes that can cast a shadow, beside a look at all corners of all boxes with NumPy."""

from __future__ import annotations

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr.shadow import Boxes, casting_shapes, cube_views, directional_view, receiving_shapes, stack_views
from shadowmap_dr.shadow.caster_bounds import BORDER, ROUNDING, SUNK, SUNK_UNSEEN, TOUCH

Array = npt.NDArray[np.float64]


def walls(generator: np.random.Generator, count: int) -> tuple[Array, Array, Array, Array]:
    """(low, high, normals, planar) of boxes in a room of side 5.2: a third are walls; many others sink in one."""
    centre, half = generator.uniform(-1.5, 1.5, (count, 3)), generator.uniform(0.05, 1, (count, 3))
    axis, planar, side = generator.integers(0, 3, count), np.arange(count) % 3 == 0, generator.choice([-1.0, 1.0], count)
    row = np.arange(count)
    sinks = ~planar & (generator.uniform(size=count) < 0.4)
    depth = generator.uniform(0, 0.4, count) * half[row, axis]
    centre[row, axis] = np.where(sinks, side * (2.6 - half[row, axis] + depth), centre[row, axis])
    centre[planar], half[planar] = 0, 2.6
    centre[row, axis] = np.where(planar, side * generator.choice([2.6, 2.6, 1.8], count), centre[row, axis])
    half[planar, axis[planar]] = 0
    normals = np.eye(3)[axis] * generator.choice([-1, 1], (count, 1))
    return centre - half, centre + half, normals, planar


def brute_force(
    low: Array, high: Array, normals: Array, planar: Array, forward: Array, eyes: Array | None = None, opaque: Array | None = None
) -> Array:
    """(S,) mask: a planar shape casts shadows on what lies behind it, as seen along a direction."""
    casts = ~planar
    for own in np.flatnonzero(planar):
        normal, point = normals[own], 0.5 * (low[own] + high[own])
        behind = -normal if normal @ -forward > 0 else normal
        for other in set(range(len(low))) - {own}:
            corners = np.array(list(itertools.product(*zip(low[other], high[other], strict=True))))
            depth = (corners - point) @ behind
            touch = TOUCH * min(np.max(high[k] - low[k]) for k in (own, other)) + ROUNDING * np.abs(corners).max()
            room = np.abs(normal) * np.max(high[other] - low[other])
            border = BORDER * (high[own] - low[own])
            stands = ((low[other] >= low[own] + border - room) & (high[other] <= high[own] - border + room)).all()
            unseen = eyes is not None and (opaque is None or opaque[own])
            for eye in () if eyes is None else eyes:
                unseen &= hides(point, -behind, low[own] + border, high[own] - border, corners[depth > 0], eye)
            share = 0 if not stands else SUNK_UNSEEN if unseen else SUNK
            casts[own] |= depth.max() - share * np.ptp(depth) > touch
    return casts


def hides(point: Array, normal: Array, low: Array, high: Array, behind: Array, eye: Array) -> bool:
    """True if a wall lies between a camera and all points behind it. ``eye`` (4,): homogeneous."""
    if normal @ (eye[:3] - eye[3] * point) <= 0:
        return False
    for place in behind:
        towards = eye[:3] - eye[3] * place
        share = normal @ (point - place) / (normal @ towards)
        through = place + share * towards
        along = normal == 0
        if not ((through >= low) & (through <= high))[along].all():
            return False
    return True


def arrays(low: Array, high: Array, normals: Array, planar: Array) -> tuple[tuple[mi.Normal3f, mi.Point3f], mi.Bool, Boxes]:
    points = [mi.Point3f(values.T.astype(np.float32)) for values in (low, high, 0.5 * (low + high))]
    return (mi.Normal3f(normals.T.astype(np.float32)), points[2]), mi.Bool(planar), Boxes(points[0], points[1])


def test_walls_cast_shadows_on_what_is_behind_them(variant: str) -> None:
    flat = []
    for seed in range(8):
        generator = np.random.default_rng(seed)
        room = walls(generator, 12)
        forward = generator.normal(size=(2, 3))
        views = stack_views([directional_view(mi.Vector3f(*direction)) for direction in forward.tolist()])
        found = casting_shapes(views, *arrays(*room)).numpy().reshape(2, -1)
        expected = np.stack([brute_force(*room, direction) for direction in forward])
        assert np.array_equal(found, expected)
        flat.append(expected[:, room[3]])
    assert 0.1 < np.mean(flat) < 0.9


def test_what_walls_hide_from_all_cameras_does_not_count(variant: str) -> None:
    """Shapes sunk in a wall, seen by one camera and two, in the room and outside, near and infinitely far away."""
    changed, kept = 0, 0
    for seed in range(24):
        generator = np.random.default_rng(seed)
        low, high, normals, planar = walls(generator, 12)
        opaque = generator.uniform(size=12) < 0.8
        eyes = np.concatenate([generator.normal(size=(2, 3)) * generator.choice([1.0, 3.0]), [[1], [seed % 2]]], axis=1)
        eyes = eyes[: 1 + seed % 3 // 2]
        directions = generator.normal(size=(2, 3))
        views = stack_views([directional_view(mi.Vector3f(*direction)) for direction in directions.tolist()])
        planes, flat, boxes = arrays(low, high, normals, planar)
        places = mi.Vector4f(eyes.T.astype(np.float32))
        found = casting_shapes(views, planes, flat, boxes, eyes=places, opaque=mi.Bool(opaque)).numpy().reshape(2, -1)
        room = low, high, normals, planar
        expected = np.stack([brute_force(*room, direction, eyes, opaque) for direction in directions])
        assert np.array_equal(found, expected), seed
        usual = np.stack([brute_force(*room, direction) for direction in directions])
        assert (usual | ~expected).all()
        changed, kept = changed + int((usual & ~expected).sum()), kept + int((usual & expected)[:, planar].sum())
    assert changed > 5 and kept > 20


def test_many_cameras_are_not_asked(variant: str) -> None:
    room = walls(np.random.default_rng(1), 12)
    views = stack_views([directional_view(mi.Vector3f(0.2, 0.1, -1))])
    eyes = mi.Vector4f(np.random.default_rng(0).normal(size=(4, 20)).astype(np.float32))
    assert np.array_equal(casting_shapes(views, *arrays(*room), eyes=eyes).numpy(), casting_shapes(views, *arrays(*room)).numpy())


def test_thousands_of_shapes_are_not_compared_in_pairs(variant: str) -> None:
    """A city of 5,000 shapes would have 25 million pairs. No kernel has more lanes than shapes."""
    count = 2000
    low, high, normals, planar = walls(np.random.default_rng(0), count)
    given = arrays(low, high, normals, planar & (np.arange(count) < 20))
    views = stack_views([directional_view(mi.Vector3f(0.2, 0.1, -1))])
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(casting_shapes(views, *given))
        sizes = [kernel["size"] for kernel in dr.kernel_history([dr.KernelType.JIT])]
    assert sizes and max(sizes) <= 3 * count


def test_walls_receive_light_that_cameras_see(variant: str) -> None:
    """From the side on which a light and one of the cameras lie, with suns and with lamps, for cameras of both kinds."""
    shares = []
    for seed in range(8):
        generator = np.random.default_rng(seed)
        low, high, normals, planar = walls(generator, 12)
        points = 0.5 * (low + high)
        sun, lamp = generator.normal(size=(2, 3))
        eyes = np.concatenate([generator.normal(size=(2, 3)) * 2, [[1], [seed % 2]]], axis=1)
        views = stack_views([directional_view(mi.Vector3f(*sun.tolist())), *cube_views(mi.Point3f(*lamp.tolist()), 64, 3)])
        planes, reflecting, _ = arrays(low, high, normals, planar)
        found = receiving_shapes(views, planes, reflecting, mi.Vector4f(eyes.T.astype(np.float32))).numpy().reshape(7, -1)
        sides = [((eye[:3] - eye[3] * points) * normals).sum(1) > 0 for eye in eyes]
        for k, towards in enumerate([np.broadcast_to(-sun, points.shape), *[lamp - points] * 6]):
            lit = (towards * normals).sum(1) > 0
            assert np.array_equal(found[k], ~planar | (sides[0] == lit) | (sides[1] == lit))
        shares.append(found[:, planar])
    assert 0.3 < np.mean(shares) < 0.95
