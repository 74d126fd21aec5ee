"""The gradient suite: derivative images of all kinds of parameters against central differences, and reverse against forward mode.

``gradients/cases.py`` is the table of scenes and parameters. Derivative images are compared after a blur, by cosine and by scale
(`mitsuba_baselines.derivatives.agreement`): with central differences of our own images, and where boundaries of shadows and
surfaces move, with stored ones of path-traced images (`references/make.py`).

Images have 16 samples per pixel (of which each is anti-aliased) unless a case says otherwise. One sample is enough for much, but
not for what is thinner than a pixel: both is written down here.
"""

from __future__ import annotations

import gc
from dataclasses import replace
from functools import cache, lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients import scenes
from gradients.cases import CASES, CASES_BY_NAME, CENTRE, SUN
from gradients.changes import scaled, turned
from gradients.model import Case, Model, Parameter
from references import cases as stored

from mitsuba_baselines import derivatives, reference
from shadowmap_dr import Renderer
from shadowmap_dr.scene.lights.punctual import DirectionalLight

ALL = [(case.name, parameter) for case in CASES for parameter in case.parameters]

# What needs more samples than the case has: ridges that bend (c = 0.997, s = 1.041 with 16), whose place follows from triangles
# at some distance.
SAMPLES = {("fine_box", "caster_deformation"): 64}
# What one sample per pixel is enough for.
AT_ONE_SAMPLE = {
    "sun_box": ("light_direction", "irradiance", "caster_translation", "camera_shift", "floor_reflectance", "floor_height"),
    "sun_cow": ("light_direction", "irradiance"),
    "spot_cow": ("spot_position", "spot_cone", "spot_beam", "spot_intensity", "texture"),
    "crossing_boxes": tuple(CASES_BY_NAME["crossing_boxes"].parameters),
    "fine": ("caster_translation", "caster_scale", "camera_turn"),
}
# What four are enough for.
AT_FOUR_SAMPLES = {
    "fine_box": ("caster_translation", "caster_rise", "caster_scale"),
}
FEW_SAMPLES = [
    (case, name, spp) for spp, cases in ((1, AT_ONE_SAMPLE), (4, AT_FOUR_SAMPLES)) for case in cases for name in cases[case]
]
# And what that is not enough for: (case, parameter, options, samples per pixel, why).
BEYOND = [
    ("sun_box", "caster_rotation", {}, 1, "most pixels miss a face that is half a pixel wide, and with it its edges"),
    ("sun_cow", "caster_scale", {}, 1, "single pixels see facets from the side, on which what they show changes fast"),
]
# Steps of own differences that are shorter than those of path-traced ones: single directions of a sky draw narrow bands.
SHORT_STEPS = {("constant_box", "floor_height"): 0.0025}


@lru_cache(maxsize=1)
def model(variant: str, name: str, spp: int | None, **options: Any) -> Model:
    gc.collect()  # kernels name the BSDFs of all scenes that are alive: one at a time, they are the same again and again
    case = CASES_BY_NAME[name]
    return Model(replace(case, spp=spp or case.spp), **options)


@cache
def derivative(variant: str, name: str, parameter: str, spp: int | None, **options: Any) -> np.ndarray:
    """The derivative image for one parameter, kept: several tests of a case want the same ones."""
    image = model(variant, name, spp, **options).derivative({parameter: 1.0})
    image.flags.writeable = False
    return image


def assert_agree(automatic: np.ndarray, differences: np.ndarray, cosine: float, scale: float, footprint: float = 0.0) -> None:
    result = derivatives.agreement(automatic, differences, footprint)
    message = f"c = {result.cosine:.4f}, s = {result.scale:.4f}"
    assert result.cosine >= cosine and abs(result.scale - 1) <= scale, message


def assert_agrees_with_differences(variant: str, case: str, parameter: str, spp: int | None, **options: Any) -> None:
    automatic = derivative(variant, case, parameter, spp, **options)
    differences = model(variant, case, spp, **options).difference(parameter, SHORT_STEPS.get((case, parameter)))
    assert_agree(automatic, differences, 0.98, 0.03)


# ------------------------------------------------------------------------------------------------------------ differences


