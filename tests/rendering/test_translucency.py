"""Translucent surfaces in layers, and their shadows, against Mitsuba's path tracer and central differences."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from translucent_scenes import (
    along,
    camera,
    glass,
    leaf,
    lights,
    pane,
    panes,
    relative_error,
    scene_of,
    stacks,
    standing,
    sun,
    traced,
    veil,
)

from mitsuba_baselines.derivatives import agreement
from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.rendering.gbuffer import translucency, translucent_layers
from shadowmap_dr.rendering.gbuffer.transmission import whole_triangles
from shadowmap_dr.shadow import transmittance_maps

# Relative errors of scenes of more than one layer, 16 samples per pixel.
WITHIN = {"two": 0.01, "five": 0.015, "thirty": 0.02, "null": 0.015, "around": 0.01, "blend": 0.01, "leaves": 0.015}


def rendered(scene: mi.Scene, spp: int = 16, **settings: Any) -> np.ndarray:
    return np.array(Renderer.from_scene(scene, **settings).render(spp=spp))


def edges(scene: mi.Scene) -> np.ndarray:
    """Pixels next to outlines of visible shapes, opaque or not."""
    found = np.zeros(np.array(scene.sensors()[0].film().size())[::-1], bool)
    for layers in (1, 2, 3):
        renderer = Renderer.from_scene(scene, aovs="shape_index", shadow_method="none", translucent_layers=layers)
        with dr.suspend_grad():
            cameras = renderer.camera_pass
            view = cameras.view(renderer.data.sensors[0][0], cameras.placed(renderer.data.geometry), 1)
            levels = [view.raster.triangle]
            if view.layers is not None:
                seen = view.layers
                levels += [whole_triangles(raster, seen.faces) for raster in seen.translucent]
                levels += [raster.triangle for raster in seen.opaque]
        for level in levels:
            triangle = level.numpy().reshape(found.shape).astype(np.int64)
            faces = renderer.data.geometry.face_shape.numpy()
            shape = np.where(triangle < len(faces), faces[np.minimum(triangle, len(faces) - 1)], -1)
            for axis in (0, 1):
                moved = np.roll(shape, 1, axis) != shape
                found |= moved | np.roll(moved, -1, axis)
    return found


@pytest.mark.parametrize("name", ["thin_veil", "dense_veil", "clear_glass", "red_glass"])
def test_single_panes(variant: str, name: str) -> None:
    scene = scene_of(ball=None, **panes()[name])
    reference = traced(scene, 512)
    beside = ~edges(scene)
    for spp in (1, 16):
        assert relative_error(rendered(scene, spp), reference, beside) < 0.01
    assert relative_error(rendered(scene), reference) < 0.015


@pytest.mark.parametrize("name", list(WITHIN))
def test_layers(variant: str, name: str) -> None:
    scene = scene_of(**stacks()[name])
    assert relative_error(rendered(scene), traced(scene, 256)) < WITHIN[name]


def test_lines_along_which_panes_cut_opaque_surfaces_are_blended(variant: str) -> None:
    scene = scene_of(64, along(), ball=None, pane=standing(veil(0.6)))
    error = np.abs(rendered(scene, 1) - traced(scene, 1024)).max(-1)
    assert np.quantile(error, 0.995) < 0.025  # 0.04 where these lines have steps


@pytest.mark.parametrize("light", ["spot", "point", "area", "sky"])
def test_lights_of_all_kinds(variant: str, light: str) -> None:
    """As exact as the light is without panes."""
    # Glass shows no mirror image of the sky.
    parts = stacks()["five" if light == "sky" else "two"]
    scene = scene_of(48, lights()[light], **parts)
    within = {"spot": 0.01, "point": 0.01, "area": 0.02, "sky": 0.03}[light]
    assert relative_error(rendered(scene), traced(scene, 256 if light in ("spot", "point") else 1024)) < within


def test_lights_of_a_kind_that_are_many(variant: str) -> None:
    """Lights that are summed up in a loop give the same colours through panes as single ones."""
    places = [[-1.5 + 0.4 * k, -0.4, 2.5] for k in range(8)]
    bulbs = [{"type": "point", "position": place, "intensity": 3.0} for place in places]
    dark = sun() | {"irradiance": 0.0}
    together = scene_of(32, dark, **stacks()["two"], **{f"bulb{k}": bulb for k, bulb in enumerate(bulbs)})
    total = sum(rendered(scene_of(32, bulb, **stacks()["two"]), 4) for bulb in bulbs)
    assert relative_error(rendered(together, 4), total) < 0.005


def test_slices_and_tiles_and_supersampling(variant: str) -> None:
    scene = scene_of(48, **stacks()["two"], second=sun(-0.4))
    whole, reference = rendered(scene, 4), traced(scene, 256)
    assert relative_error(whole, reference) < 0.02
    assert relative_error(rendered(scene, 4, light_memory=0.02), whole) < 1e-3
    for settings in ({"shadow_tiles": 1}, {"shadow_supersampling": 2}, {"shadow_map_resolution": 512}):
        assert relative_error(rendered(scene, 4, **settings), reference) < 0.02


def test_depth_encodings(variant: str) -> None:
    """All of them tell a ball between two panes from the floor behind both, the default best of those with four numbers."""
    scene = scene_of(48, **stacks()["five"])
    reference = traced(scene, 256)
    errors = {
        method: relative_error(rendered(scene, 4, transmittance_method=method), reference)
        for method in ("msm", "vsm", "evsm2", "evsm4", "esm", "csm")
    }
    assert max(errors.values()) < 0.06
    assert errors["msm"] < min(errors["vsm"], errors["evsm4"])
    apart = relative_error(rendered(scene, 4, transmittance_groups=5), reference)
    assert apart < errors["msm"] + 1e-3
    assert apart < relative_error(rendered(scene, 4, transmittance_groups=1), reference)


def test_fully_opaque_and_fully_clear_panes(variant: str) -> None:
    plain = {"type": "twosided", "nested": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}}
    opaque, solid = rendered(scene_of(pane=pane(veil(1.0)))), rendered(scene_of(pane=pane(plain)))
    assert relative_error(opaque, solid) < 0.01
    assert relative_error(rendered(scene_of(pane=pane(veil(0.0)))), rendered(scene_of())) < 2e-3


def test_no_more_layers_than_asked_for(variant: str) -> None:
    """The nearest layers stay. By default there are as many as the scene has."""
    scene = scene_of(48, **stacks()["five"])
    renderer = Renderer.from_scene(scene)
    assert renderer.translucency is not None and renderer.translucency.camera.layers == 5
    reference = traced(scene, 256)
    errors = [relative_error(rendered(scene, 4, translucent_layers=count), reference) for count in (1, 3, 5, 8)]
    assert errors[0] > errors[1] > 1.5 * errors[2]
    assert max(errors[2:]) < 0.025
    for wrong in (0, 65, True, "many", 1.5):
        with pytest.raises(ShadowmapError, match="translucent_layers"):
            Renderer.from_scene(scene, translucent_layers=wrong)
    for wrong in (-1, 9):
        with pytest.raises(ShadowmapError, match="transmittance groups"):
            Renderer.from_scene(scene, transmittance_groups=wrong)
    with pytest.raises(ShadowmapError, match="transmittance method 'pcf' is unknown"):
        Renderer.from_scene(scene, transmittance_method="pcf")


def test_layers_are_those_of_all_cameras(variant: str) -> None:
    """The first one looks past the panes."""
    scenes = scene_of(24, **stacks()["five"]), scene_of(24, camera=camera(24, 5.0), other=camera(24), **stacks()["five"])
    one, two = (Renderer.from_scene(scene).translucency for scene in scenes)
    assert one is not None and two is not None
    assert two.camera == one.camera


def test_opaque_scenes_have_no_layers(variant: str) -> None:
    renderer = Renderer.from_scene(scene_of())
    assert renderer.translucency is None


def test_alpha_and_further_channels(variant: str) -> None:
    """Alpha over an empty background, opacity, and the light that reaches the nearest surfaces."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "pane": pane(veil(0.3)),
            "above": pane(veil(0.9), 1.4, 0.1, half=0.9),
            "light": sun(),
            "camera": {
                "type": "perspective",
                "fov": 30,
                "to_world": mi.ScalarTransform4f().look_at([0, -3.5, -3], [0, 0, 0.9], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}, "pixel_format": "rgba"},
            },
        }
    )
    image = rendered(scene, 1, aovs="opacity,transmittance,shape_index")
    reference = traced(scene, 1024)
    assert np.abs(image[..., 3] - reference[..., 3]).mean() < 0.02
    np.testing.assert_allclose(image[..., 3], image[..., 4], atol=1e-5)
    nearest = image[16, 16]
    assert nearest[8] == 1  # the pane, before the denser one above it
    np.testing.assert_allclose(nearest[[4, 5, 6, 7]], [1 - 0.7 * 0.1, 0.1, 0.1, 0.1], atol=0.01)


