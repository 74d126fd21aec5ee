"""Mitsuba's ``sunsky``: a sky that is sampled, and a sun that casts shadows as a directional light does."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import shadowmap_dr
from shadowmap_dr.scene.lights.environment import SunSky, environment_of
from shadowmap_dr.scene.lights.read import environments_of, lights_of

_DIRECTION = (0.6, -0.36, 0.72)
# The disc itself, where a camera sees it, would be all that an error measures.
_BRIGHTEST = 50.0


def _t() -> Any:
    return mi.ScalarTransform4f()


def _scene(direction: tuple[float, ...] = _DIRECTION, **sky: Any) -> Any:
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.4, 0.2]}}
    return mi.load_dict({
        "type": "scene",
        "sky": {"type": "sunsky", "sun_direction": list(direction), "turbidity": 3.0, **sky},
        "floor": {"type": "rectangle", "to_world": _t().scale(20), "bsdf": diffuse},
        "ball": {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.6, "bsdf": diffuse},
        "sensor": {
            "type": "perspective", "fov": 45,
            "to_world": _t().look_at(origin=[0, -4, 3], target=[0, 0, 0.5], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        },
    }, optimize=False)  # fmt: skip


def _ours(**parameters: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", "environment_light_samples": 128, "shadow_map_resolution": 512, **parameters})


def _path_traced(scene: Any, spp: int, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=spp, seed=seed))


def _agreement(ours: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """(cosine, scale) of images, after a blur of 5 pixels."""
    kernel = np.ones(5) / 5
    for axis in (0, 1):
        ours, other = (np.apply_along_axis(np.convolve, axis, image, kernel, "same") for image in (ours, other))
    dot = float((ours * other).sum())
    return dot / float(np.sqrt((ours**2).sum() * (other**2).sum())), dot / float((other**2).sum())


@pytest.mark.parametrize(
    ("direction", "aperture"),
    [(_DIRECTION, 0.5358), ((0.7, -0.7, 0.1), 0.5358), ((0.0, 0.0, 1.0), 0.5358), (_DIRECTION, 3.0)],
    ids=["high", "low", "zenith", "large"],
)
def test_images_agree_with_mitsubas(variant: str, direction: tuple[float, ...], aperture: float) -> None:
    scene = _scene(direction, sun_aperture=aperture)
    ours = np.array(mi.render(scene, integrator=_ours(), spp=16))
    first, second = (_path_traced(scene, 512, seed) for seed in (1, 2))
    reference, variance = 0.5 * (first + second), ((first - second) ** 2).mean() / 4
    seen = reference.max(-1) < _BRIGHTEST
    error = ((ours - reference)[seen] ** 2).mean() - variance
    assert np.sqrt(max(error, 0)) <= 0.03 * np.sqrt((reference[seen] ** 2).mean())
    assert ours[seen].mean() == pytest.approx(reference[seen].mean(), rel=0.01)


def test_the_sky_is_as_without_the_sun(variant: str) -> None:
    """Everywhere, and in the sun's own place where only its scale tells them apart."""
    scene, sunless = _scene(), _scene(sun_scale=0.0)
    sky, other = environments_of(scene)[0], environments_of(sunless)[0]
    assert isinstance(sky, SunSky)
    towards = -lights_of(scene)[0].direction
    rng = np.random.default_rng(0)
    angles = np.concatenate([[0.0], np.radians(rng.uniform(0, 0.6, 200)), rng.uniform(0, np.pi, 200)])
    around = rng.uniform(0, 2 * np.pi, len(angles))
    s, t = mi.coordinate_system(towards)
    near = towards * mi.Float(np.cos(angles).astype(np.float32))
    side = s * mi.Float(np.cos(around).astype(np.float32)) + t * mi.Float(np.sin(around).astype(np.float32))
    directions = near + side * mi.Float(np.sin(angles).astype(np.float32))
    found = np.array(sky.diffuse_radiance(directions))
    # In the place of the disc is what surrounds it, half a degree across.
    np.testing.assert_allclose(found, np.array(other.radiance(directions)), rtol=1e-2, atol=1e-4)
    assert np.array(sky.radiance(towards)).min() > 1000 > found.max()


def test_the_suns_irradiance_is_that_of_its_disc(variant: str) -> None:
    rng = np.random.default_rng(0)
    for aperture in (0.2, 0.5358, 5.0):
        scene = _scene(sun_aperture=aperture)
        (sun,) = lights_of(scene)
        assert sun.name == "sky.sun"
        # By chance, over a cone that holds the disc: uniform by solid angle.
        cone = np.radians(0.6 * aperture)
        cosines = rng.uniform(np.cos(cone), 1, 200_000)
        around = rng.uniform(0, 2 * np.pi, len(cosines))
        across = np.sqrt(1 - cosines**2)
        local = mi.Vector3f(*((across * np.cos(around)), (across * np.sin(around)), cosines))
        directions = mi.Frame3f(-sun.direction).to_world(local)
        sky, sunless = (environments_of(s)[0] for s in (scene, _scene(sun_scale=0.0, sun_aperture=aperture)))
        disc = np.array(sky.radiance(directions)) - np.array(sunless.radiance(directions))
        expected = disc.mean(-1) * 2 * np.pi * (1 - np.cos(cone))
        np.testing.assert_allclose(np.array(sun.irradiance).ravel(), expected, rtol=0.02)


