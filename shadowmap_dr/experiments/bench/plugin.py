"""Benchmark: steps of the plug-in as Mitsuba's users write them, by kind of parameter.

A step gives a parameter of `scenes/pose.xml` a new value, updates the scene, renders, and takes the gradient of a loss.
Contenders in turns: the plug-in with its defaults; without recordings; the same derivative with a `Renderer` in a frozen
function; and Mitsuba's `params.update()` alone. The last two together bound what the plug-in can reach. A `Renderer` does not
take materials as arguments: beside these stands its step by the object's vertices.
"""

from __future__ import annotations

import functools
import gc
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...io import assets
from ...jit.frozen import freeze
from ...jit.types import Float, TensorXf, Vector3f
from ...rendering.renderer import Renderer
from ...scene.lights.punctual import DirectionalLight
from ..common.timing import Contender, alternate, compare
from .common import BenchOptions, Unit, Update

#: Kind of parameter -> its name in `mi.traverse`.
KINDS = {
    "vertices": "object.vertex_positions",
    "to_world": "wall.to_world",
    "light": "light.to_world",
    "camera": "camera.to_world",
    "colour of the light": "light.irradiance.value",
    "reflectance": "object.bsdf.reflectance.value",
    "texture": "wall.bsdf.reflectance.data",
}
# Renderer's arguments for a kind, given the renderer, the object's vertices and the changing number.
_ARGUMENTS: dict[str, Callable[[Renderer, Float, Float], dict[str, Any]]] = {
    "vertices": lambda renderer, vertices, x: {"vertex_positions": {"object": vertices + x}},
    "to_world": lambda renderer, vertices, x: {"transforms": {"wall": mi.Transform4f().translate(_shift(x))}},
    "light": lambda renderer, vertices, x: {"lights": {"light": _light(mi.Vector3f(x, 0, -1), mi.Float(0))}},
    "camera": lambda renderer, vertices, x: {"sensor": _moved(renderer, x)},
    "colour of the light": lambda renderer, vertices, x: {"lights": {"light": _light(mi.Vector3f(0, 0, -1), x)}},
}


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each kind of parameter and each size."""
    kinds, sizes = options.what.plugin_kinds, options.what.plugin_resolutions
    return [
        Unit(f"{kind}@{size}", functools.partial(_measure, kind, size, options.what.rounds)) for size in sizes for kind in kinds
    ]


def _measure(kind: str, size: int, rounds: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    gc.collect()  # scenes of earlier units: while they live, Mitsuba compiles calls of their objects
    contenders: dict[str, Callable[[], object]] = {
        "plug-in": _Loop(kind, size),
        "not recorded": _Loop(kind, size, recorded=False),
        "renderer": _Frozen(kind if kind in _ARGUMENTS else "vertices", size),
        "update": _Loop(kind, size).update,
    }
    # A loop is recorded from its fifth step on.
    timed = {name: Contender(call, rounds, warm_up=10) for name, call in contenders.items()}
    times = compare(alternate(timed, on_call=update), [("not recorded", "plug-in")])
    seconds = {name: entry["median"] for name, entry in times["seconds"].items()}
    over = seconds["plug-in"] / (seconds["renderer"] + seconds["update"])
    return {"kind": kind, "resolution": size, "over_renderer_and_update": over, **times}


class _Loop:
    """The loop of a Mitsuba user."""

    def __init__(self, kind: str, size: int, **parameters: bool) -> None:
        self._scene = _scene(size)
        self._params, self._key = mi.traverse(self._scene), KINDS[kind]
        value = self._params[self._key]
        self._start, self._x = type(value)(value), 0.0
        self._integrator = mi.load_dict({"type": "shadowmap", **parameters})

    def update(self) -> Float:
        """Give the parameter a new value; returns the attached number that it depends on."""
        self._x += 1e-4
        x = dr.opaque(mi.Float, self._x)
        dr.enable_grad(x)
        if not isinstance(self._start, mi.Transform4f):
            self._params[self._key] = type(self._start)(self._start + x)
        elif self._key.startswith("light"):
            self._params[self._key] = mi.Transform4f().rotate(mi.Vector3f(0, 1, 0), x) @ self._start
        else:
            self._params[self._key] = mi.Transform4f().translate(_shift(x)) @ self._start
        self._params.update()
        return x

    def __call__(self) -> Float:
        x = self.update()
        return _gradient(mi.render(self._scene, self._params, integrator=self._integrator, spp=1), x)


class _Frozen:
    """The same derivative with a `Renderer`, in a frozen function."""

    def __init__(self, kind: str, size: int) -> None:
        scene = _scene(size)
        self._vertices = mi.Float(dr.detach(mi.traverse(scene)[KINDS["vertices"]]))
        self._renderer, self._x = Renderer.from_scene(scene), 0.0

        def step(x: Float, vertices: Float, renderer: Renderer) -> Float:
            x = mi.Float(x)
            dr.enable_grad(x)
            return _gradient(renderer.render(**_ARGUMENTS[kind](renderer, vertices, x)), x)

        self._step = freeze(step)

    def __call__(self) -> Float:
        self._x += 1e-4
        found: Float = self._step(dr.opaque(mi.Float, self._x), self._vertices, self._renderer)
        return found


def _gradient(image: TensorXf, x: Float) -> Float:
    dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
    found = dr.grad(x)
    dr.eval(found)
    return found


def _shift(x: Float) -> mi.Vector3f:
    return mi.Vector3f(x, 0, 0)


def _light(direction: Vector3f, more: Float) -> DirectionalLight:
    return DirectionalLight("light", direction, mi.Color3f(math.pi + more))


def _moved(renderer: Renderer, x: Float) -> Any:  # Any: a `Sensor`
    (camera,) = renderer.data.cameras(0)
    return replace(camera, to_world=mi.Transform4f().translate(_shift(x)) @ camera.to_world)


def _scene(size: int) -> mi.Scene:
    """`scenes/pose.xml` whose wall has a texture."""
    scene = mi.load_file(str(assets.scene("pose")), resolution=size, optimize=False)
    texels = np.random.default_rng(0).uniform(0.4, 0.6, (64, 64, 3)).astype(np.float32)
    wall = next(shape for shape in scene.shapes() if shape.id() == "wall")
    wall.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}}))
    return scene
