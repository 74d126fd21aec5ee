"""Derivative images against path-traced central differences, and reverse mode against forward mode.

The comparison is that of two blurred images, by cosine and by scale (`mitsuba_baselines.derivatives.agreement`). The blur is a
box of 5 pixels, or of twice the shadow filter's footprint where that is more: at 256 texels the filter is wider than two pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from references import cases

from mitsuba_baselines import derivatives, reference
from shadowmap_dr.renderer import Renderer

CASES = {case.name: case for case in cases.CASES}
# Texels along a map's side, samples per pixel: the defaults, finer maps, and the box filter of the references.
SETTINGS = ((256, 1), (1024, 1), (1024, 16))


def build(case: cases.Case, resolution: int = cases.RESOLUTION) -> mi.Scene:
    scene = case.build(0.0)
    if resolution != cases.RESOLUTION:
        params = mi.traverse(scene)
        params["camera.film.size"] = (resolution, resolution)
        params.update()
    return scene


def render(renderer: Renderer, case: str, parameter: object, spp: int = 1) -> object:
    """Image for a parameter of the case (Float), which is zero where the derivative is taken."""
    kind = case.rsplit("_", 1)[0]
    if kind == "light_direction":  # turned about x
        light = renderer.light("light")
        d, s, c = light.direction, dr.sin(parameter), dr.cos(parameter)
        light = replace(light, direction=mi.Vector3f(d.x, c * d.y - s * d.z, s * d.y + c * d.z))
        return renderer.render(lights={"light": light}, spp=spp)
    shift = mi.Point3f(parameter, 0, 0)
    if kind == "spot_position":
        light = renderer.light("light")
        light = replace(light, to_world=mi.Transform4f().translate(shift) @ light.to_world)
        return renderer.render(lights={"light": light}, spp=spp)
    assert kind == "caster_translation"
    return renderer.render(vertex_positions={"object": vertices(renderer) + shift}, spp=spp)


def vertices(renderer: Renderer) -> object:
    """Vertices of the caster, Point3f."""
    geometry = renderer.data.geometry
    (info,) = (shape for shape in geometry.shapes if shape.name == "object")
    return dr.gather(mi.Point3f, geometry.positions, dr.arange(mi.UInt32, info.vertex_count) + info.vertex_start)


def derivative(draw: Callable[[object], object]) -> tuple[np.ndarray, np.ndarray]:
    """Image and derivative image of `draw` at zero, by forward mode."""
    parameter = mi.Float(0)
    dr.enable_grad(parameter)
    image = draw(parameter)
    dr.forward(parameter)
    return np.array(dr.detach(image)), np.array(dr.grad(image))


def filter_footprint(renderer: Renderer, case: str) -> float:
    """Width of the shadow filter in pixels, on a surface at the caster that faces light and camera alike."""
    frusta, shadow = renderer.frusta, renderer.settings.shadow
    distance = np.linalg.norm(cases.SPOT_ORIGIN - cases.SPOT_TARGET) if case.startswith("spot") else 1.0
    texel = 2 * max(frusta.half_x[0], frusta.half_y[0]) * distance / shadow.resolution
    sensor = renderer.data.sensors[0][0]
    to_camera = dr.norm(dr.mean(vertices(renderer), axis=1) - sensor.origin)
    pixel = 2 / sensor.projection[0, 0] * to_camera / sensor.width
    return float(shadow.filter_size * texel / dr.abs(pixel)[0])


@pytest.mark.parametrize(("texels", "spp"), SETTINGS)
@pytest.mark.parametrize("case", CASES)
def test_forward_mode_agrees_with_path_traced_differences(variant: str, case: str, texels: int, spp: int) -> None:
    renderer = Renderer.from_scene(build(CASES[case]), shadow_map_resolution=texels)
    _, automatic = derivative(lambda parameter: render(renderer, case, parameter, spp))
    stored = reference.load(CASES[case].path)
    result = derivatives.agreement(automatic, stored.image, filter_footprint(renderer, case))
    assert result.cosine >= 0.95 and 0.9 <= result.scale <= 1.1, f"c = {result.cosine:.4f}, s = {result.scale:.4f}"


def assert_same_products(weights: list[np.ndarray], forward: np.ndarray, reverse: list[float]) -> None:
    """<weight, derivative> by both modes, relative to what could have cancelled in it."""
    for weight, product in zip(weights, reverse, strict=True):
        terms = weight.astype(np.float64) * forward
        assert abs(product - terms.sum()) <= 1e-4 * np.abs(terms).sum()


def image_weights(forward: np.ndarray) -> list[np.ndarray]:
    """The derivative itself, whose products cannot cancel, and random weights."""
    return [forward, np.random.default_rng(1).normal(size=forward.shape).astype(np.float32)]


@pytest.mark.parametrize("spp", [1, 4])
@pytest.mark.parametrize("case", CASES)
def test_reverse_mode_agrees_with_forward_mode(variant: str, case: str, spp: int) -> None:
    renderer = Renderer.from_scene(build(CASES[case], 64))
    _, forward = derivative(lambda parameter: render(renderer, case, parameter, spp))
    weights, reverse = image_weights(forward), []
    for weight in weights:
        parameter = mi.Float(0)
        dr.enable_grad(parameter)
        dr.backward(dr.sum(render(renderer, case, parameter, spp) * mi.TensorXf(weight), axis=None))
        reverse.append(float(dr.grad(parameter)[0]))
    assert_same_products(weights, forward, reverse)


@pytest.mark.parametrize("case", ["caster_translation_box", "caster_translation_cow"])
def test_reverse_mode_agrees_with_forward_mode_in_all_vertices(variant: str, case: str) -> None:
    renderer = Renderer.from_scene(build(CASES[case], 64))
    rest = vertices(renderer)
    direction = mi.Point3f(np.random.default_rng(0).normal(size=(3, dr.width(rest))).astype(np.float32))
    _, forward = derivative(lambda t: renderer.render(vertex_positions={"object": rest + t * direction}))
    weights, reverse = image_weights(forward), []
    for weight in weights:
        moved = mi.Point3f(rest)
        dr.enable_grad(moved)
        dr.backward(dr.sum(renderer.render(vertex_positions={"object": moved}) * mi.TensorXf(weight), axis=None))
        gradient = np.array(dr.grad(moved), np.float64)
        assert np.isfinite(gradient).all()
        reverse.append(float((gradient * np.array(direction)).sum()))
    assert_same_products(weights, forward, reverse)
