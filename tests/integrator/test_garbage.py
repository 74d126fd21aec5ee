"""Scenes are freed with the last reference to them, not when Python collects garbage.

An area light has a bare pointer to its shape. If a cycle of references keeps the light until garbage is collected, and its
shape is freed before, Mitsuba's own integrators end the process in the next scene: they call all lights that are alive.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import SOFT, render, shadowmap, small_scene

from shadowmap_dr import Renderer


def lamp() -> dict[str, Any]:
    turned = mi.ScalarTransform4f().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.3)
    return {"type": "rectangle", "to_world": turned, "emitter": {"type": "area", "radiance": 5.0}}


def parts() -> dict[str, Any]:
    """A lamp, a sky, instances, a textured card with an opacity."""
    T = mi.ScalarTransform4f
    pixels = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, (4, 9, 3)).astype(np.float32))
    image = {"type": "bitmap", "bitmap": pixels, "raw": True}
    card = {"type": "mask", "opacity": 0.5, "bsdf": {"type": "diffuse", "reflectance": image}}
    placed = {"type": "instance", "to_world": T().translate([1, 0, 0.5]), "group": {"type": "ref", "id": "group"}}
    return {
        "lamp": lamp(),
        "sky": {"type": "envmap", "bitmap": pixels},
        "group": {"type": "shapegroup", "cube": {"type": "cube", "to_world": T().scale(0.2)}},
        "instance": placed,
        "card": {"type": "rectangle", "to_world": T().translate([0, 0, 1]).scale(0.4), "bsdf": card},
    }


def image() -> None:
    render(small_scene(**parts()), shadowmap(**SOFT))


def further_channels() -> None:
    render(small_scene(**parts()), shadowmap(aovs="depth,visibility", **SOFT))


def step_of_lamp() -> None:
    scene, integrator = small_scene(lamp=lamp(), sun=None), shadowmap(**SOFT)
    params = mi.traverse(scene)
    for _ in range(7):  # those from the fifth on are recorded
        for key in ("lamp.emitter.radiance.value", "ball.vertex_positions"):
            params[key] = type(params[key])(dr.detach(params[key]))
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, integrator=integrator, spp=1), axis=None))


def derivative_image() -> None:
    scene = small_scene(lamp=lamp(), sun=None)
    params = mi.traverse(scene)
    dr.enable_grad(params["lamp.emitter.radiance.value"])
    dr.set_grad(params["lamp.emitter.radiance.value"], 1)
    params.update()
    dr.eval(shadowmap(**SOFT).render_forward(scene, params, spp=1))


def renderer() -> None:
    Renderer.from_scene(small_scene(**parts())).render(spp=1)


@pytest.mark.parametrize("way", [image, further_channels, step_of_lamp, derivative_image, renderer])
@pytest.mark.filterwarnings("ignore")
def test_no_garbage_holds_mitsubas_objects(variant: str, way: Callable[[], None]) -> None:
    way()  # modules that are imported, and functions that are made, once
    gc.collect()
    flags, enabled = gc.get_debug(), gc.isenabled()
    gc.disable()
    try:
        gc.set_debug(gc.DEBUG_SAVEALL)
        way()
        gc.collect()
        held = {
            (type(one).__name__, str(part)) for one in gc.garbage for part in gc.get_referents(one) if isinstance(part, mi.Object)
        }
    finally:
        gc.set_debug(flags)
        gc.garbage.clear()
        if enabled:
            gc.enable()
    assert not held