# Change of a scene by a number: (scene for the number, step of differences, the parameter's path and its value).
Change = tuple[Callable[[float], Any], float, str, Callable[[Any, Any], Any]]


def moved(direction: list[float]) -> Callable[[Any, Any], Any]:
    return lambda old, x: mi.Transform4f().translate(mi.Vector3f(*(x * d for d in direction))) @ mi.Transform4f(old)


def turned(old: Any, x: Any) -> Any:
    forward = dr.normalize(mi.Vector3f(0.3 + x, 0.1, -1))
    return mi.Transform4f().look_at(mi.Point3f(0), mi.Point3f(forward), dr.normalize(dr.cross(forward, mi.Vector3f(0, 1, 0))))


def changes(size: int) -> dict[str, Change]:
    red, green = (0.9, 0.2, 0.1), (0.2, 0.6, 0.1)
    above = lambda: {"above": pane(glass(*red), 1.1, -0.2)}  # noqa: E731
    return {
        "opacity": (
            lambda x: scene_of(size, pane=pane(veil(0.5 + x)), **above()), 0.05, "pane.bsdf.opacity.value", lambda _, x: 0.5 + x,
        ),
        "tint": (
            lambda x: scene_of(size, pane=pane(glass(0.9, 0.3 + x, 0.1))), 0.05, "pane.bsdf.specular_transmittance.value",
            lambda _, x: mi.Color3f(0.9, 0.3 + x, 0.1),
        ),
        "colour": (
            lambda x: scene_of(size, pane=pane(veil(0.5, (0.2, 0.4 + x, 0.6)))), 0.05,
            "pane.bsdf.nested_bsdf.brdf_0.reflectance.value", lambda _, x: mi.Color3f(0.2, 0.4 + x, 0.6),
        ),
        "pane": (lambda x: scene_of(size, pane=pane(veil(0.6), x=0.1 + x)), 0.02, "pane.to_world", moved([1, 0, 0])),
        "leaf": (
            lambda x: scene_of(size, pane=pane(veil(leaf(), green), x=0.1 + x)), 0.02, "pane.to_world", moved([1, 0, 0]),
        ),
        "sun": (
            lambda x: scene_of(size, sun(0.3 + x), pane=pane(veil(0.6)), **above()), 0.02, "light.to_world", turned,
        ),
        "cut": (lambda x: scene_of(size, along(), pane=standing(veil(0.6), x)), 0.02, "pane.to_world", moved([0, 1, 0])),
        "cut_behind": (
            lambda x: scene_of(size, along(), pane=standing(veil(0.6), x), front=pane(veil(0.4), 0.7, 0.1, -10, 0.5)), 0.02,
            "pane.to_world", moved([0, 1, 0]),
        ),
    }  # fmt: skip


