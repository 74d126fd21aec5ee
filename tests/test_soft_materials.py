"""Derivatives of light of extended lights on materials that Mitsuba evaluates, where nothing but geometry or a lamp moves."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gradients import scenes, soft_cases
from gradients.changes import moved, translated
from gradients.model import Case, Model, Parameter

from mitsuba_baselines import derivatives

OPTIONS = {"emitter_samples": 24, "environment_samples": 32, "soft_map_resolution": 64}
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
