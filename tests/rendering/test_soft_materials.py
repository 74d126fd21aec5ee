"""Derivatives of light of extended lights on materials that Mitsuba evaluates, where nothing but geometry or a lamp moves."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients import scenes, soft_cases
from gradients.changes import brighter, moved, translated
from gradients.model import Case, Model, Parameter

from mitsuba_baselines import derivatives

OPTIONS = {"area_light_samples": 24, "environment_light_samples": 32, "soft_map_resolution": 64}
CASTER = {"caster": Parameter("object.vertex_positions", translated(1, 0.5, 0), 0.02)}
FLOOR = {"floor": Parameter("floor.to_world", moved(0, 1, 0), 0.02)}
LAMP = {"lamp": Parameter("light.to_world", moved(1, 0, 0.3), 0.04)}
ROUGH = {"type": "roughconductor", "alpha": 0.5}


def textured() -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": scenes.checker()}


def model(floor: Any, light: Any, parameters: dict[str, Parameter], box: Any = None, **options: Any) -> Model:
    def build() -> Any:
        return scenes.scene(32, floor=scenes.floor(floor), light=light, object=scenes.box(box))

    return Model(Case("materials", build, parameters, {**OPTIONS, **options}, spp=4))


def assert_right(tested: Model, scale: float = 0.03) -> None:
    """Forward mode against differences, reverse mode against forward mode."""
    for name in tested.case.parameters:
        image = tested.derivative({name: 1.0})
        found = derivatives.agreement(image, tested.difference(name))
        assert found.cosine >= 0.98 and abs(found.scale - 1) <= scale, f"{name}: c = {found.cosine:.4f}, s = {found.scale:.4f}"
        noise = np.random.default_rng(1).uniform(0.5, 1.5, image.shape).astype(np.float32)
        for weight in (image, image * noise):
            expected = float((image.astype(np.float64) * weight).sum())
            assert tested.gradients(weight)[name] == pytest.approx(expected, rel=1e-3), name


LIGHTS = {"panel": soft_cases.panel, "constant": lambda: {"type": "constant"}}
FLOORS = {
    "bitmap": textured,
    "twosided metal": lambda: {"type": "twosided", "bsdf": ROUGH},
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.4},
    "principled": lambda: {"type": "principled", "roughness": 0.6, "metallic": 0.3},
    "blend": lambda: {"type": "blendbsdf", "weight": 0.4, "a": textured(), "b": ROUGH},
}


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("floor", FLOORS)
def test_caster_alone(variant: str, floor: str, light: str) -> None:
    assert_right(model(FLOORS[floor](), LIGHTS[light](), CASTER))


def test_receiver_alone(variant: str) -> None:
    assert_right(model(ROUGH, soft_cases.panel(), FLOOR))


def test_lamp_alone(variant: str) -> None:
    assert_right(model(textured(), soft_cases.panel(), LAMP, box=ROUGH))


def test_caster_under_a_single_map(variant: str) -> None:
    assert_right(model(ROUGH, soft_cases.panel(), CASTER, emitter_shadows="single"))


def test_several_at_once(variant: str) -> None:
    """Each gets what it gets alone."""
    together = model(ROUGH, soft_cases.panel(), {**CASTER, **FLOOR, **LAMP})
    weight = np.random.default_rng(2).uniform(-1, 1, (32, 32, 3)).astype(np.float32)
    gradients = together.gradients(weight)
    for name, parameter in together.case.parameters.items():
        alone = model(ROUGH, soft_cases.panel(), {name: parameter})
        assert alone.gradients(weight)[name] == pytest.approx(gradients[name], rel=1e-3, abs=1e-4)


def plain_floor() -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}}


@pytest.mark.parametrize("moves", ["colours alone", "with the caster"])
@pytest.mark.parametrize("light", LIGHTS)
def test_plain_colours(variant: str, light: str, moves: str) -> None:
    """In a scene without other materials, the colours of all shapes lie in one table, which is not as wide as the image."""
    colours = {
        "floor": Parameter("floor.bsdf.reflectance.value", brighter, 0.05),
        "box": Parameter("object.bsdf.reflectance.value", brighter, 0.05),
    }
    parameters = colours if moves == "colours alone" else {**colours, **CASTER}
    assert_right(model(plain_floor(), LIGHTS[light](), parameters, plain_floor()))


@pytest.mark.parametrize("recorded", [False, True])
@pytest.mark.parametrize("light", LIGHTS)
def test_colours_of_vertices_alone(variant: str, light: str, recorded: bool) -> None:
    """They belong to the shape, not to its material."""
    box = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    scene = scenes.scene(32, floor=scenes.floor(plain_floor()), light=LIGHTS[light](), object=scenes.box(box))
    shape = next(shape for shape in scene.shapes() if shape.id() == "object")
    colours = np.random.default_rng(0).uniform(0.2, 0.9, 3 * shape.vertex_count())
    shape.add_attribute("vertex_color", 3, colours.tolist())
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "shadowmap", "recorded": recorded, **OPTIONS})

    def brightness(by: float, attached: bool = False) -> Any:
        values = mi.Float(colours + by)
        if attached:
            dr.enable_grad(values)
        params["object.vertex_color"] = values
        params.update()
        return dr.sum(mi.render(scene, params, integrator=integrator), axis=None)

    dr.backward(brightness(0, True))
    total = float(dr.grad(params["object.vertex_color"]).numpy().sum())
    difference = float((brightness(0.05).array[0] - brightness(-0.05).array[0]) / 0.1)
    assert difference > 1 and total == pytest.approx(difference, rel=1e-3)
