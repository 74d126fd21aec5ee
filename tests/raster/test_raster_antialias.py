"""Silhouettes: coverage and its derivatives against supersampling and exact areas."""

from __future__ import annotations

from typing import Any

import brute_force
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from raster_scenes import TRIANGLE, render, smooth_weights, supersampled, to_clip, topology_of

from shadowmap_dr.raster import antialias, build_topology, find_crossings, interpolate, rasterize


def test_coverage_of_a_triangle(variant: str) -> None:
    faces, size = np.array([[0, 1, 2]], np.uint32), 32
    image, raw = render(mi.TensorXf(TRIANGLE), faces, topology_of(faces, TRIANGLE[:, :3]), size)
    image, raw = (v.numpy().reshape(size, size) for v in (image, raw))
    exact = supersampled(TRIANGLE, faces, size)
    assert np.abs(image - exact).max() < 0.3  # at the corners
    assert np.sqrt(np.mean((image - exact) ** 2)) < 0.2 * np.sqrt(np.mean((raw - exact) ** 2))
    assert abs(image.sum() - exact.sum()) < 0.25  # pixels


def test_corners_that_are_infinite_leave_the_image_alone(variant: str) -> None:
    """Their triangle is not drawn; by x / inf its edges would come to lie in the middle of the image."""
    infinite = [[-3.764865, -1.066467, -0.14111, 1], [0.323671, 0.045687, 0.348858, np.inf], [-4.147308, 10.328762, 0.5424, 1]]
    others = [[0.50032, -10.742145, -0.056785, 1], [-5.730114, -1.278489, 0.445056, 1], [2.726582, -6.0363622, -0.0007753, 1]]
    seen = [[-8.347701, -1.8677, -0.345356, 1], [-3.4027061, 5.7366743, -0.2280241, 1], [-0.0433376, 0.4401731, 0.0433294, 1]]
    pos = np.array([*infinite, *others, *seen], np.float32)
    faces, size = np.arange(9, dtype=np.uint32).reshape(3, 3), 8
    clip, ones = mi.TensorXf(pos), mi.TensorXf(np.ones((size, size, 1), np.float32))
    dr.enable_grad(clip, ones)
    raster = rasterize(clip, mi.TensorXu(faces), (size, size))
    assert 0 not in raster.triangle.numpy() and 2 in raster.triangle.numpy()
    image = antialias(ones, raster, clip, topology_of(faces, pos[:, :3].copy()))
    dr.backward(dr.sum(image))
    assert np.all(image.numpy() == 1)
    assert np.all(np.isfinite(dr.grad(clip).numpy())) and np.all(np.isfinite(dr.grad(ones).numpy()))


@pytest.mark.parametrize("angle", np.radians([0, 7, 29, 45, 61, 90, 133]))
def test_moving_a_straight_edge_sweeps_its_exact_area(variant: str, angle: float) -> None:
    """Translate a large rotated square; the derivative of the weighted image is the boundary integral."""
    c, s = np.cos(angle), np.sin(angle)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) @ np.array([[c, s], [-s, c]]) + 0.013
    faces, size = np.array([[0, 1, 2], [0, 2, 3]], np.uint32), 128
    world = np.c_[corners, np.zeros(4)].astype(np.float32)
    topology, weights = topology_of(faces, world), smooth_weights(size)
    for direction in ((1, 0), (0, 1)):
        delta = mi.Float(0)
        dr.enable_grad(delta)
        p = [mi.Float(world[:, k].copy()) for k in range(3)]
        clip = mi.TensorXf(dr.ravel(mi.Point4f(p[0] + delta * direction[0], p[1] + delta * direction[1], p[2], 1)), shape=(4, 4))
        image, _ = render(clip, faces, topology, size)
        dr.forward(delta)
        got = float((dr.grad(image).numpy().reshape(size, size) * weights).sum())
        # Boundary integral of weight * (normal . direction), sampled finely in pixels per unit of NDC.
        want = 0.0
        for k in range(4):
            a, b = corners[k], corners[(k + 1) % 4]
            points = a + (b - a) * ((np.arange(4000) + 0.5) / 4000)[:, None]
            normal = np.array([b[1] - a[1], a[0] - b[0]])
            x, y = ((points + 1) / 2).T
            w = 0.5 + 0.3 * np.sin(5 * x + 1) * np.cos(4 * y) + 0.4 * x
            want += w.mean() * (normal @ direction) * (size / 2) ** 2
        scale = (size / 2) ** 2  # pixels swept by a unit edge moving one unit
        # The ends of the four edges are rounded to whole rows or columns: at most about one of the 64 that an edge meets.
        assert abs(got - want) < scale / 64, (direction, got, want)


def grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit square of n x n quads."""
    g = np.linspace(-0.5, 0.5, n + 1)
    x, y = np.meshgrid(g, g)
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    return np.c_[x.ravel(), y.ravel(), 0 * x.ravel()], np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_tessellation_does_not_change_the_gradient(variant: str) -> None:
    size = 64
    gradients = []
    for n in (2, 16, 128):  # 8, 512 and 32,768 triangles: the last are a fifth of a pixel
        world, faces = grid(n)
        angle = 0.4
        rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        world = (world @ rotation.T).astype(np.float32)
        topology = topology_of(faces, world)
        parameters = [mi.Float(0), mi.Float(0), mi.Float(1)]
        dr.enable_grad(parameters)
        x, y = (mi.Float(world[:, k].copy()) * parameters[2] + parameters[k] for k in range(2))
        clip = mi.TensorXf(dr.ravel(mi.Point4f(x, y, 0, 1)), shape=(len(world), 4))
        image, _ = render(clip, faces.astype(np.uint32), topology, size)
        dr.backward(dr.sum(image * mi.Float(smooth_weights(size).ravel())))
        gradients.append([float(dr.grad(p)[0]) for p in parameters])
    gradients = np.array(gradients)
    assert np.abs(gradients - gradients[0]).max() < 0.02 * np.abs(gradients[0]).max()


def test_sub_pixel_sphere_grows_like_a_disc(variant: str) -> None:
    """81,920 faces in a 64 x 64 image: most triangles lie far below a pixel."""
    sphere = trimesh.creation.icosphere(subdivisions=6, radius=0.6)
    faces, world, size = sphere.faces.astype(np.uint32), sphere.vertices.astype(np.float32), 64
    topology = topology_of(faces, world)
    radius, dx = mi.Float(1), mi.Float(0)
    dr.enable_grad(radius, dx)
    x, y, z = (mi.Float(world[:, k].copy()) * radius for k in range(3))
    clip = mi.TensorXf(dr.ravel(mi.Point4f(x + dx, y, z, 1)), shape=(len(world), 4))
    image, _ = render(clip, faces, topology, size)
    assert abs(float(dr.sum(image)[0]) - np.pi * (0.6 * size / 2) ** 2) < 2.5
    dr.backward(dr.sum(image), flags=dr.ADFlag.Default & ~dr.ADFlag.ClearEdges)
    want = 2 * np.pi * 0.6 * 0.6 * (size / 2) ** 2
    assert abs(float(dr.grad(radius)[0]) - want) < 0.02 * want
    dr.clear_grad(dx)
    x_weight = np.tile((np.arange(size) + 0.5) / size * 2 - 1, size).astype(np.float32)
    dr.backward(dr.sum(image * mi.Float(x_weight)))
    want = np.pi * 0.36 * (size / 2) ** 2  # moment of area moved by dx
    assert abs(float(dr.grad(dx)[0]) - want) < 0.02 * want


@pytest.mark.parametrize("case", ["in front", "through the camera plane"])
def test_vertex_gradients_match_differences_of_a_supersampled_image(variant: str, case: str) -> None:
    if case == "in front":
        world = np.array(
            [[-1.1, -1, -3], [0.8, -0.9, -2], [-0.4, 0.9, -2.6], [-0.7, 0.3, -3], [1.2, -0.2, -2.6], [0.6, 1.3, -3.3]]
        )
    else:
        world = np.array(
            [[-0.6, -0.3, -2], [0.5, -0.4, -2.5], [0.1, -0.5, 1.0], [0.3, 0.4, -2], [0.9, 0.5, -2.2], [0.5, 0.9, -1.8]]
        )
    faces, size = np.array([[0, 1, 2], [3, 4, 5]], np.uint32), 64
    matrix, weights = brute_force.perspective(60), smooth_weights(size)
    topology = topology_of(faces, world)
    p = mi.TensorXf(world.astype(np.float32))
    dr.enable_grad(p)
    image, _ = render(to_clip(p, matrix), faces, topology, size)
    dr.backward(dr.sum(image * mi.Float(weights.ravel())))
    got = dr.grad(p).numpy()

    def total(w: np.ndarray) -> float:
        return float((supersampled(np.c_[w, np.ones(6)] @ matrix.T, faces, size, 16) * weights).sum())

    want, h = np.zeros_like(world), 0.01
    for i in np.ndindex(6, 3):
        step = np.zeros_like(world)
        step[i] = h
        want[i] = (total(world + step) - total(world - step)) / (2 * h)
    cosine = (got * want).sum() / np.linalg.norm(got) / np.linalg.norm(want)
    scale = (got * want).sum() / (want * want).sum()
    assert cosine > 0.995 and 0.97 < scale < 1.03, (cosine, scale, got, want)


def test_weights_are_convex_and_shared_by_all_channels(variant: str) -> None:
    rng = np.random.default_rng(2)
    size = 24
    pos = np.c_[rng.uniform(-1, 1, (60, 3)), np.ones(60)].astype(np.float32)
    faces = np.arange(60).reshape(20, 3).astype(np.uint32)
    topology = topology_of(faces, pos[:, :3])
    out = rasterize(mi.TensorXf(pos), mi.TensorXu(faces), (size, size))
    constant = antialias(dr.full(mi.Float, 0.7, size * size), out, mi.TensorXf(pos), topology).numpy()
    np.testing.assert_allclose(constant, 0.7, atol=1e-6)
    moment = rng.uniform(-0.5, 0.5, size * size).astype(np.float32)
    pair = mi.TensorXf(np.stack([moment, moment**2], -1).reshape(size, size, 2))
    mixed = antialias(pair, out, mi.TensorXf(pos), topology).numpy()
    assert (mixed[..., 1] >= mixed[..., 0] ** 2 - 1e-6).all()
    assert mixed[..., 0].min() >= moment.min() and mixed[..., 0].max() <= moment.max()
    assert np.abs(mixed[..., 0].ravel() - moment).max() > 0.1  # it did something


def test_creases_and_hidden_edges_are_left_alone(variant: str) -> None:
    """Inside a closed convex object, between its own faces, there is no silhouette; nor behind it."""
    box = trimesh.creation.icosphere(subdivisions=2, radius=0.8)
    hidden = trimesh.creation.box((0.5, 0.5, 0.02))
    hidden.apply_translation([0, 0, 0.9])
    world = np.concatenate([box.vertices, hidden.vertices]).astype(np.float32)
    faces = np.concatenate([box.faces, hidden.faces + len(box.vertices)]).astype(np.uint32)
    clip, size = np.c_[world, np.ones(len(world))].astype(np.float32), 48
    colors = np.random.default_rng(0).random(len(faces))
    image, raw = render(mi.TensorXf(clip), faces, topology_of(faces, world), size, colors)
    x, y = np.meshgrid(*(2 * [(np.arange(size) + 0.5) / size * 2 - 1]))
    interior = np.hypot(x, y).ravel() < 0.7
    assert (image.numpy() == raw.numpy())[interior].all()


def test_seams_are_welded(variant: str) -> None:
    world, faces = grid(4)
    split = world[faces].reshape(-1, 3)  # every face with vertices of its own
    topology = topology_of(np.arange(len(split)).reshape(-1, 3), split)
    assert topology.count == topology_of(faces, world).count
    boundary = (topology.opposite.numpy().reshape(-1, 2)[:, 1] == 0xFFFFFFFF).sum()
    assert boundary == 16


def test_faces_beyond_edges(variant: str) -> None:
    """By brute force, of a grid with a fin on one of its edges and a face without area."""
    world, faces = grid(3)
    faces = np.r_[faces, [[faces[4][0], faces[4][1], len(world)], [0, 0, 5]]]
    world = np.r_[world, [[0.1, 0.2, 1]]]
    split = world[faces].reshape(-1, 3)
    found = topology_of(np.arange(len(split)).reshape(-1, 3), split).beyond.numpy().reshape(-1, 3)
    for f, face in enumerate(faces):
        for k in range(3):
            edge = {face[k], face[(k + 1) % 3]}
            others = [g for g in range(len(faces)) if g != f and len(set(faces[g])) == 3 and edge <= set(faces[g])]
            if len(others) == 1 and len(edge) == 2 and f < len(faces) - 1:
                assert found[f, k] // 3 == others[0] and faces.ravel()[found[f, k]] not in edge
            else:
                assert found[f, k] == 0xFFFFFFFF


def test_interpolate_matches_the_plane_and_is_differentiable(variant: str) -> None:
    size = 16
    pos = np.array([[-3, -3, 0, 1], [12, -6, 0, 2], [-4.5, 9, 0, 1.5]], np.float32)
    faces = mi.TensorXu(np.array([[0, 1, 2]], np.uint32))
    world = pos[:, :2] * 1.0
    attributes = np.c_[world @ [2.0, 3.0] + 1, pos[:, 3]].astype(np.float32)  # affine in clip space
    p, a = mi.TensorXf(pos), mi.TensorXf(attributes)
    dr.enable_grad(a)
    out = rasterize(p, faces, (size, size))
    value = interpolate(a, out, faces)
    ndc = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(ndc, ndc)
    w = value.numpy()[..., 1]
    np.testing.assert_allclose(value.numpy()[..., 0], (2 * x + 3 * y) * w + 1, rtol=2e-5, atol=2e-5)
    dr.backward(dr.sum(value))
    np.testing.assert_allclose(dr.grad(a).numpy().sum(0), [size * size] * 2, rtol=1e-5)


def test_what_does_not_fit_a_raster_never_reaches_a_gather(variant: str) -> None:
    square = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [1, 1, 0, 1], [0, 1, 0, 1]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    clip, topology = mi.TensorXf(square), topology_of(faces, square[:, :3])
    out = rasterize(clip, mi.TensorXu(faces), (8, 8))
    with pytest.raises(ValueError, match="attribute row 3, but there are only 3"):
        interpolate(clip[:3], out, mi.TensorXu(faces))
    with pytest.raises(ValueError, match="3 indices, but 2 triangles"):
        interpolate(clip, out, mi.TensorXu(faces[:1]))
    # Other indices for the same triangles, as texture coordinates have them, are fine.
    assert interpolate(clip[:1], out, mi.TensorXu(0 * faces)).shape == (8, 8, 4)
    value = dr.select(out.valid, mi.Float(1), mi.Float(0))
    with pytest.raises(ValueError, match="4 vertices, but 2 faces were rasterized and there are 3 vertices"):
        antialias(value, out, clip[:3], topology)
    with pytest.raises(ValueError, match="1 faces and 3 vertices, but 2 faces"):
        antialias(value, out, clip, topology_of(faces[:1], square[:, :3]))
    with pytest.raises(ValueError, match="creases hold 3 flags, but 2 faces have 6 edges"):
        antialias(value, out, clip, topology, creases=mi.Bool([True] * 3))
    hard = mi.Bool([True] * 6)
    with pytest.raises(ValueError, match="crease_weights hold 2 numbers"):
        antialias(value, out, clip, topology, creases=hard, crease_weights=mi.Float(1, 1))
    uniform = antialias(value, out, clip, topology, creases=hard, crease_weights=mi.Float(1)).numpy()
    assert (uniform == antialias(value, out, clip, topology, creases=hard).numpy()).all()
    small = rasterize(clip, mi.TensorXu(faces), (4, 4))
    with pytest.raises(ValueError, match="crossings are those of 16 pixels"):
        antialias(value, out, clip, topology, crossings=find_crossings(clip.array, topology, small, 4))
    with pytest.raises(ValueError, match=r"values have shape \(1, 8, 8\); expected \(H, W, C\)"):
        antialias(mi.TensorXf(value, shape=(1, 8, 8)), out, clip, topology)
    with pytest.raises(ValueError, match="the topology has no edges"):
        antialias(value, out, clip, topology_of(faces, 0 * square[:, :3]))
    for broken, message in (((faces, square), r"positions have shape \(4, 4\)"), ((faces.T, square[:, :3]), "faces have shape")):
        with pytest.raises(ValueError, match=message):
            build_topology(*broken, mi.UInt32)


def test_crossings_can_be_shared(variant: str) -> None:
    faces = np.array([[0, 1, 2]], np.uint32)
    clip = mi.TensorXf(TRIANGLE)
    topology = topology_of(faces, TRIANGLE[:, :3])
    out = rasterize(clip, mi.TensorXu(faces), (16, 16))
    value = dr.select(out.valid, mi.Float(1), mi.Float(0))
    shared = antialias(value, out, clip, topology, crossings=find_crossings(clip.array, topology, out, 3))
    assert (shared.numpy() == antialias(value, out, clip, topology).numpy()).all()


def test_plain_dr_jit_arrays_do_as_well(variant: str) -> None:
    """Types without derivatives, and of no renderer: the same values."""
    plain = dr.llvm if variant.startswith("llvm") else dr.cuda
    faces, results = np.array([[0, 1, 2]], np.uint32), []
    for module in (plain, plain.ad):
        clip = module.TensorXf(TRIANGLE)
        out = rasterize(clip, module.TensorXu(faces), (16, 16))
        value = dr.select(out.valid, module.Float(1), module.Float(0))
        image = antialias(value, out, clip, build_topology(faces, TRIANGLE[:, :3], module.UInt32))
        results.append((image.numpy(), interpolate(clip, out, module.TensorXu(faces)).numpy()))
        assert type(image) is module.Float
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)


def test_channels_may_come_one_by_one(variant: str) -> None:
    """A list of channels gives the values and derivatives (both modes) of the interleaved array, also if a list is returned."""
    rng, size = np.random.default_rng(5), 20
    world = rng.uniform(-1, 1, (45, 3)).astype(np.float32)
    faces = np.arange(45).reshape(15, 3).astype(np.uint32)
    topology = topology_of(faces, world)
    channels = rng.random((3, size * size)).astype(np.float32)
    weights = mi.Float(rng.standard_normal(3 * size * size).astype(np.float32))
    results = []

    def flat(values: Any) -> mi.Float:
        return dr.ravel(mi.Color3f(*values)) if isinstance(values, list) else values

    for separate, kept in ((True, False), (True, True), (False, False)):
        clip = mi.TensorXf(np.c_[world, np.ones(45)].astype(np.float32))
        planes = [mi.Float(c.copy()) for c in channels]
        dr.enable_grad(clip, planes)
        out = rasterize(clip, mi.TensorXu(faces), (size, size))
        given: Any = {"separate": True} if kept else {}
        image = flat(antialias(planes if separate else dr.ravel(mi.Color3f(*planes)), out, clip, topology, **given))
        dr.backward(dr.sum(image * weights), flags=dr.ADFlag.Default & ~dr.ADFlag.ClearEdges)
        backward = [dr.grad(a).numpy().ravel() for a in (clip, *planes)]
        moved, delta = mi.TensorXf(dr.detach(clip)), mi.Float(0)
        dr.enable_grad(delta)
        moved = moved + delta * mi.TensorXf(0.3)
        lit = [mi.Float(c.copy()) + delta * (k + 1) for k, c in enumerate(channels)]
        out = rasterize(moved, mi.TensorXu(faces), (size, size))
        image_2 = flat(antialias(lit if separate else dr.ravel(mi.Color3f(*lit)), out, moved, topology, **given))
        dr.forward(delta)
        results.append([image.numpy(), *backward, dr.grad(image_2).numpy()])
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    assert np.abs(results[0][-1]).max() > 0.1
    with pytest.raises(ValueError, match="separate only in a list"):
        antialias(dr.ravel(mi.Color3f(*planes)), out, clip, topology, separate=True)
    with pytest.raises(ValueError, match="channels hold"):
        antialias(planes[:1] + [mi.Float(1, 2, 3)], out, moved, topology)


@pytest.mark.parametrize("separate", [False, True])
def test_derivatives_without_values(variant: str, separate: bool) -> None:
    """Derivatives by the values (both modes) are the same if blended values are not asked for; positions still ask for them."""
    rng, size = np.random.default_rng(6), 20
    world = rng.uniform(-1, 1, (45, 3)).astype(np.float32)
    faces = np.arange(45).reshape(15, 3).astype(np.uint32)
    topology, channels = topology_of(faces, world), rng.random((3, size * size)).astype(np.float32)
    weights = mi.Float(rng.standard_normal(3 * size * size).astype(np.float32))
    given: Any = {"separate": True} if separate else {}
    results = {}
    for attached in (False, True):
        for only in (False, True):
            clip = mi.TensorXf(np.c_[world, np.ones(45)].astype(np.float32))
            number = mi.Float(0)
            dr.enable_grad(number, *([clip] if attached else []))
            planes = [mi.Float(c.copy()) * (1 + (k + 1) * number) for k, c in enumerate(channels)]
            out = rasterize(clip, mi.TensorXu(faces), (size, size))
            image = antialias(planes, out, clip, topology, derivatives_only=only, **given)
            image = dr.ravel(mi.Color3f(*image)) if isinstance(image, list) else image
            dr.forward(number, flags=dr.ADFlag.ClearVertices)
            forward = dr.grad(image).numpy()
            dr.backward(image * weights)
            results[attached, only] = forward, dr.grad(number).numpy(), dr.grad(clip).numpy() if attached else 0, image.numpy()
        for a, b in zip(results[attached, False][:3], results[attached, True][:3], strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)
    assert np.abs(results[False, False][1]) > 0.1 and np.abs(results[True, False][2]).max() > 0.1
    np.testing.assert_array_equal(results[True, False][3], results[True, True][3])


def test_derivatives_of_claimed_pixels_match_differences(variant: str) -> None:
    """One pixel sees a much smaller surface: the four neighbours claim more than all of it, and share it out."""
    size, step = 8, 1e-3
    world = np.array([[0.09, 0.08, 0], [0.17, 0.085, 0], [0.165, 0.17, 0], [0.085, 0.16, 0]])
    world = np.r_[world, [[-0.9, -0.9, 0.5], [0.9, -0.9, 0.5], [0, 0.95, 0.5]]].astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.uint32)
    topology, colors = topology_of(faces, world), np.array([1, 1, 0.3])
    weights = np.random.default_rng(1).random(size * size).astype(np.float32)

    def total(flat):  # noqa: ANN001, ANN202
        clip = mi.TensorXf(dr.ravel(mi.Point4f(*dr.unravel(mi.Point3f, flat), 1)), shape=(7, 4))
        image, _ = render(clip, faces, topology, size, colors)
        return dr.sum(image * mi.Float(weights))

    p = mi.Float(world.ravel().copy())
    dr.enable_grad(p)
    dr.backward(total(p))
    got = dr.grad(p).numpy()
    for i in range(21):
        ends = []
        for sign in (1, -1):
            moved = world.ravel().copy()
            moved[i] += sign * step
            ends.append(float(total(mi.Float(moved))[0]))
        want = (ends[0] - ends[1]) / (2 * step)
        assert abs(got[i] - want) < 2e-3 + 0.02 * abs(want), (i, got[i], want)


@pytest.mark.parametrize("other", [None, "x", [], 3, np.ones(16), [1.0]])
def test_arguments_that_are_no_arrays_are_named(variant: str, other: object) -> None:
    positions = mi.TensorXf(np.array([[-1, -1, 0, 1], [3, -1, 0, 1], [-1, 3, 0, 1]], np.float32))
    faces = mi.TensorXu(np.array([[0, 1, 2]], np.uint32))
    found = rasterize(positions, faces, (4, 4))
    topology = build_topology(np.array([[0, 1, 2]]), np.eye(3), mi.UInt32)
    wrong: Any = other
    for name, call in {
        "attributes": lambda: interpolate(wrong, found, faces),
        "faces": lambda: interpolate(positions, found, wrong),
        "values|channels": lambda: antialias(wrong, found, positions, topology),
        "positions": lambda: antialias(mi.Float(0.5) + dr.zeros(mi.Float, 16), found, wrong, topology),
    }.items():
        with pytest.raises(ValueError, match=f"^({name}) (are of type|hold)") as caught:
            call()
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("faces", [None, "x", [[0.5, 1, 2]], [[0, 1], [2]], {}])
def test_topologies_need_indices(faces: Any) -> None:
    with pytest.raises(ValueError, match="^faces (hold|are no array|have shape).*expected"):
        build_topology(faces, np.eye(3), mi.UInt32)
    with pytest.raises(ValueError, match="^positions (hold|are no array|have shape).*expected"):
        build_topology(np.array([[0, 1, 2]]), faces if faces is None or isinstance(faces, str | dict) else "x", mi.UInt32)
