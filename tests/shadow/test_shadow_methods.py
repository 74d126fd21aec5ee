"""The family of pre-filtered shadow maps: formulas, bounds, derivatives, and shadows against shadow rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import shadow_scene
import trimesh

from shadowmap_dr.shadow import PREFILTERED, Frusta, ShadowSettings, cube_views, directional_view, stack_views, visibility
from shadowmap_dr.shadow.methods.comparison import other_depth, soft_comparison
from shadowmap_dr.shadow.methods.depth_scale import DepthScale
from shadowmap_dr.shadow.methods.variance import reduced_bleeding, variance_moments
from shadowmap_dr.shadow.texel_depths import depth_scale

FAMILY = (*PREFILTERED, "pcf")
BOX = trimesh.creation.box((0.8, 0.5, 0.6), transform=trimesh.transformations.euler_matrix(0.3, 0.5, 0.2))
DIRECTION = np.array([0.2, -0.15, -1.0])
ORDER = 8
#: That of a coarse map.
SCALE = DepthScale(1e-5**0.5)


def scale_of(texels: int, *, tiled: bool = False) -> DepthScale:
    """Scale of a map without a filter whose depth range equals its width."""
    view, one = stack_views([directional_view(mi.Vector3f(0, 0, -1))]), mi.Float(1)
    frustum = Frusta(one * 0, one * 0, one, one, one * 0, one * 2, one * 0, one * 2)
    return depth_scale(view, frustum, mi.Float(0), ShadowSettings(resolution=texels, filter_size=1), tiled)


def points(array: np.ndarray) -> Any:
    return mi.Point3f(*(mi.Float(np.ascontiguousarray(array[:, k], np.float32)) for k in range(3)))


def floats(array: Any) -> Any:
    return mi.Float(np.ascontiguousarray(array, np.float32))


def stored(method: str, depths: np.ndarray, weights: np.ndarray, scale: DepthScale = SCALE) -> list[Any]:
    """Filtered texels at some depths (n, k) with weights (n, k)."""
    total: list[Any] = []
    for depth, weight in zip(depths.T, weights.T, strict=True):
        part = [value * floats(weight) for value in PREFILTERED[method].encode(floats(depth), 0, ORDER, scale)]
        total = [a + b for a, b in zip(total, part, strict=True)] if total else part
    return total


@pytest.mark.parametrize("method", PREFILTERED)
def test_one_surface_shadows_what_lies_behind_it(variant: str, method: str) -> None:
    depth = np.linspace(-0.45, 0.3, 60)
    texels = stored(method, depth[:, None], np.ones((60, 1)))
    resolve = PREFILTERED[method].resolve
    assert resolve(texels, floats(depth), SCALE).numpy().min() > 0.98  # the surface itself
    assert resolve(texels, floats(depth - 0.05), SCALE).numpy().min() > 0.98
    far = 0.3 if method == "csm" else 0.15  # a series of few terms has a soft step
    assert resolve(texels, floats(depth + far), SCALE).numpy().max() < (0.08 if method == "csm" else 0.02)


@pytest.mark.parametrize("method", PREFILTERED)
def test_half_covered_surfaces_are_half_lit(variant: str, method: str) -> None:
    """Two depths, a receiver on the farther one: half of the light arrives (the convolution map rounds the step off)."""
    near = np.linspace(-0.4, 0.0, 20)
    depths = np.stack([near, near + 0.3], 1)
    value = PREFILTERED[method].resolve(stored(method, depths, np.full((20, 2), 0.5)), floats(near + 0.3), SCALE).numpy()
    np.testing.assert_allclose(value, 0.5, atol=0.12 if method == "csm" else 0.02)


@pytest.mark.parametrize("texels", [256, 1024, 4096])
@pytest.mark.parametrize("method", ["evsm2", "evsm4"])
def test_gaps_of_texels_are_told_apart(variant: str, method: str, texels: int) -> None:
    """An occluder five texels before a receiver hides it, however small a texel is; a surface does not hide itself."""
    receiver = np.linspace(-0.45, 0.5, 200)
    for gap, dark in ((5 / texels, True), (0.0, False)):
        depths = (receiver - gap)[:, None]
        value = PREFILTERED[method].resolve(stored(method, depths, np.ones((200, 1))), floats(receiver), scale_of(texels)).numpy()
        assert value.max() < 0.08 if dark else value.min() > 0.99


@pytest.mark.parametrize("share", [0.05, 0.1, 0.2])
def test_backgrounds_let_no_light_to_receivers_close_behind_a_caster(variant: str, share: float) -> None:
    """A roof's edge covers most of a texel, the ground far below the rest. Just below the roof it is as dark as coverage says.

    Chebyshev's bound for depths that are hardly warped lets twice as much through.
    """
    roof = np.linspace(-0.4, 0.1, 20)
    weights = np.tile([1 - share, share], (20, 1))

    def value(scale: DepthScale) -> np.ndarray:
        texels = stored("evsm4", np.stack([roof, roof + 0.3], 1), weights, scale)
        found: np.ndarray = PREFILTERED["evsm4"].resolve(texels, floats(roof + 10 / 64), scale).numpy()
        return found

    found = value(scale_of(64, tiled=True))
    assert found.min() > 0.9 * share and found.max() < 1.4 * share
    assert value(scale_of(64)).min() > 2 * share


@pytest.mark.parametrize(("method", "bleeds"), [("vsm", True), ("evsm4", False), ("evsm2", False), ("esm", False)])
def test_bleeding(variant: str, method: str, bleeds: bool) -> None:
    """Occluders at two depths hide a receiver behind both: the difference of the depths lets light through in a variance map."""
    n = 20
    depths = np.tile([[-0.45, 0.1]], (n, 1))
    receiver = np.linspace(0.2, 0.4, n)
    value = PREFILTERED[method].resolve(stored(method, depths, np.full((n, 2), 0.5)), floats(receiver), SCALE).numpy()
    assert (value.min() > 0.1) == bleeds
    assert bleeds or value.max() < 0.03


def test_moment_map_is_sharper_than_variance_map(variant: str) -> None:
    n = 20
    depths, receiver = np.tile([[-0.45, 0.1]], (n, 1)), floats(np.linspace(0.2, 0.4, n))
    weights = np.full((n, 2), 0.5)
    vsm, msm = (PREFILTERED[m].resolve(stored(m, depths, weights), receiver, SCALE).numpy() for m in ("vsm", "msm"))
    assert msm.max() < 0.05 < vsm.min()


def hankel_bound(moments: np.ndarray, z: float) -> float:
    """The least mass before z, from the definition: quadrature at z and the roots of the orthogonal polynomial."""
    b = np.array([[1, moments[0], moments[1]], [moments[0], moments[1], moments[2]], [moments[1], moments[2], moments[3]]])
    c = np.linalg.solve(b, [1, z, z * z])
    support = np.array([z, *np.roots(c[::-1])])
    weights = np.linalg.solve(np.vander(support, 3, increasing=True).T, [1, moments[0], moments[1]])
    return float(weights[1:][support[1:] < z].sum())


def test_hamburger_bound(variant: str) -> None:
    rng = np.random.default_rng(4)
    depths, weights = rng.uniform(-0.45, 0.45, (200, 5)), rng.dirichlet(np.ones(5), 200)
    receiver = rng.uniform(-0.5, 0.5, 200)
    got = PREFILTERED["msm"].resolve(stored("msm", depths, weights), floats(receiver), SCALE).numpy()
    want = []
    for z, w, d in zip(2 * depths, weights, 2 * receiver, strict=True):
        moments = np.array([(w * z**k).sum() for k in (1, 2, 3, 4)])
        moments += 3e-6 * (np.array([0, 0.375, 0, 0.375]) - moments)
        want.append(1 - hankel_bound(moments, d))
    assert np.abs(got - want).max() < 0.02
    assert np.abs(got - want).mean() < 1e-3


def test_large_derivatives_of_the_hamburger_bound_are_true(variant: str) -> None:
    """Receivers around one surface: a root that passes through infinity must not leave differences of huge numbers.

    Oracle: central differences in double precision, where derivatives are largest.
    """
    rng = np.random.default_rng(7)
    n, step = 200_000, 1e-8
    depth = rng.uniform(-0.5, 0.5, n)
    inputs = PREFILTERED["msm"].encode(floats(depth), floats(10.0 ** rng.uniform(-6, -3, n)), 0, SCALE)
    inputs.append(floats(depth + 0.02 * rng.normal(size=n)))
    dr.enable_grad(inputs)
    dr.backward(dr.sum(PREFILTERED["msm"].resolve(inputs[:4], inputs[4], SCALE)))
    got = np.array([dr.grad(i).numpy() for i in inputs])

    def value(at: np.ndarray) -> float:
        moments = at[:4] + 3e-6 * (np.array([0, 0.375, 0, 0.375]) - at[:4])
        return 1 - hankel_bound(moments, 2 * at[4])

    largest = np.argsort(-np.abs(got).max(0))[:40]
    places = np.array([i.numpy() for i in inputs], float)[:, largest].T
    want = np.array([[(value(p + d) - value(p - d)) / (2 * step) for d in step * np.eye(5)] for p in places]).T
    assert np.abs(got[:, largest] - want).max() < 0.25 * np.abs(want).max()


def random_texels(method: str) -> tuple[list[Any], np.ndarray]:
    """Filtered values of random depths, degenerate ones (one depth, all far, all near) and nonsense, and receivers."""
    rng = np.random.default_rng(1)
    depths, weights = rng.uniform(-0.5, 0.5, (3000, 3)), rng.dirichlet(np.full(3, 0.3), 3000)
    depths[:500] = depths[:500, :1]
    depths[500:600], depths[600:700] = 0.5, -0.5
    receiver = rng.uniform(-0.6, 0.5, 3000)
    receiver[:250] = depths[:250, 0]
    texels = stored(method, depths, weights)
    nonsense = [dr.concat([t, floats(rng.normal(size=300)), dr.zeros(mi.Float, 100)]) for t in texels]
    return nonsense, np.r_[receiver, rng.uniform(-0.6, 0.5, 400)]


@pytest.mark.parametrize("method", PREFILTERED)
def test_bounded_and_finite_on_any_moments(variant: str, method: str) -> None:
    texels, receiver = random_texels(method)
    depth = floats(receiver)
    dr.enable_grad(texels, depth)
    value = reduced_bleeding(PREFILTERED[method].resolve(texels, depth, SCALE), 0.2)
    assert np.isfinite(value.numpy()).all()
    assert ((value.numpy() >= 0) & (value.numpy() <= 1)).all()
    dr.backward(dr.sum(value))
    for g in (*(dr.grad(t) for t in texels), dr.grad(depth)):
        assert np.isfinite(g.numpy()).all()


def shadow(settings: ShadowSettings, offset: Any, frusta: Any = None, n: int = 60) -> tuple[Any, Any, np.ndarray]:
    """(visibility on a plane behind the box, its maps, the plane's points) for a box that is moved by ``offset``."""
    line = 1.2 * ((2 * np.arange(n) + 1) / n - 1)
    x, y = np.meshgrid(line, line)
    plane = np.c_[x.ravel(), y.ravel(), np.full(n * n, -1.5)]
    vertices = points(BOX.vertices) + offset
    views = [directional_view(mi.Vector3f(*DIRECTION.tolist()))]
    maps = shadow_scene.make_maps(views, vertices, BOX.vertices, BOX.faces, settings, frusta=frusta)
    return visibility(maps, 0, points(plane)), maps, plane


@pytest.mark.parametrize("method", FAMILY)
def test_agrees_with_shadow_rays(variant: str, method: str) -> None:
    value, maps, plane = shadow(ShadowSettings(method=method, resolution=512, order=ORDER), mi.Vector3f(0))
    light = plane - 20 * DIRECTION
    hit, margin = shadow_scene.occluded(plane, light, BOX.triangles)
    clear = margin > 6 * float(dr.max(maps.frusta.half_x)[0]) / 512
    assert hit[clear].sum() > 40
    assert np.abs(value.numpy() - ~hit)[clear].max() < (0.1 if method == "csm" else 0.02)


@pytest.mark.parametrize("filter_size", [3, 7])
@pytest.mark.parametrize("method", FAMILY)
def test_derivatives(variant: str, method: str, filter_size: int) -> None:
    """A caster that moves: forward and backward agree, and both with central differences of the same image."""
    settings = ShadowSettings(method=method, resolution=128, filter_size=filter_size, order=ORDER)
    weights = floats(np.random.default_rng(0).normal(size=3600))

    frusta = shadow(settings, mi.Vector3f(0))[1].frusta

    def value(t: Any) -> Any:
        return shadow(settings, mi.Vector3f(t, 0.5 * t, 0), frusta)[0]

    t = mi.Float(0)
    dr.enable_grad(t)
    image = value(t)
    dr.forward(t)
    derivative = dr.grad(image).numpy()
    t = mi.Float(0)
    dr.enable_grad(t)
    dr.backward(dr.sum(value(t) * weights))
    assert float(t.grad[0]) == pytest.approx(float((derivative * weights.numpy()).sum()), rel=1e-3, abs=1e-3)
    step = 2e-3
    difference = (value(mi.Float(step)).numpy() - value(mi.Float(-step)).numpy()) / (2 * step)
    cosine, scale = compared(derivative, difference)
    least, tolerance = (0.98, 0.03) if method == "pcf" else (0.97, 0.1)
    assert cosine > least and abs(scale - 1) < tolerance, (cosine, scale)


def test_comparisons_without_antialiasing_do_not_see_outlines_move(variant: str) -> None:
    t = mi.Float(0)
    dr.enable_grad(t)
    image, maps, _ = shadow(ShadowSettings(method="pcf", resolution=64, antialias=False), mi.Vector3f(t, 0, 0))
    assert maps.channels == 1 and image.numpy().min() < 0.1
    dr.forward(t)
    # The receiver lies far behind the caster: the changing depth of the caster's faces decides no comparison.
    np.testing.assert_array_equal(dr.grad(image).numpy(), 0)


def test_moments_tell_what_has_been_blended(variant: str) -> None:
    """Two depths, mixed by any share: the depth that is not at the centre and its share; and derivatives by the share."""
    rng = np.random.default_rng(5)
    first, second, share = rng.uniform(-0.5, 0.5, 2000), rng.uniform(-0.5, 0.5, 2000), rng.uniform(0.05, 0.95, 2000)
    apart = np.abs(first - second) > 0.02
    first, second, share = floats(first[apart]), floats(second[apart]), floats(share[apart])
    dr.enable_grad(share)
    moments = dr.lerp(variance_moments(first), variance_moments(second), share)
    other, part = other_depth(first, moments)
    dr.backward(dr.sum(part))
    np.testing.assert_allclose(part.numpy(), share.numpy(), atol=2e-3)
    np.testing.assert_allclose(other.numpy(), second.numpy(), atol=1e-3)
    np.testing.assert_allclose(dr.grad(share).numpy(), 1, atol=0.05)


def test_two_depths_are_bounded_and_finite_on_any_moments(variant: str) -> None:
    rng = np.random.default_rng(6)
    depth = rng.uniform(-0.5, 0.5, 4000)
    mean, square = rng.uniform(-0.5, 0.5, 4000), rng.uniform(0, 0.25, 4000)
    # Nothing blended, hardly anything, rounding alone, the ends of the range, nonsense, zeros.
    mean[:500] = depth[:500] + np.repeat([0, 1e-7, 1e-6, 2e-6, 1e-5], 100)
    square[:1000] = mean[:1000] ** 2 + rng.normal(size=1000) * np.repeat([0, 1e-8], 500)
    depth[1000:1100], mean[1000:1100], square[1000:1100] = 0.5, 0.5, 0.25
    mean[1100:1400], square[1100:1400] = rng.normal(size=(2, 300))
    depth[1400:1410] = mean[1400:1410] = square[1400:1410] = 0
    numbers = [floats(x) for x in (depth, mean, square)]
    dr.enable_grad(numbers)
    other, share = other_depth(numbers[0], mi.Vector2f(*numbers[1:]))
    lit = [soft_comparison(d, floats(rng.uniform(-0.5, 0.5, 4000)), 5e-3, 0.02) for d in (numbers[0], other)]
    value = dr.lerp(*lit, share)
    for x, low, high in ((other, -0.5, 0.5), (share, 0, 1 + 1e-6), (value, -1e-6, 1 + 1e-6)):
        assert np.isfinite(x.numpy()).all() and low <= x.numpy().min() and x.numpy().max() <= high
    np.testing.assert_array_equal(share.numpy()[:200], 0)
    dr.backward(dr.sum(value))
    for x in numbers:
        assert np.isfinite(dr.grad(x).numpy()).all()


@pytest.mark.parametrize("method", PREFILTERED)
def test_occluders_and_receivers_at_the_ends_of_the_range(variant: str, method: str) -> None:
    """If all casters lie before all receivers, one ends up at -1/2 and the other at 1/2."""
    depths = np.full((4, 1), -0.5)
    value = PREFILTERED[method].resolve(stored(method, depths, np.ones((4, 1))), floats([0.3, 0.4, 0.45, 0.5]), SCALE).numpy()
    assert value.max() < (0.1 if method == "csm" else 0.01)


@pytest.mark.parametrize("method", ["vsm", "esm", "csm"])  # 2, 1 and 8 numbers a texel
def test_supersampled_texels_are_means(variant: str, method: str) -> None:
    """Of texels of a finer map, in all maps of a batch; and derivatives in both modes go through the mean."""
    views = list(cube_views(mi.Point3f(0.4, 0.3, 0.7), 32, 1))
    base = ShadowSettings(method=method, resolution=32, filter="none", order=4)
    vertices = points(BOX.vertices)

    def values(settings: ShadowSettings, t: Any = 0) -> Any:
        moved = vertices + mi.Vector3f(t, 0.5 * t, 0)
        return shadow_scene.make_maps(views, moved, BOX.vertices, BOX.faces, settings, frusta=frusta).values

    frusta = shadow_scene.make_maps(views, vertices, BOX.vertices, BOX.faces, base).frusta
    supersampled = replace(base, supersampling=4)
    fine = values(replace(base, resolution=128)).numpy().reshape(6, 32, 4, 32, 4, -1)
    coarse = values(supersampled).numpy().reshape(6, 32, 32, -1)
    assert (coarse.std(axis=(1, 2)).max(axis=1) > 1e-3).sum() >= 2  # the box is in several maps
    np.testing.assert_allclose(coarse, fine.mean((2, 4), dtype=np.float64), rtol=1e-5, atol=1e-5)

    weights = floats(np.random.default_rng(2).normal(size=coarse.size))
    t = mi.Float(0)
    dr.enable_grad(t)
    stored_values = values(supersampled, t)
    dr.forward(t)
    forward = (dr.grad(stored_values).numpy() * weights.numpy()).sum()
    t = mi.Float(0)
    dr.enable_grad(t)
    dr.backward(dr.sum(values(supersampled, t) * weights))
    assert float(t.grad[0]) == pytest.approx(float(forward), rel=1e-3)


def test_supersampled_derivatives_are_closer_to_differences(variant: str) -> None:
    """Without a filter, coverage that is exact along one axis only is seen in the derivative; finer texels come closer."""
    errors = []
    for supersampling in (1, 4):
        settings = ShadowSettings(resolution=64, filter="none", supersampling=supersampling)
        frusta = shadow(settings, mi.Vector3f(0))[1].frusta
        t = mi.Float(0)
        dr.enable_grad(t)
        image = shadow(settings, mi.Vector3f(t, 0.5 * t, 0), frusta)[0]
        dr.forward(t)
        step = 0.01
        low, high = (shadow(settings, mi.Vector3f(x, 0.5 * x, 0), frusta)[0].numpy() for x in (-step, step))
        errors.append(1 - compared(dr.grad(image).numpy(), (high - low) / (2 * step))[0])
    assert errors[1] < 0.5 * errors[0], errors


def compared(derivative: np.ndarray, reference: np.ndarray) -> tuple[float, float]:
    """Cosine, and the factor by which the first is larger."""
    product = float((derivative * reference).sum())
    squares: Callable[[np.ndarray], float] = lambda x: float((x * x).sum())  # noqa: E731
    return product / np.sqrt(squares(derivative) * squares(reference)), product / squares(reference)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"method": "msm", "compat": True}, "msm"),
        ({"bleeding": 1.0}, "1.0"),
        ({"order": 3}, "3"),
        ({"order": 18}, "18"),
        ({"supersampling": 0}, "0"),
        ({"supersampling": 4, "resolution": 2048}, "4096"),
        ({"supersampling": 2, "method": "pcf"}, "pcf"),
    ],
)
def test_bad_settings_are_named(change: dict[str, Any], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        ShadowSettings(**change)