@pytest.mark.parametrize(("case", "parameter"), [pair for pair in ALL if (*pair, {}, 16) not in [e[:4] for e in BEYOND]])
def test_derivative_image_agrees_with_differences(variant: str, case: str, parameter: str) -> None:
    assert_agrees_with_differences(variant, case, parameter, SAMPLES.get((case, parameter)))


@pytest.mark.parametrize(("case", "parameter", "spp"), FEW_SAMPLES)
def test_derivative_image_of_few_samples_per_pixel(variant: str, case: str, parameter: str, spp: int) -> None:
    assert_agrees_with_differences(variant, case, parameter, spp)


WITH_DEFAULT_MAPS = [("crossing_meshes", name) for name in CASES_BY_NAME["crossing_meshes"].parameters]


@pytest.mark.parametrize(("case", "parameter"), [("standing_box", "caster_translation"), *WITH_DEFAULT_MAPS])
def test_derivative_image_with_default_maps(variant: str, case: str, parameter: str) -> None:
    assert_agrees_with_differences(variant, case, parameter, 16, shadow_map_resolution=256)


@pytest.mark.parametrize(
    ("case", "parameter", "options", "spp"),
    [
        pytest.param(*entry, marks=pytest.mark.xfail(raises=AssertionError, strict=True, reason=why), id=f"{entry[0]}-{entry[1]}")
        for *entry, why in BEYOND
    ],
)
def test_known_limits(variant: str, case: str, parameter: str, options: dict[str, Any], spp: int) -> None:
    assert_agrees_with_differences(variant, case, parameter, spp, **options)


@pytest.mark.parametrize("traced", stored.TRACED, ids=lambda traced: traced.name)
def test_derivative_image_agrees_with_path_tracing(variant: str, traced: stored.Traced) -> None:
    automatic, target = derivative(variant, traced.case, traced.parameter, None), reference.load(traced.path)
    assert_agree(automatic, target.image, 0.95, 0.05, filter_footprint(traced.case))


@cache
def filter_footprint(name: str) -> float:
    """Width of the shadow filter in pixels, on a surface at the caster that faces light and camera alike.

    0 for extended lights, whose penumbrae are wider than the filter.
    """
    case = CASES_BY_NAME[name]
    renderer = Renderer.from_scene(case.build(), **case.options)
    if not renderer.data.lights:
        return 0.0
    light, sensor, frusta = renderer.light("light"), renderer.data.sensors[0][0], renderer.frusta
    distance = 1.0 if isinstance(light, DirectionalLight) else float(dr.norm(light.position - mi.Point3f(CENTRE))[0])
    texel = 2 * max(frusta.half_x[0], frusta.half_y[0]) * distance / renderer.settings.shadow.resolution
    if sensor.kind == "perspective":
        pixel = dr.norm(sensor.origin - mi.Point3f(CENTRE))
    else:
        pixel = dr.norm(mi.Vector3f(*(sensor.to_world.matrix[k, 0] for k in range(3))))
    pixel *= 2 / dr.abs(sensor.projection[0, 0]) / sensor.width
    return float((renderer.settings.shadow.filter_size * texel / pixel)[0])


# ------------------------------------------------------------------------------------------------------------------ modes


# Single precision loses more where a moving light moves all vertices of all of its maps one way, and all look-ups the other.
ROUNDING = {("sky_box", "sky_turn"): 1e-3, ("panel_box", "lamp_translation"): 3e-4, ("painted_box", "lamp_translation"): 3e-4}


def assert_same_product(weight: np.ndarray, forward: np.ndarray, reverse: float, tolerance: float = 1e-4) -> None:
    """<weight, derivative> by both modes, relative to what could have cancelled in it."""
    terms = weight.astype(np.float64) * forward
    assert abs(reverse - terms.sum()) <= tolerance * np.abs(terms).sum()


def random_image(seed: int, like: np.ndarray) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=like.shape).astype(np.float32)


