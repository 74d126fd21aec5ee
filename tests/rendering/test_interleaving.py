"""Interleaved sampling of the points of an area light: images and derivatives as if each saw all points."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import ball, camera, floor, shadowmap, small_scene

from mitsuba_baselines import derivatives
from shadowmap_dr.rendering.extended_lights.interleaving import Interleaving
from shadowmap_dr.scene.sensor import ImageSize


@pytest.mark.parametrize(
    ("points", "factor", "groups"),
    [
        (32, 1, 1),
        (32, 2, 1),
        (32, 4, 1),
        (32, 7, 1),
        (32, 8, 4),
        (32, 12, 4),
        (64, 16, 16),
        (64, 12, 4),
        (36, 12, 9),
        (30, 8, 1),
        (4, 8, 1),
    ],
)
def test_each_point_is_seen_equally_often(variant: str, points: int, factor: int, groups: int) -> None:
    """In each pixel, by samples that lie on a grid of their own: as many of them in all rows and columns."""
    size = ImageSize(3 * factor, 2 * factor)
    interleaving = Interleaving.of(points, size, factor)
    assert interleaving.groups == groups
    group = np.zeros(size.width * size.height, np.uint32) if interleaving.group is None else interleaving.group.numpy()
    seen = np.zeros((points, size.height, size.width), np.int64)
    rows, columns = np.divmod(np.arange(len(group)), size.width)
    for number in range(interleaving.seen):
        index = np.broadcast_to(interleaving.point(mi.UInt32(number), interleaving.group).numpy(), group.shape)
        np.add.at(seen, (index, rows, columns), 1)
    assert seen.max() == 1
    pixels = seen.reshape(points, 2, factor, 3, factor)
    assert np.all(pixels.sum((2, 4)) == factor**2 // groups)
    side = round(groups**0.5)
    assert np.all(pixels.reshape(points, 2, factor // side, side, 3, factor // side, side).sum((3, 6)) == 1)


def lamp(emitter: dict[str, Any]) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at([1, -1, 2.5], [0, 0, 0], [0, 1, 0]).scale(0.5)
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", **emitter}}


def painted() -> dict[str, Any]:
    pixels = np.random.default_rng(4).uniform(0.5, 12, (4, 4, 3)).astype(np.float32)
    return {"radiance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}


def image_and_derivatives(parts: dict[str, Any], points: int, move: str) -> tuple[np.ndarray, np.ndarray, float]:
    """(image, derivative image by a number, derivative of a weighted sum by the same number in reverse mode)."""
    scene = small_scene(camera=camera(32), **parts)
    params, integrator = mi.traverse(scene), shadowmap(area_light_samples=points, shadow_map_resolution=64)
    rest = type(params[move])(params[move])
    found = []
    for reverse in (False, True):
        t = dr.opaque(mi.Float, 0)
        dr.enable_grad(t)
        dr.set_grad(t, 0 if reverse else 1)
        if move.endswith("to_world"):
            params[move] = mi.Transform4f().translate(mi.Vector3f(t, 0.3 * t, 0)) @ rest
        else:
            params[move] = dr.ravel(dr.unravel(mi.Point3f, rest) + mi.Vector3f(t, 0.4 * t, 0.2 * t))
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=64)
        if reverse:
            weight = np.random.default_rng(2).uniform(-1, 1, image.shape).astype(np.float32)
            dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
            found.append(float(dr.grad(t)[0]))
        else:
            dr.forward_to(image)
            found += [np.array(image), np.array(dr.grad(image))]
        params[move] = type(rest)(rest)
        params.update()
    return found[0], found[1], found[2] / float((weight * found[1]).sum())


@pytest.mark.parametrize("points", [32, 64])
@pytest.mark.parametrize("move", ["lamp.to_world", "ball.vertex_positions"])
@pytest.mark.parametrize("emitter", ["even", "painted"])
def test_images_are_those_of_all_points(
    variant: str, monkeypatch: pytest.MonkeyPatch, points: int, move: str, emitter: str
) -> None:
    radiance = painted() if emitter == "painted" else {"radiance": {"type": "rgb", "value": [6.0, 5.0, 4.0]}}
    parts = {"sun": None, "floor": floor(), "ball": ball(), "lamp": lamp(radiance)}
    image, derivative, ratio = image_and_derivatives(parts, points, move)
    monkeypatch.setattr(Interleaving, "of", classmethod(lambda cls, points, *_: cls(points)))
    expected, other, _ = image_and_derivatives(parts, points, move)
    assert np.any(image != expected)
    assert np.sqrt(((image - expected) ** 2).mean()) < 3e-3 * expected.mean()
    assert image.mean() == pytest.approx(expected.mean(), rel=5e-4)
    agreement = derivatives.agreement(derivative, other)
    assert agreement.cosine > 0.998 and abs(agreement.scale - 1) < 0.01, agreement
    assert ratio == pytest.approx(1, abs=2e-3)
