"""Edges inside a silhouette: creases between flat faces, and where surfaces meet."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from raster_scenes import topology_of

from shadowmap_dr.raster import antialias, find_crossings, rasterize


def test_creases_between_flat_faces_move(variant: str) -> None:
    """Two differently coloured faces of a tent: the derivative of the ridge's sideways motion is that of the areas."""
    size = 64
    world = np.array([[-0.9, -0.8, 0.5], [-0.9, 0.8, 0.5], [0.11, -0.8, 0], [0.2, 0.8, 0], [0.9, -0.8, 0.5], [0.9, 0.8, 0.5]])
    faces = np.array([[0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3]], np.uint32)
    colors = mi.Float(np.array([1, 1, 0.25, 0.25], np.float32))
    world = world.astype(np.float32)
    topology = topology_of(faces, world)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    ridge = mi.Float([0, 0, 1, 1, 0, 0])
    x, y, z = (mi.Float(world[:, k].copy()) for k in range(3))
    clip = mi.TensorXf(dr.ravel(mi.Point4f(x + shift * ridge, y, z, 1)), shape=(6, 4))
    out = rasterize(clip, mi.TensorXu(faces), (size, size))
    value = dr.gather(mi.Float, colors, out.triangle, out.valid)
    image = antialias(value, out, clip, topology, creases=mi.Bool([True] * 12))
    dr.backward(dr.sum(image))
    want = 0.75 * 1.6 * (size / 2) ** 2
    # Next to a vertex, where the faces at the ridge are narrower than a pixel, the two pixels see faces without a common edge.
    rows = 1.6 * size / 2
    assert abs(float(dr.grad(shift)[0]) - want) < want * 4 / rows
    plain = antialias(value, out, clip, topology)
    assert np.abs(plain.numpy() - image.numpy()).max() > 0.1


@pytest.mark.parametrize("depth", [-1, 1], ids=["ridge", "valley"])
def test_tessellation_of_a_crease_does_not_change_it(variant: str, depth: int) -> None:
    """Two flat faces, one seen from the side: made of 2 triangles each, or 32, or 512, of which few that pixels see touch."""
    size, across, results = 64, 0.1, []
    for n in (1, 4, 16):
        grid = np.stack(np.meshgrid(np.arange(n + 1) / n, np.linspace(-0.8, 0.8, n + 1)), -1).reshape(-1, 2)
        corner = np.add.outer((n + 1) * np.arange(n), np.arange(n)).ravel()[:, None]
        one = np.r_[corner + [0, 1, n + 2], corner + [0, n + 2, n + 1]]
        faces = np.r_[one, one + len(grid)].astype(np.uint32)
        a, y = (mi.Float(np.tile(grid[:, k], 2).astype(np.float32)) for k in range(2))
        steep = mi.Float(np.repeat([0, 1], len(grid)).astype(np.float32))
        shift, turn = mi.Float(0), mi.Float(0)
        dr.enable_grad(shift, turn)
        ridge = 0.11 + shift + (0.05 + turn) * y
        x = ridge + dr.select(steep > 0, across * a, (ridge + 0.8) * (a - 1))
        z = depth * (0.2 * x + 0.4 * steep * a)
        clip = mi.TensorXf(dr.ravel(mi.Point4f(x, y, z, 1)), shape=(2 * len(grid), 4))
        topology = topology_of(faces, np.array(dr.detach(mi.Point3f(x, y, z))).T)
        assert topology.part_count == 1
        out = rasterize(clip, mi.TensorXu(faces), (size, size))
        value = dr.select(out.valid, dr.select(out.triangle >= len(one), mi.Float(0.25), 1), 0)
        image = antialias(value, out, clip, topology, creases=mi.Bool([True] * faces.size))
        weight = mi.Float(np.repeat(np.linspace(-0.8, 1.2, size), size).astype(np.float32))
        dr.backward(dr.sum(image * weight))
        results.append((image.numpy().reshape(size, size), [float(dr.grad(p)[0]) for p in (shift, turn)]))
    (coarse, want), *others = results
    for fine, got in others:
        # But for the rows at the ends, where outlines and crease come together.
        assert np.abs(coarse - fine)[8:-8].max() < 1e-3
        assert np.allclose(got, want, rtol=0.02), (got, want)