def derivative(change: Change, spp: int, **settings: Any) -> tuple[np.ndarray, float, float]:
    """(derivative image; the same, and the derivative in backward mode, both weighted with random numbers and summed up)."""
    build, _, path, value = change
    found: list[Any] = []
    for backward in (False, True):
        scene = build(0)
        renderer = Renderer.from_scene(scene, **settings)
        x = mi.Float(0)
        dr.enable_grad(x)
        params = mi.traverse(scene)
        params[path] = value(params[path], x)
        params.update()
        image = renderer.refresh().render(spp=spp)
        weights = np.random.default_rng(1).normal(size=image.shape).astype(np.float32)
        if backward:
            dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
            found.append(float(x.grad[0]))
        else:
            dr.forward(x)
            found += [np.array(dr.grad(image)), float((np.array(dr.grad(image), np.float64) * weights).sum())]
        # Dr.Jit fails in forward mode while another scene has attached materials.
        del scene, renderer, params, image, x
        gc.collect()
    return found[0], found[1], found[2]


@pytest.mark.parametrize("name", ["opacity", "tint", "colour", "pane", "leaf", "sun", "cut", "cut_behind"])
def test_derivatives(variant: str, name: str) -> None:
    """Against path-traced differences, and in both modes."""
    change = changes(64)[name]
    build, step = change[:2]
    image, forward, backward = derivative(change, 16 if name == "pane" else 4)
    reference = (traced(build(step), 256) - traced(build(-step), 256)) / (2 * step)
    found = agreement(image, reference)
    assert found.cosine >= 0.97
    # Below 0.97 where outlines of a layer leave out the surfaces behind it, which are another layer beside it.
    assert (0.98 if name == "sun" else 0.95) <= found.scale <= 1.05
    assert backward == pytest.approx(forward, rel=1e-3, abs=1e-3)


def test_derivative_where_nothing_is_lost_yet(variant: str) -> None:
    """By an opacity of nearly 0, from which fits may start. At 0 itself, the end of its range, Mitsuba's materials have none."""
    value = lambda _, x: 1e-6 + x  # noqa: E731
    change: Change = (lambda x: scene_of(48, pane=pane(veil(1e-6 + x))), 0.02, "pane.bsdf.opacity.value", value)
    image, forward, backward = derivative(change, 4)
    build = change[0]
    reference = (traced(build(0.04), 256) - traced(build(0), 256)) / 0.04
    found = agreement(image, reference)
    assert found.cosine >= 0.97
    assert 0.95 <= found.scale <= 1.05
    assert backward == pytest.approx(forward, rel=1e-3)


