"""Gradients to numbers that the caller has looked up in a table of his own, in Dr.Jit's default mode: none may get lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.jit.broadcast import broadcast_differentiable

# What gets lost without care depends on the thread that comes to do the work.
REPETITIONS = 10
POSITIONS = {"spot": [0.4, 0.8, 3.5], "other": [-0.7, 0.5, 3.0], "point": [0.4, 0.3, 2.5]}


def scene(lights: tuple[str, ...]) -> mi.Scene:
    """A box before a wall."""
    t = mi.ScalarTransform4f()
    emitters: dict[str, Any] = {}
    for name in lights:
        pose = {"to_world": t.look_at(POSITIONS[name], [0, 0, 0], [0, 1, 0]), "cutoff_angle": 40.0}
        kind = {"type": "point", "position": POSITIONS[name]} if name == "point" else {"type": "spot", **pose}
        emitters[name] = {"intensity": 20.0, **kind}
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective", "to_world": t.look_at([-3, 2, 4], [0, 0, -1], [0, 1, 0]), "film": film},
            "wall": {"type": "rectangle", "to_world": t.translate([0, 0, -1.5]).scale(4)},
            "box": {"type": "cube", "to_world": t.rotate([0.6, 0.8, 0], 40).scale(0.5)},
            **emitters,
        },
        optimize=False,
    )


@pytest.mark.parametrize("lights", [("spot",), ("spot", "other"), ("point",), ("spot", "other", "point")])
def test_positions_of_lights(variant: str, lights: tuple[str, ...]) -> None:
    renderer = Renderer.from_scene(scene(lights), shadow_map_resolution=64)
    weights = mi.Float(np.random.default_rng(1).normal(size=32 * 32 * 3).astype(np.float32))

    def gradient(taken: Callable[[Any], list[Any]]) -> np.ndarray:
        table = mi.Float(np.ravel([POSITIONS[name] for name in lights]).astype(np.float32))
        dr.enable_grad(table)
        moved = {}
        for name, position in zip(lights, taken(table), strict=True):
            light = renderer.light(name)
            if name == "point":
                moved[name] = replace(light, position=position)
            else:
                matrix = mi.Matrix4f(light.to_world.matrix)
                for c in range(3):
                    matrix[c, 3] = position[c]
                moved[name] = replace(light, to_world=mi.Transform4f(matrix))
        dr.backward(dr.sum(weights * renderer.render(lights=moved).array))
        return dr.grad(table).numpy()

    def default(table: Any) -> list[Any]:
        return [dr.gather(mi.Point3f, table, mi.UInt32(k)) for k in range(len(lights))]

    def one_by_one(table: Any) -> list[Any]:
        return [mi.Point3f(*(dr.sum(table * mi.Float(row)) for row in rows)) for rows in picks]

    picks = np.eye(3 * len(lights), dtype=np.float32).reshape(len(lights), 3, -1)
    want = gradient(one_by_one)
    assert np.abs(want).min() > 0.1
    for _ in range(REPETITIONS):
        np.testing.assert_allclose(gradient(default), want, rtol=1e-2, atol=1e-3 * np.abs(want).max())


def test_numbers_that_are_spread_one_by_one(variant: str) -> None:
    for _ in range(REPETITIONS):
        table = mi.Float([1, 2, 3])
        dr.enable_grad(table)
        numbers = [dr.gather(mi.Float, table, mi.UInt32(k)) for k in range(3)]
        wide = dr.ravel(mi.Point3f(*(broadcast_differentiable(number, 8) for number in numbers)))
        dr.eval(wide)
        beside = dr.concat([dr.zeros(mi.Float, 1), dr.ravel(mi.Point3f(*numbers))])
        dr.backward(dr.sum(dr.square(wide)) + dr.sum(beside * mi.Float([0, 1, 2, 3])))
        np.testing.assert_allclose(dr.grad(table).numpy(), [17, 34, 51], rtol=1e-5)