@pytest.mark.parametrize("rows", [1, 30])
@pytest.mark.parametrize("facet", [1.5, 2, 3])
def test_planes_of_a_curved_surface_are_not_extended(variant: str, facet: float, rows: int) -> None:
    """Facets (of a size in pixels) around an arc, seen from the side at its ends, and over a roof, on one side of it."""
    size = 64
    columns = int(0.8 * np.radians(168) * size / 2 / facet)
    arc, y = np.meshgrid(np.radians(np.linspace(-84, 84, columns + 1)), np.linspace(-0.9, 0.9, rows + 1))
    steep = np.clip(np.arange(columns + 1) - columns // 2, 0, None) / columns
    shallow = np.clip(np.arange(columns + 1) - columns // 2, None, 0) / columns
    corner = np.add.outer((columns + 1) * np.arange(rows), np.arange(columns)).ravel()[:, None]
    faces = np.r_[corner + [0, 1, columns + 2], corner + [0, columns + 2, columns + 1]].astype(np.uint32)
    parts = []
    for x, z in ((0.8 * np.sin(arc), -0.4 * np.cos(arc)), (1.6 * shallow + 0.1 * steep + 0 * y, 0.1 * shallow + steep + 0 * y)):
        world = np.stack([0.98 * x + 0.2 * y, 0.98 * y - 0.2 * x, z], -1).reshape(-1, 3).astype(np.float32)
        clip, topology = mi.TensorXf(np.c_[world, np.ones(len(world), np.float32)]), topology_of(faces, world)
        out = rasterize(clip, mi.TensorXu(faces), (size, size))
        found = find_crossings(clip.array, topology, out, len(world), creases=mi.Bool([True] * faces.size))
        count = int(found.meetings.count[0])
        assert count > 20
        pair = found.pairs.at(mi.UInt32(found.meetings.slots.numpy()[:count]))
        weight = dr.select(pair & 1 == 1, *(dr.gather(mi.Float, w, pair >> 1) for w in (found.down, found.right)))
        parts.append((weight.numpy() != 0).mean())
    curved, roof = parts
    # The rest of the roof's pairs see twice the same side.
    assert curved == 0 and roof > 0.25


def test_surfaces_that_meet_without_an_edge(variant: str) -> None:
    """Two squares that cut each other: where their depths are equal follows from all eight vertices."""
    size, half = 64, 0.8
    corners = half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32)
    # The first plane is 0.3 x + 0.1 y, the second -0.2 x - 0.05 y + 0.03: they meet at 0.5 x + 0.15 y = 0.03.
    depth = np.r_[corners @ [0.3, 0.1], corners @ [-0.2, -0.05] + 0.03]
    world = np.c_[np.r_[corners, corners], depth].astype(np.float32)
    topology = topology_of(faces, world)
    assert topology.part_count == 2 and topology.parts.numpy().tolist() == [0, 0, 1, 1]
    colors, area = mi.Float([1, 1, 0.25, 0.25]), (size / 2) ** 2
    moved = mi.Float(world[:, 2] * np.repeat([1, 0], 4)), mi.Float(world[:, 0] * np.repeat([0, 1], 4))

    def image(meetings: bool, creases: object) -> tuple:
        parameters = [mi.Float(0) for _ in range(4)]
        dr.enable_grad(parameters)
        rise, fall, steeper, slide = parameters
        first = mi.Float(np.repeat([1, 0], 4).astype(np.float32))
        x, y, z = (mi.Float(world[:, k].copy()) for k in range(3))
        z = z + rise * first + fall * (1 - first) + steeper * moved[0]
        clip = mi.TensorXf(dr.ravel(mi.Point4f(x + slide * (1 - first), y, z, 1)), shape=(8, 4))
        out = rasterize(clip, mi.TensorXu(faces), (size, size))
        value = dr.gather(mi.Float, colors, out.triangle, out.valid)
        return antialias(value, out, clip, topology, meetings=meetings, creases=creases), value, parameters

    x, y = np.meshgrid(*(2 * [(np.arange(16 * size) + 0.5) / (8 * size) - 1]))
    exact = np.where(0.5 * x + 0.15 * y < 0.03, 1, 0.25) * (np.maximum(np.abs(x), np.abs(y)) < half)
    exact = exact.reshape(size, 16, size, 16).mean((1, 3))
    for creases in (None, mi.Bool([False] * 12)):
        blended, raw, parameters = image(True, creases)
        inside = np.s_[8:56, 8:56]
        errors = [np.abs(v.numpy().reshape(size, size) - exact)[inside] for v in (blended, raw)]
        assert errors[0].mean() < 0.15 * errors[1].mean()
        dr.backward(dr.sum(blended))
        # A depth changed by d moves the line by d / 0.5 along x; the squares' own outlines leave the sum as it is, but for the
        # second's, where it is seen: its right side.
        swept = 0.75 * 2 * half / 0.5 * area
        tilted = 0.75 * 2 * half * 0.3 * 0.06 / 0.5 * area  # the depth of the first on the line, on average: 0.3 * 0.06
        want = np.array([-swept, swept, -tilted, 0.75 * 2 * half * 0.2 / 0.5 * area + 0.25 * 2 * half * area])
        got = np.array([float(dr.grad(p)[0]) for p in parameters])
        assert np.allclose(got, want, atol=0.02 * swept), (got, want)
        assert not np.any([dr.grad(p)[0] for p in _gradients_without(image, creases)])
        forward = image(True, creases)
        dr.set_grad(forward[2][1], 1.0)
        dr.forward_to(forward[0])
        assert dr.sum(dr.grad(forward[0]))[0] == pytest.approx(got[1], rel=1e-4)


def _gradients_without(image, creases: object) -> list:  # noqa: ANN001
    """Parameters that change depths alone, after a backward pass in which nobody looks where surfaces meet."""
    blended, _, parameters = image(False, creases)
    dr.backward(dr.sum(blended))
    return parameters[:3]


def test_one_surface_does_not_meet_itself(variant: str) -> None:
    """Connected faces are one part, however many there are, and seams of texture coordinates do not part them."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    split = np.asarray(sphere.vertices)[sphere.faces].reshape(-1, 3)
    both = np.r_[split, split + [3, 0, 0]].astype(np.float32)
    topology = topology_of(np.arange(len(both)).reshape(-1, 3), both)
    assert topology.part_count == 2
    assert np.array_equal(topology.parts.numpy(), np.repeat([0, 1], len(sphere.faces)))


def test_surfaces_that_lie_on_each_other_do_not_meet(variant: str) -> None:
    """Two squares in one plane, up to rounding: which of both a pixel sees is chance, and has no derivative."""
    corners = 0.8 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    world = np.c_[np.r_[corners, 0.9 * corners[:, ::-1]], np.zeros(8)]
    world[:, 2] = 0.3 * world[:, 0] - 0.21 * world[:, 1] + 0.17
    world, faces, size = world.astype(np.float32), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32), 48
    topology, rise = topology_of(faces, world), mi.Float(0)
    dr.enable_grad(rise)
    x, y, z = (mi.Float(world[:, k].copy()) for k in range(3))
    clip = mi.TensorXf(dr.ravel(mi.Point4f(x, y, z + rise * mi.Float(np.repeat([1, 0], 4)), 1)), shape=(8, 4))
    out = rasterize(clip, mi.TensorXu(faces), (size, size))
    assert len(np.unique(out.triangle.numpy())) > 3
    value = dr.gather(mi.Float, mi.Float([1, 1, 0.25, 0.25]), out.triangle, out.valid)
    image = antialias(value, out, clip, topology, meetings=True)
    dr.backward(dr.sum(dr.square(image)))
    assert dr.grad(rise)[0] == 0


# A square on a larger one, a rounding error before it; and two walls side by side without common corners: at an edge that the
# camera sees from outside, and in one plane. With the depths of their corners.
BIG = np.array([[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]])
LEFT, RIGHT = BIG * [0.5, 1] - [0.45, 0], BIG * [0.5, 0.7] + [0.45, 0]
TOUCHING = {
    "card": (BIG, [0, 0, 0, 0], 0.6 * BIG, [-1e-6] * 4),
    "corner": (LEFT, [0.3, 0, 0, 0.3], RIGHT, [0, 0.2, 0.2, 0]),
    "row": (LEFT, [0.3, 0, 0, 0.3], RIGHT, [0, -0.3, -0.3, 0]),
}


@pytest.mark.parametrize("case", TOUCHING)
def test_a_surface_ends_on_another_one(variant: str, case: str) -> None:
    """Shapes touch that have no vertices in common: one gains the area that the line sweeps, and the other loses it."""
    size = 64
    first, first_depth, second, second_depth = TOUCHING[case]
    world = np.c_[np.r_[first, second], np.r_[first_depth, second_depth] + 0.2].astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32)
    topology = topology_of(faces, world)
    moved = np.r_[0, 0, 0, 0, 1, 0, 0, 1] if case == "card" else np.r_[0, 1, 1, 0, 1, 0, 0, 1]

    def gradient(meetings: bool) -> float:
        slide = mi.Float(0)
        dr.enable_grad(slide)
        x, y, z = (mi.Float(world[:, k].copy()) for k in range(3))
        clip = mi.TensorXf(dr.ravel(mi.Point4f(x - slide * mi.Float(np.float32(moved)), y, z, 1)), shape=(8, 4))
        out = rasterize(clip, mi.TensorXu(faces), (size, size))
        value = dr.gather(mi.Float, mi.Float([1, 1, 0.25, 0.25]), out.triangle, out.valid)
        dr.backward(dr.sum(antialias(value, out, clip, topology, meetings=meetings)))
        return dr.grad(slide)[0]

    pixels = (size / 2) ** 2
    line, above = second[2, 1] - second[1, 1], first[2, 1] - first[1, 1] - (second[2, 1] - second[1, 1])
    # Beside the smaller wall the larger one ends before nothing.
    outline = 0 if case == "card" else -above * pixels
    assert gradient(True) == pytest.approx(outline + (0.25 - 1) * line * pixels, rel=0.05)
    assert gradient(False) == pytest.approx(outline, rel=0.05, abs=1e-3)
