"""Shadow maps of directional, spot and point lights against shadow rays; gradients; the fit; the authors' conventions."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import shadow_scene
import trimesh

from shadowmap_dr.shadow import (
    Frusta,
    ShadowSettings,
    chebyshev_visibility,
    cube_face,
    cube_views,
    directional_view,
    spot_view,
    standard_visibility,
    variance_moments,
    visibility,
)

BOX = trimesh.creation.box((0.8, 0.5, 0.6), transform=trimesh.transformations.euler_matrix(0.3, 0.5, 0.2))


def points(array: np.ndarray):  # noqa: ANN201
    return mi.Point3f(*(mi.Float(np.ascontiguousarray(array[:, k], np.float32)) for k in range(3)))


def receivers(n: int, z: float = -1.5, half: float = 2.0) -> np.ndarray:
    line = half * ((2 * np.arange(n) + 1) / n - 1)
    x, y = np.meshgrid(line, line)
    return np.c_[x.ravel(), y.ravel(), np.full(n * n, z)]


def views_of(kind: str, resolution: int, filter_size: int, position=(0.4, 0.3, 2.5)):  # noqa: ANN001, ANN201
    p = mi.Point3f(*position)
    if kind == "directional":
        return [directional_view(mi.Vector3f(0.2, -0.15, -1))]
    if kind == "spot":
        forward = dr.normalize(mi.Vector3f(-0.1, -0.1, -1))
        right = dr.normalize(dr.cross(mi.Vector3f(0, 1, 0), forward))
        return [spot_view(p, right, dr.cross(forward, right), forward, mi.Float(np.tan(np.radians(40))))]
    return list(cube_views(p, resolution, filter_size))


def look_up(maps, kind: str, p, position=(0.4, 0.3, 2.5)):  # noqa: ANN001, ANN201
    index = cube_face(p - mi.Point3f(*position)) if kind == "point" else 0
    return visibility(maps, index, p)


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
@pytest.mark.parametrize("method", ["vsm", "standard"])
def test_agrees_with_shadow_rays(variant: str, kind: str, method: str) -> None:
    settings = ShadowSettings(method=method, resolution=512)
    maps = shadow_scene.make_maps(views_of(kind, 512, 3), points(BOX.vertices), BOX.vertices, BOX.faces, settings)
    p = receivers(60)
    v = look_up(maps, kind, points(p)).numpy()
    light = np.array((0.4, 0.3, 2.5)) if kind != "directional" else p - 20 * np.array([0.2, -0.15, -1])
    hit, margin = shadow_scene.occluded(p, np.broadcast_to(light, p.shape), BOX.triangles)
    texel = 4 * float(dr.max(maps.frusta.half_x)[0]) / 512 * (1 if kind == "directional" else 2.5)
    clear = margin > 3 * texel
    assert 40 < hit[clear].sum() < 0.9 * len(p)
    assert np.abs(v - ~hit)[clear].max() < 0.02
    assert ((v >= 0) & (v <= 1)).all()


def test_cube_faces_have_no_seams(variant: str) -> None:
    """Casters right across the edges and a corner of the cube: the visibility next to a seam is that of a shadow ray."""
    casters = [trimesh.creation.icosphere(2, 0.12) for _ in range(3)]
    for c, at in zip(casters, ([0.5, 0.5, 0.1], [0.5, 0.5, 0.5], [-0.5, 0.1, -0.5]), strict=True):
        c.apply_translation(at)
    mesh = trimesh.util.concatenate(casters)
    rng = np.random.default_rng(0)
    d = rng.normal(size=(20000, 3))
    d[:, 1] = d[:, 0] * (1 + rng.normal(size=20000) * 0.02)  # near the seam between the +x and +y (-x and -y) faces
    p = 1.5 * d / np.linalg.norm(d, axis=1, keepdims=True)
    settings = ShadowSettings(resolution=256, filter_size=5)
    views = views_of("point", 256, 5, (0.0, 0.0, 0.0))
    maps = shadow_scene.make_maps(views, points(mesh.vertices), mesh.vertices, mesh.faces, settings)
    v = look_up(maps, "point", points(p), (0.0, 0.0, 0.0)).numpy()
    hit, margin = shadow_scene.occluded(p, np.zeros_like(p), mesh.triangles)
    blocked = hit & (margin > 0)
    direction = p / 1.5
    centers = np.array([[0.5, 0.5, 0.1], [0.5, 0.5, 0.5], [-0.5, 0.1, -0.5]])
    distance = np.linalg.norm(np.cross(direction[:, None], centers[None]), axis=-1)
    clear = (np.abs(distance - 0.12) > 0.02).all(1)
    assert blocked[clear].sum() > 200
    assert np.abs(v - ~hit)[clear].max() < 0.05


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
def test_gradients_match_the_exact_shadow_area(variant: str, kind: str) -> None:
    """Derivative of a weighted shadow integral with respect to the caster's and the light's position, against shadow rays."""
    position = np.array((0.4, 0.3, 2.5))
    n = 1200  # finer than the texels, or the look-ups would alias
    p = receivers(n, half=2.4)
    weight = (1 + 0.3 * p[:, 0] + 0.2 * p[:, 1] ** 2).astype(np.float32)
    cell = (4.8 / n) ** 2

    def exact(shift: np.ndarray, light_shift: np.ndarray) -> float:
        q = receivers(n // 3, half=2.4)
        light = position + light_shift if kind != "directional" else q - 20 * (np.array([0.2, -0.15, -1]) + light_shift)
        hit, _ = shadow_scene.occluded(q, np.broadcast_to(light, q.shape), BOX.triangles + shift)
        return float(((1 + 0.3 * q[:, 0] + 0.2 * q[:, 1] ** 2) * ~hit).sum()) * (4.8 / (n // 3)) ** 2

    shift, light_shift = mi.Point3f(0), mi.Point3f(0)
    dr.enable_grad(shift, light_shift)
    settings = ShadowSettings(resolution=256)
    if kind == "directional":
        views = [directional_view(mi.Vector3f(0.2, -0.15, -1) + light_shift)]
    else:
        views = views_of(kind, 256, 3, mi.Point3f(*position.tolist()) + light_shift)
    maps = shadow_scene.make_maps(views, points(BOX.vertices) + shift, BOX.vertices, BOX.faces, settings)
    index = cube_face(points(p) - mi.Point3f(*position.tolist())) if kind == "point" else 0
    loss = dr.sum(visibility(maps, index, points(p)) * mi.Float(weight)) * cell
    assert abs(float(loss[0]) - exact(np.zeros(3), np.zeros(3))) < 0.02
    dr.backward(loss)
    got = np.r_[[float(g[0]) for g in dr.grad(shift)], [float(g[0]) for g in dr.grad(light_shift)]]
    want, h = np.zeros(6), 0.03
    for k in range(6):
        e = np.zeros(6)
        e[k] = h
        want[k] = (exact(e[:3], e[3:]) - exact(-e[:3], -e[3:])) / (2 * h)
    assert got @ want / np.linalg.norm(got) / np.linalg.norm(want) > 0.99, (got, want)
    assert 0.95 < got @ want / (want @ want) < 1.05, (got, want)


def test_outside_of_the_map_is_lit(variant: str) -> None:
    for kind in ("directional", "spot", "point"):
        maps = shadow_scene.make_maps(
            views_of(kind, 64, 3), points(BOX.vertices), BOX.vertices, BOX.faces, ShadowSettings(resolution=64)
        )
        p = points(np.array([[50.0, 0, 0], [0, -50, 3], [10, 10, 10], [0.4, 0.3, 60]]))
        assert (look_up(maps, kind, p).numpy() == 1).all(), kind


@pytest.mark.parametrize("kind", ["directional", "spot"])
def test_a_small_move_leaves_the_frustum_alone_and_a_large_one_refits(variant: str, kind: str) -> None:
    rng = np.random.default_rng(1)
    settings = ShadowSettings(resolution=64)
    previous = None
    first = None
    for _ in range(30):
        delta = rng.uniform(-1, 1, 3)
        world = BOX.vertices + (0.3 * 2 * 0.7 / 64) * delta / np.abs(delta).max()
        maps = shadow_scene.make_maps(views_of(kind, 64, 3), points(world), world, BOX.faces, settings, previous)
        numbers = np.array([column.numpy() for column in maps.frusta.columns()])
        first = numbers if first is None else first
        assert (numbers == first).all()
        previous = maps.frusta
    world = BOX.vertices + [0.4, 0, 0]
    maps = shadow_scene.make_maps(views_of(kind, 64, 3), points(world), world, BOX.faces, settings, previous)
    assert maps.frusta.center_x.numpy()[0] != previous.center_x.numpy()[0]
    assert (dr.abs(maps.frusta.half_x).numpy() < 1.6).all()


@pytest.mark.parametrize("kind", ["directional", "spot"])
def test_compat_follows_the_authors_formulas(variant: str, kind: str) -> None:
    """One flat caster at a known place: stored depths, filtered moments and visibility from their formulas in NumPy."""
    size = 32
    quad = np.array([[-0.5, -0.5, 0.2], [0.5, -0.5, 0.2], [0.5, 0.5, 0.2], [-0.5, 0.5, 0.2]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    settings = ShadowSettings(resolution=size, filter="box", filter_size=3, antialias=False, compat=True)
    one, zero = mi.Float(1), mi.Float(0)
    axes = (mi.Point3f(1, 0, 0), mi.Point3f(0, -1, 0), mi.Point3f(0, 0, -1))
    spread = mi.Float(0.5) if kind == "spot" else zero
    view = spot_view(mi.Point3f(0, 0, 4), *axes, spread)
    half = 0.5 if kind == "spot" else 1.0
    frusta = Frusta(zero, zero, half * one, half * one, one, mi.Float(8), one, mi.Float(8))
    maps = shadow_scene.make_maps([view], points(quad), quad, faces, settings, frusta=frusta)

    ndc = (2 * np.arange(size) + 1) / size - 1
    x, y = np.meshgrid(ndc * half, ndc * half)
    reach = 3.8 if kind == "spot" else 1.0
    covered = (np.abs(x * reach) < 0.5) & (np.abs(y * reach) < 0.5)
    depth = np.where(covered, np.sqrt((x * reach) ** 2 + (y * reach) ** 2 + 3.8**2), 8.0)
    padded = [np.pad(m, 1, mode="edge") for m in (depth, depth**2)]
    m1, m2 = (sum(m[j : j + size, i : i + size] for i in range(3) for j in range(3)) / 9 for m in padded)
    np.testing.assert_allclose(maps.values.numpy().reshape(size, size, 2)[..., 0], m1, rtol=1e-5)

    # Receivers behind texel centres, so that the look-up is the texel itself.
    d = 5.0
    scale = d if kind == "spot" else 1.0
    p = np.c_[(x * scale).ravel(), -(y * scale).ravel(), np.full(size * size, 4 - d)]
    v = visibility(maps, 0, points(p)).numpy().reshape(size, size)
    radial = np.sqrt((x * scale) ** 2 + (y * scale) ** 2 + d * d)
    variance = np.maximum(m2 - m1**2, 1e-4)
    want = np.where(radial <= m1, 1, variance / (variance + (radial - m1) ** 2))
    assert np.abs(v - want).max() < 2e-3
    outside = visibility(maps, 0, points(np.array([[20.0, 0, -1]]))).numpy()
    assert outside[0] < 1e-4


def test_chebyshev_is_bounded_and_finite_on_any_moments(variant: str) -> None:
    rng = np.random.default_rng(0)
    m1 = np.r_[rng.uniform(-0.5, 0.5, 2000), 0.5, -0.5, 0, 0]
    m2 = np.r_[rng.uniform(0, 0.25, 2000), 0.25, 0.25, 0, 0]
    d = np.r_[rng.uniform(-0.7, 0.7, 2000), 0.5, 0.5, 0, 1e-30]
    moments = mi.Vector2f(mi.Float(m1.astype(np.float32)), mi.Float(m2.astype(np.float32)))
    depth = mi.Float(d.astype(np.float32))
    dr.enable_grad(moments, depth)
    v = chebyshev_visibility(moments, depth)
    assert ((v.numpy() >= 0) & (v.numpy() <= 1)).all()
    dr.backward(dr.sum(v))
    for g in (*dr.grad(moments), dr.grad(depth)):
        assert np.isfinite(g.numpy()).all()
    variance = np.maximum(m2 - m1**2, 1e-6)
    want = np.where(d <= m1, 1, variance / (variance + (d - m1) ** 2))
    np.testing.assert_allclose(v.numpy(), want, atol=1e-4)


def test_moment_and_standard_formulas(variant: str) -> None:
    m = variance_moments(mi.Float([0.3, -0.2]), mi.Float([0.0, 0.04]))
    np.testing.assert_allclose(m.x.numpy(), [0.3, -0.2])
    np.testing.assert_allclose(m.y.numpy(), [0.09, 0.05], rtol=1e-6)
    assert standard_visibility(mi.Float([0.1, 0.1]), mi.Float([0.102, 0.2]), 0.005).numpy().tolist() == [1, 0]


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"method": "magic"}, "magic"),
        ({"filter": "median"}, "median"),
        ({"filter_size": 4}, "4"),
        ({"resolution": 0}, "0"),
        ({"resolution": 64.5}, "resolution is 64.5; give a whole number"),
        ({"supersampling": "2"}, "supersampling is '2'; give a whole number"),
    ],
)
def test_bad_settings_are_named(change: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        ShadowSettings(**change)


@pytest.mark.parametrize("height", [0.0, 1e-3, 0.5])
def test_flat_casters_that_face_the_light(variant: str, height: float) -> None:
    """Their tilt moves no outline, whatever their depth: the derivative of the shadow is small beside that of a motion."""
    square = np.array([[-0.5, -0.4, height], [0.5, -0.5, height], [0.4, 0.5, height], [-0.5, 0.5, height]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    views = [directional_view(mi.Vector3f(0, 0, -1))]
    settings = ShadowSettings(resolution=64)
    norms = []
    for rate in ([1.0, 0.0, 0.0], square[:, 1:2] * [0, 0, 1.0]):
        t = mi.Float(0)
        dr.enable_grad(t)
        moved = points(square) + points(np.broadcast_to(rate, square.shape)) * t
        maps = shadow_scene.make_maps(views, moved, square, faces, settings)
        value = visibility(maps, 0, points(receivers(80, z=-1, half=0.7)))
        dr.forward(t)
        norms.append(float(np.linalg.norm(dr.grad(value).numpy())))
    assert norms[0] > 10 and norms[1] < 0.01 * norms[0], norms


@pytest.mark.parametrize("kind", ["directional", "spot"])
@pytest.mark.parametrize("method", ["vsm", "evsm2", "msm"])
def test_how_far_before_all_receivers_casters_lie_does_not_matter(variant: str, kind: str, method: str) -> None:
    """Far above a square is the edge of another: it lets no light into the first one's shadow, and its motion changes nothing."""
    if kind == "directional":
        views, high, scale = [directional_view(mi.Vector3f(0, 0, -1))], 500.0, 1.0
    else:  # half as large at half the distance
        axes = (mi.Point3f(1, 0, 0), mi.Point3f(0, -1, 0), mi.Point3f(0, 0, -1))
        views, high, scale = [spot_view(mi.Point3f(0, 0, 4), *axes, mi.Float(0.7))], 2.0, 0.5
    square = np.array([[-0.8, -0.8, 0], [0.4, -0.8, 0], [0.4, 0.8, 0], [-0.8, 0.8, 0]])
    world = np.concatenate([square + [0.2, 0, 0], (square + [-0.1, 0.3, 0]) * [scale, scale, 1] + [0, 0, high]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    floor = receivers(60, z=-0.5, half=1.2)
    dark = np.all(np.abs(floor[:, :2]) < [0.5, 0.7], axis=1)
    seen = (points(floor), mi.Bool(True))
    most, slope = [], []
    for receiver_range in (True, False):
        settings = ShadowSettings(method=method, resolution=128, receiver_range=receiver_range)
        rise = mi.Float(0)
        dr.enable_grad(rise)
        higher = mi.Float((np.arange(8) >= 4).astype(np.float32))
        moved = points(world) + mi.Point3f(0, 0, 1) * (higher * rise)
        maps = shadow_scene.make_maps(views, moved, world, faces, settings, seen=seen)
        value = visibility(maps, 0, points(floor))
        dr.forward(rise)
        most.append(float(value.numpy()[dark].max()))
        slope.append(float(np.abs(dr.grad(value).numpy()[dark]).max()))
    assert most[0] < 1e-3 and slope[0] < 1e-6
    if method == "vsm":
        assert most[1] > 0.1


@pytest.mark.parametrize("kind", ["directional", "spot"])
def test_frusta_are_cut_to_what_is_seen(variant: str, kind: str) -> None:
    """Of a wide caster only the part that can shadow the region in view gets texels; there the shadow stays right."""
    casters = trimesh.util.concatenate(
        [BOX.copy().apply_translation([4.0 * i, 4.0 * j, 0]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
    )
    in_view = np.concatenate([receivers(9, z, 1.2) for z in (-1.5, 0.5)])
    hidden = np.array([[50.0, 50.0, 0.0]])
    seen = (points(np.concatenate([in_view, hidden])), mi.Bool([True] * len(in_view) + [False]))
    settings = ShadowSettings(resolution=256)
    views = views_of(kind, 256, 3)
    full = shadow_scene.make_maps(views, points(casters.vertices), casters.vertices, casters.faces, settings)
    cut = shadow_scene.make_maps(views, points(casters.vertices), casters.vertices, casters.faces, settings, seen=seen)
    assert float(cut.frusta.half_x[0]) < 0.8 * float(full.frusta.half_x[0])
    p = receivers(150, half=1.2)
    light = np.array((0.4, 0.3, 2.5)) if kind != "directional" else p - 20 * np.array([0.2, -0.15, -1])
    hit, margin = shadow_scene.occluded(p, np.broadcast_to(light, p.shape), casters.triangles)
    clear = margin > 0.06
    v = look_up(cut, kind, points(p)).numpy()
    assert hit[clear].sum() > 40
    assert np.abs(v - ~hit)[clear].max() < 0.02
