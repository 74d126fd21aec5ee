"""Penumbrae from a single map, against many maps and Mitsuba."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import shadowmap_dr
from shadowmap_dr.shadow.shadow_map import block_means


def scene(lamp: float = 0.4) -> Any:
    look = mi.ScalarTransform4f().look_at([0, 4, 6], [0, 0.5, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "component_format": "float32"}
    hanging = mi.ScalarTransform4f().translate([1, 3, 1]).rotate([1, 0, 0], 90).scale(lamp)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(5)},
            "ball": {"type": "sphere", "center": [0, 0.8, 0], "radius": 0.6},
            "lamp": {"type": "rectangle", "to_world": hanging, "emitter": {"type": "area", "radiance": 10.0}},
        },
        optimize=False,
    )


def image(of: Any, **options: Any) -> np.ndarray:
    return np.array(mi.render(of, integrator=mi.load_dict({"type": "shadowmap", "shadow_map_resolution": 256, **options}), spp=4))


@pytest.mark.parametrize("lamp", [0.1, 0.4, 0.8])
def test_penumbra_is_as_wide_as_that_of_samples(variant: str, lamp: float) -> None:
    """The larger the light, the wider: one shadow map agrees with Mitsuba much better than no shadows or hard ones."""
    tested = scene(lamp)
    # With 256 samples noise was half of the error of hard shadows.
    expected = np.array(mi.render(tested, integrator=mi.load_dict({"type": "direct"}), spp=4096))

    def error(**options: Any) -> float:
        return float(np.sqrt(((image(tested, **options) - expected) ** 2).mean()) / expected.mean())

    single, unshadowed = error(emitter_shadows="single"), error(shadow_method="none")
    assert single < 0.06 and single < 0.3 * unshadowed
    if lamp > 0.3:
        assert single < 0.7 * error(area_light_samples=1)


def test_forward_and_backward_agree(variant: str) -> None:
    adjoint = np.random.default_rng(0).uniform(0, 1, (64, 64, 3)).astype(np.float32)
    derivatives = []
    for forward in (True, False):
        tested = scene()
        params = mi.traverse(tested)
        shift = dr.opaque(mi.Float, 0)
        dr.enable_grad(shift)
        for key in ("ball.to_world", "lamp.to_world"):
            params[key] = mi.Transform4f().translate(mi.Vector3f(shift, 0, 0)) @ params[key]
        params.update()
        integrator = mi.load_dict({"type": "shadowmap", "emitter_shadows": "single", "area_light_samples": 4})
        rendered = mi.render(tested, params, integrator=integrator)
        if forward:
            dr.forward(shift)
            derivatives.append(float((np.array(dr.grad(rendered)) * adjoint).sum()))
        else:
            dr.backward(dr.sum(rendered * mi.TensorXf(adjoint), axis=None))
            derivatives.append(float(dr.grad(shift)[0]))
    assert derivatives[0] == pytest.approx(derivatives[1], rel=1e-4) and abs(derivatives[0]) > 1


def test_block_means_leave_other_gradients_alone(variant: str) -> None:
    values = mi.Float(np.arange(2 * 4 * 4, dtype=np.float32))
    dr.enable_grad(values)
    both = dr.concat([values * 3, block_means(values, 4, 2, 2)])
    dr.backward(both)
    assert np.allclose(dr.grad(values).numpy(), 3.25)


def test_resolution_must_be_a_power_of_two(variant: str) -> None:
    with pytest.raises(shadowmap_dr.ShadowmapError, match="300.*power of two"):
        shadowmap_dr.Renderer.from_scene(scene(), emitter_shadows="single", shadow_map_resolution=300)
    with pytest.raises(shadowmap_dr.ShadowmapError, match="emitter_shadows is 'one'"):
        shadowmap_dr.Renderer.from_scene(scene(), emitter_shadows="one")


def test_too_many_maps_are_refused(variant: str) -> None:
    with pytest.raises(shadowmap_dr.ShadowmapError, match="4096 shadow maps.*area_light_samples"):
        shadowmap_dr.Renderer.from_scene(scene(), area_light_samples=4096, soft_map_resolution=1024)
