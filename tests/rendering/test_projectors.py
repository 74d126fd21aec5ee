"""Projectors, beams and the spot light's picture, in images: against Mitsuba's, and their derivatives against differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients import scenes

from mitsuba_baselines import derivatives
from shadowmap_dr import Renderer

PLACE = ([1.6, 3.2, 1.2], [-0.2, 0.3, -0.1], [0, 1, 0])


def slide(seed: int = 0) -> dict[str, Any]:
    """A wide picture, smooth between its texels and dark nowhere."""
    pixels = np.random.default_rng(seed).uniform(0.3, 1.0, (4, 8, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True, "wrap_mode": "clamp"}


def projector(**changes: Any) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at(*PLACE)
    return {"type": "projector", "to_world": to_world, "irradiance": slide(), "scale": 6.0, "fov": 50, **changes}


def beam(kind: str = "rectangle", radiance: Any = None) -> dict[str, Any]:
    """A panel out of view, whose beam is cut by the box."""
    to_world = mi.ScalarTransform4f().look_at(*PLACE) @ mi.ScalarTransform4f().scale([0.7, 0.5, 1])
    glow = {"type": "directionalarea", "radiance": radiance or {"type": "rgb", "value": [3.0, 2.0, 1.0]}}
    return {"type": kind, "to_world": to_world, "emitter": glow, "bsdf": scenes.diffuse(0.0)}


def spot_with_slide() -> dict[str, Any]:
    return {**scenes.spot(), "texture": slide(1)}


def sharp_spot() -> dict[str, Any]:
    """One without a falloff: Mitsuba lets beams be wider than their cones."""
    return {**scenes.spot(), "cutoff_angle": 20.0, "beam_width": 30.0}


def lit_by(size: int = 64, **lights: Any) -> Any:
    return scenes.scene(size, box=scenes.box(), **lights)


def shadowmap(**options: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", "shadow_map_resolution": 512, **options})


def relative_error(image: Any, reference: Any) -> float:
    image, reference = np.array(image), np.array(reference)
    return float(np.abs(image - reference).mean() / reference.mean())


def blurred(image: Any, size: int = 4) -> np.ndarray:
    """Means of blocks of pixels."""
    values = np.array(image)
    height, width, channels = values.shape
    return values.reshape(height // size, size, width // size, size, channels).mean((1, 3))


@pytest.mark.parametrize("fov", [50, 140], ids=["one map", "six maps"])
def test_projector_agrees_with_path_tracing(variant: str, fov: float) -> None:
    scale = 6.0 if fov == 50 else 60.0
    made = lit_by(lamp=projector(fov=fov, scale=scale))
    image = mi.render(made, integrator=shadowmap(), spp=16)
    unshadowed = mi.render(made, integrator=shadowmap(shadow_method="none"), spp=16)
    reference = mi.render(made, integrator=mi.load_dict({"type": "direct"}), spp=512)
    assert relative_error(image, reference) < 0.02
    assert relative_error(unshadowed, reference) > 0.05


@pytest.mark.parametrize("kind", ["rectangle", "disk"])
def test_beam_agrees_with_particle_tracing(variant: str, kind: str) -> None:
    """A wall behind the panel, from which the light goes away, casts no shadow."""
    to_world = mi.ScalarTransform4f().look_at(PLACE[0], PLACE[1], PLACE[2]) @ mi.ScalarTransform4f().translate([0, 0, -0.2])
    wall = {"type": "rectangle", "to_world": to_world @ mi.ScalarTransform4f().scale(2), "bsdf": scenes.diffuse(0.5)}
    made = lit_by(panel=beam(kind, slide(2)), wall=wall)
    image = mi.render(made, integrator=shadowmap(), spp=16)
    unshadowed = mi.render(made, integrator=shadowmap(shadow_method="none"), spp=16)
    traced = mi.load_dict({"type": "ptracer", "max_depth": 2})
    reference = mi.render(made, integrator=traced, spp=1024)
    assert relative_error(blurred(image), blurred(reference)) < 0.03
    assert relative_error(blurred(unshadowed), blurred(reference)) > 0.05


def test_all_kinds_of_lights_at_once(variant: str) -> None:
    """The image is the sum of those with one of them each."""
    sky = {"type": "constant", "radiance": 0.2}
    glow = {"type": "area", "radiance": 8.0}
    lamp = {"type": "sphere", "center": [-0.5, 2.6, 1.0], "radius": 0.2, "emitter": glow, "bsdf": scenes.diffuse(0.0)}
    parts = {"sun": scenes.sun(), "spot": spot_with_slide(), "bulb": scenes.bulb(), "beamer": projector(), "panel": beam()}
    parts |= {"lamp": lamp, "sky": sky}

    def only(name: str) -> dict[str, Any]:
        # What else shines stays as a shape: it casts shadows.
        shapes = {key: {k: v for k, v in parts[key].items() if k != "emitter"} for key in ("panel", "lamp")}
        return {key: part if key == name else shapes[key] for key, part in parts.items() if key == name or key in shapes}

    options = {"area_light_samples": 8, "environment_light_samples": 16, "shadow_map_resolution": 128}
    together = np.array(mi.render(lit_by(32, **parts), integrator=shadowmap(**options)))
    alone = [mi.render(lit_by(32, **only(name)), integrator=shadowmap(**options)) for name in parts]
    assert all(np.array(image).max() > 0.05 for image in alone)
    assert relative_error(together, sum(np.array(image) for image in alone)) < 1e-4


def test_texels_of_a_beam_go_to_what_it_can_reach(variant: str) -> None:
    """Although the camera sees much more, and what stands there could cast shadows, too."""
    T = mi.ScalarTransform4f
    blocks = {f"block{k}": {"type": "cube", "to_world": T().translate([k, 0.3, k]).scale(0.3)} for k in (-3, 3)}
    wide = scenes.camera(16, at=(0, 12, 9), fov=60)
    renderer = Renderer.from_scene(lit_by(16, panel=beam(), camera=wide, **blocks), shadow_map_resolution=128)
    reach = renderer.data.lights[0].reach[0]
    assert renderer.frusta.half_x[0] < 1.5 * reach and renderer.frusta.half_y[0] < 1.5 * reach
    assert renderer.frusta.near[0] > 0
    kept = [np.array(value) for value in vars(renderer.frusta).values()]
    renderer.render()
    assert all(np.array_equal(a, b) for a, b in zip(kept, vars(renderer.frusta).values(), strict=True))


def turned(start: Any, x: Any) -> Any:
    return mi.Transform4f(start) @ mi.Transform4f().rotate([0.3, 1, 0.2], 20 * x)


def moved(start: Any, x: Any) -> Any:
    return mi.Transform4f().translate([x, 0, 0.4 * x]) @ mi.Transform4f(start)


def widened(start: Any, x: Any) -> Any:
    return mi.Float(start) + 10 * x


def brighter(start: Any, x: Any) -> Any:
    return start * (1 + x)


def repainted(start: Any, x: Any) -> Any:
    pattern = np.random.default_rng(9).uniform(-1, 1, start.shape).astype(np.float32)
    return start + x * mi.TensorXf(pattern)


# Light, parameter, how it changes.
DERIVATIVES: dict[str, tuple[Callable[[], Any], str, Callable[[Any, Any], Any]]] = {
    "projector moved": (projector, "light.to_world", moved),
    "projector turned": (projector, "light.to_world", turned),
    "projector scale": (projector, "light.scale", brighter),
    "projector picture": (projector, "light.irradiance.data", repainted),
    "spot picture": (spot_with_slide, "light.texture.data", repainted),
    "spot turned": (spot_with_slide, "light.to_world", turned),
    "sharp spot turned": (sharp_spot, "light.to_world", turned),
    "sharp spot moved": (sharp_spot, "light.to_world", moved),
    "sharp spot widened": (sharp_spot, "light.cutoff_angle", widened),
    "rectangle moved": (beam, "light.to_world", moved),
    "rectangle turned": (beam, "light.to_world", turned),
    "rectangle radiance": (beam, "light.emitter.radiance.value", brighter),
    "disk moved": (lambda: beam("disk"), "light.to_world", moved),
}


@pytest.mark.parametrize("name", DERIVATIVES)
def test_derivatives_agree_with_differences(variant: str, name: str) -> None:
    """One sample per pixel is enough, for moving outlines, too; the differences are of 64."""
    light, key, change = DERIVATIVES[name]
    made, integrator = lit_by(light=light()), shadowmap(shadow_map_resolution=128, shadow_filter_size=5)
    params = mi.traverse(made)
    start = params[key]
    start = type(start)(start)

    def image(x: Any, spp: int = 1) -> Any:
        params[key] = change(start, x)
        params.update()
        return mi.render(made, params, integrator=integrator, spp=spp)

    x = mi.Float(0)
    dr.enable_grad(x)
    attached = image(x)
    dr.forward(x)
    derivative = np.array(dr.grad(attached))
    step = 0.01
    difference = (np.array(image(mi.Float(step), 64)) - np.array(image(mi.Float(-step), 64))) / (2 * step)
    found = derivatives.agreement(derivative, difference, 3.0)
    assert found.cosine > 0.98 and 0.97 < found.scale < 1.03, found
    # In reverse mode: the product with some image.
    weights = np.random.default_rng(1).uniform(-1, 1, derivative.shape).astype(np.float32)
    x = mi.Float(0)
    dr.enable_grad(x)
    dr.backward(dr.sum(image(x) * mi.TensorXf(weights)))
    assert dr.grad(x)[0] == pytest.approx(float((derivative * weights).sum()), rel=2e-3)


def test_light_that_was_dark_at_first(variant: str) -> None:
    """Lights switched on, moved and repainted through the scene's parameters, after the first image."""
    glow = {"type": "area", "radiance": 0.0}
    lamp = {"type": "sphere", "center": [-0.5, 2.6, 1.0], "radius": 0.2, "emitter": glow}
    lights = {
        "sun": {**scenes.sun(), "irradiance": 0.0},
        "beamer": projector(scale=0.0),
        "panel": beam(radiance={"type": "rgb", "value": 0.0}),
        "lamp": lamp,
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.0}},
    }
    options = {"area_light_samples": 8, "environment_light_samples": 16, "shadow_map_resolution": 128}
    made, integrator = lit_by(32, **lights), shadowmap(**options)
    assert not np.array(mi.render(made, integrator=integrator)).any()
    params = mi.traverse(made)
    values = {
        "sun.irradiance.value": mi.Float(1.0),
        "beamer.scale": mi.Float(3.0),
        "panel.emitter.radiance.value": mi.Color3f(2.0),
        "lamp.emitter.radiance.value": mi.Float(4.0),
        "sky.radiance.value": mi.Color3f(0.1),
    }
    gradients = {}
    for key, value in values.items():
        before = np.array(mi.render(made, integrator=integrator))
        params[key] = type(params[key])(value)
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(made, params, integrator=integrator)
        assert (np.array(image) - before).max() > 0.02, key
        dr.backward(dr.mean(image))
        gradients[key] = dr.grad(params[key]).numpy().ravel()
        params[key] = dr.detach(params[key])
        params.update()
    assert all(np.isfinite(g).all() and (g > 0).all() for g in gradients.values())
    assert relative_error(mi.render(made, integrator=integrator), mi.render(made, integrator=shadowmap(**options))) < 0.02


def test_frozen_projector_and_beam(variant: str) -> None:
    """The whole step in a frozen function follows what it is given."""
    made, integrator = lit_by(16, light=projector(), panel=beam()), shadowmap(shadow_map_resolution=64)
    params = mi.traverse(made)

    @dr.freeze
    def step(made: Any, params: Any, integrator: Any, scale: Any) -> Any:
        params["light.scale"] = scale
        params.update()
        return mi.render(made, params, integrator=integrator)

    mi.render(made, integrator=integrator)
    images = [np.array(step(made, params, integrator, mi.Float(value))) for value in (0.0, 2.0, 4.0, 6.0)]
    assert np.allclose(images[3] - images[0], 3 * (images[1] - images[0]), atol=1e-4)
    assert (images[1] - images[0]).max() > 0.01