def test_texels_of_an_opacity_have_derivatives(variant: str) -> None:
    """Those of a leaf's outline, in reverse mode, against a difference in a random direction."""
    direction = np.random.default_rng(0).normal(size=(64, 64, 1)).astype(np.float32)

    def loss(step: float) -> tuple[float, np.ndarray]:
        scene = scene_of(48, pane=pane(veil(leaf())))
        renderer = Renderer.from_scene(scene)
        params = mi.traverse(scene)
        key = "pane.bsdf.opacity.data"
        base = np.array(params[key])
        params[key] = mi.TensorXf(np.clip(base, 0.02, 0.98) + step * direction)
        dr.enable_grad(params[key])
        params.update()
        image = renderer.refresh().render(spp=4)
        value = dr.sum(image * image, axis=None)
        dr.backward(value)
        return float(value.array[0]), np.array(dr.grad(params[key]))

    high, low, gradient = loss(1e-2)[0], loss(-1e-2)[0], loss(0)[1]
    assert float((gradient * direction).sum()) == pytest.approx((high - low) / 2e-2, rel=0.02)


def test_frozen_steps(variant: str) -> None:
    """Recorded steps give what unrecorded ones give, with other numbers, too."""
    scene = scene_of(32, **stacks()["two"])
    renderer = Renderer.from_scene(scene)
    rest = dr.ravel(renderer.vertices("veil"))

    def step(renderer: Renderer, shift: Any) -> tuple[Any, Any]:
        dr.enable_grad(shift)
        points = dr.unravel(mi.Point3f, rest) + mi.Point3f(shift, 0, 0)
        image = renderer.render({"veil": points})
        dr.backward(dr.sum(image * image, axis=None))
        return dr.detach(image), dr.grad(shift)

    frozen = dr.freeze(step)
    for value in (0.0, 0.03, -0.05):
        plain, recorded = (run(renderer, mi.Float(value)) for run in (step, frozen))
        np.testing.assert_allclose(np.array(recorded[0]), np.array(plain[0]), atol=2e-4)
        assert float(recorded[1][0]) == pytest.approx(float(plain[1][0]), rel=2e-3)


def placed(scene: mi.Scene, name: str, **settings: Any) -> tuple[np.ndarray, float]:
    """(image, derivative of the sum of its squares by the place of a shape)."""
    renderer = Renderer.from_scene(scene, **settings)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    points = renderer.vertices(name) + mi.Point3f(shift, 0, 0)
    image = renderer.render({name: points}, spp=4)
    dr.backward(dr.sum(image * image, axis=None))
    return np.array(image), float(dr.grad(shift)[0])


def test_layers_that_do_not_fit_into_memory_are_refused(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    renderer = Renderer.from_scene(scene_of(16, **stacks()["five"]), translucent_layers=4)
    needed = 16 * 16 * 4 * (320 + 32)
    monkeypatch.setattr(translucent_layers, "physical_memory", lambda: needed)
    renderer.render()
    with pytest.raises(ShadowmapError, match=r"4 translucent layers of 1,024 samples take .* GiB, but .*: lower spp or"):
        renderer.render(spp=4)
    moved = dr.unravel(mi.Point3f, dr.ravel(renderer.vertices("ball")))
    dr.enable_grad(moved)
    with pytest.raises(ShadowmapError, match="4 translucent layers of 256 samples .*derivatives included"):
        renderer.render({"ball": moved})


@pytest.mark.parametrize("antialias", [True, False])
def test_layers_one_by_one_are_the_same(variant: str, monkeypatch: pytest.MonkeyPatch, antialias: bool) -> None:
    """As if memory were short: layers are not shaded or encoded together. Texels differ where outlines of two layers meet."""
    scene = scene_of(32, **stacks()["five"])
    image, gradient = placed(scene, "ball", antialias=antialias)
    for module in (translucent_layers, transmittance_maps):
        monkeypatch.setattr(module, "_MOST_NUMBERS", 1)
    alone, other = placed(scene, "ball", antialias=antialias)
    np.testing.assert_allclose(alone, image, atol=1e-3)
    assert np.abs(alone - image).mean() < 5e-6
    assert other == pytest.approx(gradient, rel=1e-3)


def test_fixed_casters_make_no_attached_maps(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Derivatives by the place of an opaque shape between panes are what they are when panes are attached, too."""
    scene = scene_of(32, **stacks()["five"])
    image, gradient = placed(scene, "ball")
    monkeypatch.setattr(translucency.Translucency, "attached", lambda *_: True)
    other, attached = placed(scene, "ball")
    np.testing.assert_allclose(other, image, atol=1e-6)
    assert attached == pytest.approx(gradient, rel=1e-3)
