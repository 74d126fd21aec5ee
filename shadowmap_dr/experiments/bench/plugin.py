"""Benchmark: steps of the plug-in as Mitsuba's users write them, by kind of parameter, samples per pixel, and lights.

A step gives a parameter of `scenes/pose.xml` a new value, updates the scene, renders, and takes the gradient of a loss.
Contenders in turns: the plug-in with its defaults; without recordings; the same derivative with a `Renderer` in a frozen
function; and Mitsuba's `params.update()` alone. The last two together bound what the plug-in can reach. A `Renderer` does not
take materials as arguments: beside these stands its step by the object's vertices. Steps with more samples or lights are those by
the vertices.
"""

from __future__ import annotations

import functools
import gc
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...io import assets
from ...jit.frozen import freeze
from ...jit.types import Float, TensorXf, Vector3f
from ...rendering.renderer import Renderer
from ...scene.lights.punctual import DirectionalLight
from ..common import meshes as bench_meshes
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


@dataclass(frozen=True)
class Step:
    """A step.

    Attributes:
        kind: of parameter, see `KINDS`.
        resolution: pixels along each side.
        spp: samples per pixel.
        lights: number of lights, suns or ``points``.
    """

    kind: str
    resolution: int
    spp: int = 1
    lights: int = 1
    points: bool = False

    @property
    def title(self) -> str:
        """All but the size."""
        samples = [f"{self.spp} spp"] if self.spp > 1 else []
        lights = [f"{self.lights} {'points' if self.points else 'suns'}"] if self.lights > 1 else []
        return ", ".join([self.kind, *samples, *lights])

    def __str__(self) -> str:
        return f"{self.title}@{self.resolution}"


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each kind of parameter and each size, and for each number of samples and lights."""
    what = options.what
    steps = [Step(kind, size) for size in what.plugin_resolutions for kind in what.plugin_kinds]
    steps += [Step("vertices", size, spp) for size in what.plugin_resolutions for spp in what.plugin_samples]
    steps += [Step("vertices", what.plugin_resolutions[0], 1, lights, kind == "points") for lights, kind in what.plugin_lights]
    return [Unit(str(step), functools.partial(_measure, step, what.rounds)) for step in steps]


def _measure(step: Step, rounds: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    gc.collect()  # scenes of earlier units: while they live, Mitsuba compiles calls of their objects
    frozen = step if step.kind in _ARGUMENTS else replace(step, kind="vertices")
    contenders: dict[str, Callable[[], object]] = {
        "plug-in": _Loop(step),
        "not recorded": _Loop(step, recorded=False),
        "renderer": Frozen(frozen),
        "update": _Loop(step).update,
    }
    # A loop is recorded from its fifth step on.
    timed = {name: Contender(call, rounds, warm_up=10) for name, call in contenders.items()}
    times = compare(alternate(timed, on_call=update), [("not recorded", "plug-in")])
    seconds = {name: entry["median"] for name, entry in times["seconds"].items()}
    over = seconds["plug-in"] / (seconds["renderer"] + seconds["update"])
    return {**asdict(step), "title": step.title, "over_renderer_and_update": over, **times}


class _Loop:
    """The loop of a Mitsuba user."""

    def __init__(self, step: Step, **parameters: bool) -> None:
        self._scene, self._spp = scene_of(step), step.spp
        self._params, self._key = mi.traverse(self._scene), KINDS[step.kind]
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
        return _gradient(mi.render(self._scene, self._params, integrator=self._integrator, spp=self._spp), x)


class Frozen:
    """The same derivative with a `Renderer`, in a frozen function."""

    def __init__(self, step: Step) -> None:
        scene, arguments, spp = scene_of(step), _ARGUMENTS[step.kind], step.spp
        self._vertices = mi.Float(dr.detach(mi.traverse(scene)[KINDS["vertices"]]))
        self._renderer, self._x = Renderer.from_scene(scene), 0.0

        def gradient(x: Float, vertices: Float, renderer: Renderer) -> Float:
            x = mi.Float(x)
            dr.enable_grad(x)
            return _gradient(renderer.render(**arguments(renderer, vertices, x), spp=spp), x)

        self._step = freeze(gradient)

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


def scene_of(step: Step) -> mi.Scene:
    """`scenes/pose.xml` whose wall has a texture, under the step's lights."""
    if step.lights > 1:
        scene = bench_meshes.scene(assets.mesh("spot"), step.resolution, step.lights, points=step.points)
    else:
        scene = mi.load_file(str(assets.scene("pose")), resolution=step.resolution, optimize=False)
    texels = np.random.default_rng(0).uniform(0.4, 0.6, (64, 64, 3)).astype(np.float32)
    wall = next(shape for shape in scene.shapes() if shape.id() == "wall")
    wall.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}}))
    return scene