def test_shadows_follow_the_sun(variant: str) -> None:
    """The derivative with respect to the sun's direction, which moves the shadow, against path-traced differences."""
    scene = _scene()
    params, key, step = mi.traverse(scene), "sky.sun_direction", 0.02
    rest = np.array(params[key]).ravel()
    across = np.cross(rest, [0, 0, 1])
    across /= np.linalg.norm(across)

    def turn(angle: Any) -> None:
        values = (mi.Float(float(r)) + angle * float(a) for r, a in zip(rest, across, strict=True))
        params[key] = mi.Vector3f(*values)
        params.update()

    def difference(render: Any) -> np.ndarray:
        images = []
        for angle in (step, -step):
            turn(angle)
            images.append(render())
        return (images[0] - images[1]) / (2 * step)

    angle = mi.Float(0)
    dr.enable_grad(angle)
    turn(angle)
    image = mi.render(scene, params, integrator=_ours(), spp=16)
    dr.forward(angle)
    derivative = np.array(dr.grad(image))
    assert np.isfinite(derivative).all() and np.abs(derivative).max() > 1

    turn(angle)
    image = mi.render(scene, params, integrator=_ours(), spp=16)
    dr.backward(dr.sum(image.array * mi.Float(derivative.ravel())))
    assert dr.grad(angle)[0] == pytest.approx(float((derivative**2).sum()), rel=1e-3)

    own = difference(lambda: np.array(mi.render(scene, integrator=_ours(), spp=16)))
    traced = difference(lambda: _path_traced(scene, 1024))
    for other in (own, traced):
        cosine, scale = _agreement(derivative, other)
        assert cosine >= 0.98 and 0.97 <= scale <= 1.03


def test_a_sun_below_the_horizon_is_dark(variant: str) -> None:
    scene = _scene((0.5, 0.5, -0.2))
    (sun,) = lights_of(scene)
    assert np.array(sun.irradiance).max() == 0
    image = np.array(mi.render(scene, integrator=_ours()))
    assert np.isfinite(image).all() and image.min() >= 0


def test_a_sky_may_be_turned(variant: str) -> None:
    """``to_world`` turns the zenith, and leaves the sun where it is."""
    turned = _scene((0.3, -0.6, 0.5), to_world=_t().rotate([1, 0, 0], 40))
    ours = np.array(mi.render(turned, integrator=_ours(), spp=4))
    reference = _path_traced(turned, 512)
    seen = reference.max(-1) < _BRIGHTEST
    assert ours[seen].mean() == pytest.approx(reference[seen].mean(), rel=0.01)
    assert _agreement(ours[..., :1] * seen[..., None], reference[..., :1] * seen[..., None])[0] >= 0.999


def test_renderings_of_a_sky_can_be_frozen(variant: str) -> None:
    scene = _scene()
    renderer = shadowmap_dr.Renderer.from_scene(scene)
    rest = mi.Float(dr.detach(renderer.data.geometry.positions))
    info = next(info for info in renderer.data.geometry.shapes if info.name == "ball")
    own = slice(3 * info.vertex_start, 3 * (info.vertex_start + info.vertex_count))
    vertices = rest.numpy()[own].copy()

    @dr.freeze
    def frozen(vertices: Any, renderer: Any) -> Any:
        return renderer.render(vertex_positions={"ball": vertices})

    for shift in (0.0, 0.1, 0.2):
        moved = mi.Float(vertices + np.tile(np.float32([shift, 0, 0]), info.vertex_count))
        expected = shadowmap_dr.Renderer.from_scene(scene).render(vertex_positions={"ball": moved})
        np.testing.assert_allclose(np.array(frozen(moved, renderer)), np.array(expected), atol=2e-3)


def test_a_sky_placed_by_date_has_a_sun(variant: str) -> None:
    scene = mi.load_dict({
        "type": "scene",
        "sky": {"type": "sunsky", "hour": 12.0, "month": 6, "latitude": 45.0, "longitude": 9.0, "timezone": 2.0},
        "floor": {"type": "rectangle"},
    })  # fmt: skip
    (sun,) = lights_of(scene)
    assert np.array(sun.direction)[2] < -0.5 and np.array(sun.irradiance).min() > 0.1
    assert isinstance(environment_of(scene.emitters()[0], "sky"), SunSky)