@pytest.mark.parametrize("case", [case.name for case in CASES])
def test_reverse_mode_agrees_with_forward_mode(variant: str, case: str) -> None:
    """For each parameter, and for all at once: a random image, and the derivative itself, whose products cannot cancel."""
    for kept in (model, derivative):  # maps that have seen a light elsewhere cover a little more: other images
        kept.cache_clear()
    tested = model(variant, case, None)
    names = list(tested.case.parameters)
    images = {name: derivative(variant, case, name, None) for name in names}
    weight = random_image(3, images[names[0]])
    gradients = tested.gradients(weight)
    for name, image in images.items():
        assert np.isfinite(image).all() and np.any(image)
        assert_same_product(weight, image, gradients[name], ROUNDING.get((case, name), 1e-4))
    most = max(names, key=lambda name: float(np.abs(images[name]).sum()))
    assert_same_product(images[most], images[most], tested.gradients(images[most])[most])
    tangents = dict(zip(names, np.random.default_rng(4).normal(size=len(names)), strict=True))
    total = sum(tangents[name] * gradients[name] for name in names)
    assert_same_product(weight, tested.derivative(tangents), total)


@pytest.mark.parametrize("parameter", ["ball", "spot_position"])
def test_single_parameter_gets_the_same_gradient(variant: str, parameter: str) -> None:
    tested = model(variant, "two_lights", None)
    alone = Model(replace(tested.case, parameters={parameter: tested.case.parameters[parameter]}))
    weight = random_image(3, tested.derivative({}))
    assert alone.gradients(weight)[parameter] == pytest.approx(tested.gradients(weight)[parameter], rel=1e-4)


@pytest.mark.parametrize("case", ["sun_box", "spot_cow", "crossing_meshes", "near_plane"])
def test_gradients_of_all_vertices(variant: str, case: str) -> None:
    """Each vertex in a direction of its own, so that no error can hide in a sum over neighbours."""
    renderer = Renderer.from_scene(CASES_BY_NAME[case].build())
    rest = renderer.data.geometry.shape_positions("object")
    direction = mi.Point3f(np.random.default_rng(0).normal(size=(3, dr.width(rest))).astype(np.float32))
    t = mi.Float(0)
    dr.enable_grad(t)
    image = renderer.render(vertex_positions={"object": rest + t * direction})
    dr.forward(t)
    forward = np.array(dr.grad(image))
    for weight in (forward, random_image(1, forward)):
        moved = mi.Point3f(rest)
        dr.enable_grad(moved)
        dr.backward(dr.sum(renderer.render(vertex_positions={"object": moved}) * mi.TensorXf(weight), axis=None))
        gradient = np.array(dr.grad(moved), np.float64)
        assert np.isfinite(gradient).all()
        assert_same_product(weight, forward, float((gradient * np.array(direction)).sum()))


# ------------------------------------------------------------------------------------------------------------ tessellation


def shadow_of_a_block(subdivisions: int) -> Case:
    """The shadow of the tilted box, each face of which is split into 4 ** subdivisions. The box itself is out of the picture."""
    vertices, faces = scenes.block(subdivisions)
    mesh = lambda: scenes.mesh("object", vertices - 3 * scenes.DIRECTION, faces)  # noqa: E731
    parameters = {name: CASES_BY_NAME["sun_box"].parameters[name] for name in ("caster_translation", "caster_rise")}
    about = tuple(float(c) for c in CENTRE - 3 * scenes.DIRECTION)
    parameters["caster_rotation"] = Parameter("object.vertex_positions", turned((0.3, 1, 0.2), about), 0.015)
    parameters["caster_scale"] = Parameter("object.vertex_positions", scaled(about), 0.012)
    return Case("block", lambda: scenes.scene(light=scenes.sun(), object=mesh()), {**parameters, **SUN}, spp=1)


def test_tessellation_of_a_caster_does_not_change_its_derivatives(variant: str) -> None:
    """12 faces or 64 times as many: the images, and what is summed up over them, differ by less than 2 %."""
    coarse, fine = (Model(shadow_of_a_block(n)) for n in (0, 3))
    x, y = np.meshgrid(*2 * [np.linspace(0, 1, scenes.SIZE)])
    weight = np.repeat((np.sin(5 * x + 1) * np.cos(4 * y) + 0.4 * x)[..., None], 3, 2).astype(np.float32)
    gradients = [tested.gradients(weight) for tested in (coarse, fine)]
    for name in coarse.case.parameters:
        a, b = (tested.derivative({name: 1.0}).sum(-1) for tested in (coarse, fine))
        assert np.any(a) and np.linalg.norm(a - b) < 0.02 * np.linalg.norm(a), name
        assert abs(gradients[1][name] - gradients[0][name]) < 0.02 * abs(gradients[0][name]), name
