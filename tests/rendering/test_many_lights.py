"""Scenes of many lights: sums in loops on the device, equal to what is written out, by programs that do not grow."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.rendering import light_loops, light_pass

SIZE = 32


def scene(counts: tuple[int, int, int]) -> Any:
    """Two shapes on a floor under so many directional, point and spot lights; one spot light more has a picture."""
    random, transform = np.random.default_rng(0), mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    look = transform().look_at([0, -4, 5], [0, 0, 0], [0, 0, 1])
    parts: dict[str, Any] = {
        "type": "scene", "floor": {"type": "rectangle", "to_world": transform().scale(3)},
        "ball": {"type": "sphere", "center": [0.5, 0.3, 0.7], "radius": 0.5, "bsdf": {"type": "diffuse"}},
        "box": {"type": "cube", "to_world": transform().translate([-0.7, 0, 0.5]).scale(0.4)},
        "sensor": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
    }  # fmt: skip
    picture = {"type": "bitmap", "data": mi.TensorXf(random.uniform(0, 1, (4, 4, 3)).astype(np.float32)), "raw": True}
    for k in range(sum(counts) + 1):
        x, y = (float(v) for v in random.uniform(-2, 2, 2))
        place = {"to_world": transform().look_at([x, y, 3], [0.2 * x, 0.2 * y, 0], [0, 1, 0])}
        if k < counts[0]:
            light = {"type": "directional", "direction": [0.3 * x, 0.3 * y, -1], "irradiance": 0.2}
        elif k < counts[0] + counts[1]:
            light = {"type": "point", "position": [x, y, 3], "intensity": {"type": "rgb", "value": [1, 0.5, abs(x)]}}
        else:
            light = {"type": "spot", "intensity": 2.0, "cutoff_angle": 25, **place}
        if k == sum(counts):
            light["texture"] = picture
        parts[f"light{k}"] = light
    return mi.load_dict(parts, optimize=False)


def integrator(**options: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", "tessellation": 8, "shadow_map_resolution": 32, **options})


def in_loops_from(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    for module in (light_loops, light_pass):
        monkeypatch.setattr(module, "MANY_LIGHTS", count)


def test_programs_do_not_grow_with_the_number_of_lights(variant: str) -> None:
    """Neither those of images nor those of their derivatives."""

    def operations(counts: tuple[int, int, int]) -> int:
        made = scene(counts)
        params = mi.traverse(made)
        dr.enable_grad(params["box.vertex_positions"])
        params.update()
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.backward(dr.mean(mi.render(made, params=params, integrator=integrator(), spp=1), axis=None))
            dr.eval(dr.grad(params["box.vertex_positions"]))
            return max(entry.get("operation_count", 0) for entry in dr.kernel_history())

    few = operations((8, 0, 0))
    assert operations((16, 0, 0)) < 1.1 * few


def test_many_lights_look_like_single_ones(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """And so do derivatives by shapes, materials and the lights themselves, in both modes; and what is recorded."""
    names = (
        "box.vertex_positions", "ball.bsdf.reflectance.value", "light0.irradiance.value", "light2.position",
        "light2.intensity.value", "light4.intensity.value",
    )  # fmt: skip

    def found() -> list[np.ndarray]:
        made, renders, results = scene((2, 2, 2)), integrator(), []
        params = mi.traverse(made)
        dr.enable_grad([params[name] for name in names])
        turned = mi.Float(0)
        dr.enable_grad(turned)
        params["light4.to_world"] = params["light4.to_world"] @ mi.Transform4f().rotate([1, 0, 0], turned)
        params.update()
        image = mi.render(made, params=params, integrator=renders, spp=1)
        results.append(np.array(image))
        dr.backward(dr.sum(dr.square(image), axis=None))
        results += [np.array(dr.grad(array)) for array in (turned, *(params[name] for name in names))]
        for name in names:
            params[name] = dr.detach(params[name])
        moved = mi.Float(0)
        dr.enable_grad(moved)
        params["light2.position"] = params["light2.position"] + mi.Vector3f(moved, 0, 0)
        params["light4.to_world"] = dr.detach(params["light4.to_world"]) @ mi.Transform4f().rotate([1, 0, 0], moved)
        params["ball.to_world"] = mi.Transform4f().translate([0.5 + moved, 0.3, 0.7]).scale(0.5)
        params.update()
        image = mi.render(made, params=params, integrator=renders, spp=1)
        dr.set_grad(moved, 1.0)
        results.append(np.array(dr.forward_to(image)))
        return results

    in_loops_from(monkeypatch, 2)
    looped = found()
    recorded = mi.render(scene((2, 2, 2)), integrator=integrator(recorded=True), spp=1)
    assert np.allclose(recorded, looped[0], atol=1e-5)
    in_loops_from(monkeypatch, 1000)
    for one, other in zip(looped, found(), strict=True):
        scale = np.abs(other).max()
        assert scale > 1e-3 and np.allclose(one, other, rtol=1e-3, atol=1e-3 * scale)


def test_many_lights_have_small_maps_in_small_images(variant: str) -> None:
    """One texel for each pixel along a side, at least 128, unless texels or a filter were asked for; the image is the same."""

    def texels(made: Any, pixels: int, **options: Any) -> int:
        light = Renderer.from_scene(made, tessellation=8, **options).light_pass.for_image(pixels)
        return (light.shadow or light.settings.shadow).resolution

    made = scene((3, 0, 0))  # and a spot
    assert [texels(made, side**2) for side in (32, 128, 150, 255, 512)] == [128, 128, 160, 256, 256]
    assert texels(scene((2, 0, 0)), 32**2) == 256
    for options in ({"shadow_map_resolution": 256}, {"shadow_filter_size": 3}, {"shadow_supersampling": 2}):
        assert texels(made, 32**2, **options) == 256
    assert texels(made, 32**2, shadow_map_resolution=64) == 64
    for counts in ((3, 0, 0), (0, 4, 3)):
        fine, image = (
            np.array(Renderer.from_scene(scene(counts), tessellation=8, **options).render())
            for options in ({"shadow_map_resolution": 256}, {})
        )
        assert 0 < np.abs(image - fine).mean() < 0.01 * fine.mean()


def test_slices_follow_the_size_of_images(variant: str) -> None:
    """Small maps of many lights take less memory, so that fewer slices are needed; larger images need more."""
    renderer = Renderer.from_scene(scene((0, 8, 0)), tessellation=8, light_memory=0.2)
    small, large = (renderer.light_pass.for_image(side**2) for side in (32, 512))
    assert len(small.slices) < len(large.slices) == len(renderer.slices)
    whole = np.array(Renderer.from_scene(scene((0, 8, 0)), tessellation=8).render())
    np.testing.assert_allclose(np.array(renderer.render()), whole, atol=1e-5)
