"""Optimisation loops as Mitsuba's users write them; only the integrator's dictionary is replaced.

Rebuilt from Mitsuba's and Dr.Jit's public documentation. Each loop is a generator that takes one step at a time and yields the
error of its parameters, so that loops with different integrators can take turns.
"""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...io import assets
from ...jit.gc import gc_quiet
from ...jit.types import AnyArray, TensorXf
from ...scene.mitsuba_meshes import make_mesh
from ..common.timing import compare, forget_peak_memory, peak_memory, timed
from .common import BenchOptions, Unit, Update, run_child

if TYPE_CHECKING:
    import drjit.opt

#: The integrator that replaces the originals.
OURS: dict[str, Any] = {"type": "shadowmap"}
# Original integrators for materials and lights, and for moving shapes and lights. Their sample counts are the defaults.
_MATERIALS: dict[str, Any] = {"type": "prb", "max_depth": 2}
_MOVES: dict[str, Any] = {"type": "direct_projective", "guiding": "none"}

_FLOOR, _BALL = "floor.bsdf.reflectance.value", "ball.bsdf.reflectance.value"
_TRUE_FLOOR, _TRUE_BALL, _TRUE_LAMP = (0.5, 0.5, 0.5), (0.6, 0.3, 0.2), (12.0, 12.0, 12.0)
# Samples of reference images and of steps.
_MANY, _SPP = 64, 4
# Steps that are not timed; steps of a long run after which its memory is measured.
_WARM_UP, _SETTLED = 3, 100
# A loop that takes longer than this hangs.
_SECONDS = 1800.0


@dataclass(frozen=True)
class Loop:
    """A loop.

    Attributes:
        steps: ``steps(integrator, size)`` makes the generator.
        original: dictionary of Mitsuba's integrator. If it is a projective one, so is a third contender, with ``sppi`` 0: no
            samples for silhouettes that only shadows and reflections show, as Mitsuba's tutorials set it.
        count: steps.
        bar: largest share of the first error after them.
        size: pixels along each side; None: those of the benchmark.
    """

    steps: Callable[[dict[str, Any], int], Iterator[float]]
    original: dict[str, Any]
    count: int = 40
    bar: float = 0.5
    size: int | None = None

    def contenders(self, size: int) -> dict[str, Iterator[float]]:
        """Our generator and those of Mitsuba's integrators."""
        integrators = {"ours": OURS, "original": self.original}
        if "projective" in self.original["type"]:
            integrators["sppi 0"] = {**self.original, "sppi": 0}
        return {name: self.steps(integrator, size) for name, integrator in integrators.items()}


def _scene_dict(integrator: dict[str, Any], size: int, **changes: object) -> dict[str, Any]:
    """A head over a floor under a lamp; ``changes``: parts to add or replace, None to leave a part out."""
    t = mi.ScalarTransform4f()
    head = {
        "type": "ply",
        "filename": str(assets.mesh("suzanne")),
        "to_world": t.translate([0, 0, 0.5]).rotate([1, 0, 0], 90).scale(0.4),
    }
    parts: dict[str, object] = {
        "type": "scene",
        "integrator": integrator,
        "sensor": {**_camera(-np.pi / 2), "film": _film(size, size)},
        "floor": {"type": "rectangle", "to_world": t.scale(2), "bsdf": _diffuse(_TRUE_FLOOR)},
        "lamp": {
            "type": "rectangle",
            "to_world": t.look_at([1, -1, 3], [0, 0, 0], [0, 1, 0]).scale(0.4),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(_TRUE_LAMP)}},
        },
        "ball": {**head, "bsdf": _diffuse(_TRUE_BALL)},
        **changes,
    }
    return {name: part for name, part in parts.items() if part is not None}


def _camera(angle: float) -> dict[str, Any]:
    origin = [4 * np.cos(angle), 4 * np.sin(angle), 3]
    return {"type": "perspective", "fov": 40, "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0.2], [0, 0, 1])}


def _film(width: int, height: int) -> dict[str, Any]:
    filtered = {"rfilter": {"type": "box"}, "sample_border": True}
    return {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", **filtered}


def _diffuse(colour: Sequence[float]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}


def _error(value: AnyArray, true: npt.ArrayLike) -> float:
    return float(np.abs(np.array(dr.detach(value)).ravel() - np.ravel(true)).mean())


def _descend(
    scene: mi.Scene,
    names: Sequence[str],
    starts: Sequence[AnyArray],
    true: Sequence[npt.ArrayLike],
    rate: float,
    bounds: tuple[float, float],
) -> Iterator[float]:
    """The loop of Mitsuba's tutorials: Adam, clipping, `params.update(opt)`."""
    reference = mi.render(scene, spp=_MANY)
    params = mi.traverse(scene)
    opt = mi.ad.Adam(lr=rate)
    for name, start in zip(names, starts, strict=True):
        opt[name] = start
    params.update(opt)
    step = 0
    while True:
        image = mi.render(scene, params, spp=_SPP, seed=step)
        dr.backward(dr.mean(dr.square(image - reference), axis=None))
        opt.step()
        for name in names:
            opt[name] = dr.clip(opt[name], *bounds)
        params.update(opt)
        step += 1
        yield sum(_error(opt[name], value) for name, value in zip(names, true, strict=True))


def clipped_colours(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """Reflectances, clipped to 0..1 after each step."""
    scene = mi.load_dict(_scene_dict(integrator, size))
    return _descend(scene, [_FLOOR, _BALL], [mi.Color3f(0.1, 0.9, 0.3), mi.Color3f(0.5)], [_TRUE_FLOOR, _TRUE_BALL], 0.04, (0, 1))


def kept_parameters(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """`params.keep`, and a lamp's radiance."""
    scene = mi.load_dict(_scene_dict(integrator, size))
    reference, name = mi.render(scene, spp=_MANY), "lamp.emitter.radiance.value"
    params = mi.traverse(scene)
    params.keep([name])
    opt = mi.ad.Adam(lr=0.4, params={name: mi.Color3f(5, 7, 9)})
    params.update(opt)
    step = 0
    while True:
        dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=_SPP, seed=step) - reference), axis=None))
        opt.step()
        params.update(opt)
        step += 1
        yield _error(opt[name], _TRUE_LAMP)


def sensors_in_turns(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """Three cameras, one backward pass for each before a step."""
    cameras = {f"camera{k}": {**_camera(2 * k), "film": _film(size, size)} for k in range(3)}
    scene = mi.load_dict(_scene_dict(integrator, size, sensor=None, **cameras))
    references = [mi.render(scene, sensor=k, spp=_MANY) for k in range(3)]
    params = mi.traverse(scene)
    opt = mi.ad.Adam(lr=0.04)
    opt[_BALL] = mi.Color3f(0.2, 0.6, 0.7)
    params.update(opt)
    step = 0
    while True:
        for k, reference in enumerate(references):
            image = mi.render(scene, params, sensor=k, spp=_SPP, seed=step)
            dr.backward(dr.mean(dr.square(image - reference), axis=None))
        opt.step()
        opt[_BALL] = dr.clip(opt[_BALL], 0, 1)
        params.update(opt)
        step += 1
        yield _error(opt[_BALL], _TRUE_BALL)


def batch_sensor(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """The same three cameras in one film."""
    cameras = {f"camera{k}": _camera(2 * k) for k in range(3)}
    sensor = {"type": "batch", **cameras, "film": _film(3 * size, size)}
    scene = mi.load_dict(_scene_dict(integrator, size, sensor=sensor))
    return _descend(scene, [_BALL], [mi.Color3f(0.2, 0.6, 0.7)], [_TRUE_BALL], 0.04, (0, 1))


def pytorch(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """`dr.wrap`, with PyTorch's optimiser."""
    import torch

    scene = mi.load_dict(_scene_dict(integrator, size))
    reference, params = mi.render(scene, spp=_MANY).torch(), mi.traverse(scene)

    @dr.wrap(source="torch", target="drjit")
    def render(colour: Any, seed: int = 0) -> TensorXf:  # Any: callers pass a `torch.Tensor`, `dr.wrap` makes it a TensorXf
        params[_FLOOR] = dr.unravel(mi.Color3f, colour.array)
        params.update()
        return mi.render(scene, params, spp=_SPP, seed=seed)

    colour = torch.tensor([0.1, 0.9, 0.3], device=reference.device, requires_grad=True)
    opt = torch.optim.Adam([colour], lr=0.04)
    step = 0
    while True:
        opt.zero_grad()
        (render(colour, seed=step) - reference).square().mean().backward()
        opt.step()
        with torch.no_grad():
            colour.clamp_(0, 1)
        step += 1
        yield _error(mi.Float(colour.tolist()), _TRUE_FLOOR)


def moved_light(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """Forward-mode derivatives by the position of the lamp, and Gauss-Newton steps."""
    scene = mi.load_dict(_scene_dict(integrator, size))
    reference, params = np.array(mi.render(scene, spp=_MANY)), mi.traverse(scene)
    pose, offset, step = mi.Transform4f(params["lamp.to_world"]), 0.4, 0
    while True:
        x = mi.Float(offset)
        dr.enable_grad(x)
        params["lamp.to_world"] = mi.Transform4f().translate([x, 0, 0]) @ pose
        params.update()
        dr.forward(x, dr.ADFlag.ClearEdges)
        image = mi.render(scene, params, spp=4 * _SPP, seed=step)
        slope = np.array(dr.forward_to(image))
        offset -= 0.5 * float(((np.array(image) - reference) * slope).sum() / (slope**2).sum())
        step += 1
        yield abs(offset)


def object_pose(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """Mitsuba's tutorial on poses: a bunny before a wall, under a sphere that shines."""
    t, many = mi.ScalarTransform4f(), 16
    filtered = {"rfilter": {"type": "gaussian"}, "sample_border": True}
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", **filtered}
    light = {"type": "area", "radiance": {"type": "rgb", "value": 1e3}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": integrator,
            "sensor": {"type": "perspective", "to_world": t.look_at([0, 0, 2], [0, 0, 0], [0, 1, 0]), "fov": 60, "film": film},
            "wall": {"type": "rectangle", "to_world": t.translate([0, 0, -2]).scale(2)},
            "ball": {"type": "ply", "filename": str(assets.mesh("bunny")), "to_world": t.scale(0.65)},
            "light": {"type": "sphere", "center": [2.5, 2.5, 7], "radius": 0.25, "emitter": light},
        }
    )
    params, name = mi.traverse(scene), "ball.vertex_positions"
    start = dr.unravel(mi.Point3f, params[name])
    opt = mi.ad.Adam(lr=0.025)
    opt["angle"], opt["trans"] = mi.Float(0.25), mi.Point2f(0.1, -0.25)

    def move() -> None:
        opt["trans"], opt["angle"] = dr.clip(opt["trans"], -0.5, 0.5), dr.clip(opt["angle"], -0.5, 0.5)
        moved = mi.Transform4f().translate([opt["trans"].x, opt["trans"].y, 0]).rotate([0, 1, 0], opt["angle"] * 100)
        params[name] = dr.ravel(moved @ start)
        params.update()

    reference, step = mi.render(scene, spp=512), 0
    while True:
        move()
        image = mi.render(scene, params, spp=many, seed=step)
        dr.backward(dr.mean(dr.square(image - reference), axis=None))
        opt.step()
        step += 1
        yield _error(opt["angle"], 0) + _error(opt["trans"], [0, 0])


def large_steps(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """Vertices through `mi.ad.LargeSteps`. Yields the image's RMSE."""
    scene = mi.load_dict(_scene_dict(integrator, size))
    reference, params, name = mi.render(scene, spp=_MANY), mi.traverse(scene), "ball.vertex_positions"
    smooth = mi.ad.LargeSteps(params[name], params["ball.faces"], 10)
    opt = mi.ad.Adam(lr=0.01, uniform=True)
    moved = dr.unravel(mi.Point3f, params[name]) * 0.8 + mi.Vector3f(0.2, 0.1, 0.1)
    opt["u"] = smooth.to_differential(dr.ravel(moved))
    step = 0
    while True:
        yield _smooth_step(scene, params, name, smooth, opt, reference, step)
        step += 1


def _smooth_step(
    scene: mi.Scene,
    params: mi.SceneParameters,
    name: str,
    smooth: Any,  # Any: `mi.ad.LargeSteps`, of which the stub of Mitsuba says nothing
    opt: drjit.opt.Adam,
    reference: TensorXf,
    step: int,
) -> float:
    """A step of the vertices' variable ``u`` (`mi.ad.LargeSteps`). Returns the image's RMSE before it."""
    params[name] = smooth.from_differential(opt["u"])
    params.update()
    loss = dr.mean(dr.square(mi.render(scene, params, spp=_SPP, seed=step) - reference), axis=None)
    dr.backward(loss)
    opt.step()
    return float(loss.array[0]) ** 0.5


def remeshing(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """A sphere that is subdivided, and the scene loaded again, every ten steps. Yields the image's RMSE."""
    import trimesh

    reference = mi.render(mi.load_dict(_scene_dict(integrator, size)), spp=_MANY)
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.3)
    vertices, faces, step = np.array(mesh.vertices) + [0, 0, 0.5], np.array(mesh.faces), 0
    while True:
        scene = mi.load_dict(_scene_dict(integrator, size, ball=_mesh(vertices, faces, _diffuse(_TRUE_BALL))))
        params, name = mi.traverse(scene), "ball.vertex_positions"
        smooth = mi.ad.LargeSteps(params[name], params["ball.faces"], 10)
        opt = mi.ad.Adam(lr=0.02, uniform=True)
        opt["u"] = smooth.to_differential(params[name])
        for _ in range(10):
            yield _smooth_step(scene, params, name, smooth, opt, reference, step)
            step += 1
        vertices = np.array(params[name]).reshape(-1, 3)
        if len(faces) < 2000:
            vertices, faces = trimesh.remesh.subdivide(vertices, faces)


def _mesh(vertices: np.ndarray, faces: np.ndarray, bsdf: dict[str, Any]) -> mi.Mesh:
    return make_mesh("ball", vertices, faces, mi.load_dict(bsdf))


def texture(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """Texels of the floor."""
    true = np.random.default_rng(0).uniform(0.2, 0.8, (8, 8, 3)).astype(np.float32)
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(true), "raw": True}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2), "bsdf": bsdf}
    scene = mi.load_dict(_scene_dict(integrator, size, floor=floor))
    start = dr.full(mi.TensorXf, 0.5, true.shape)
    return _descend(scene, ["floor.bsdf.reflectance.data"], [start], [true], 0.03, (0, 1))


def vertex_colours(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """An attribute of a mesh."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    bsdf = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
    ball = _mesh(np.array(mesh.vertices) + [0, 0, 0.5], np.array(mesh.faces), bsdf)
    true = np.repeat([_TRUE_BALL], len(mesh.vertices), 0).astype(np.float32)
    ball.add_attribute("vertex_color", 3, true.ravel())
    scene = mi.load_dict(_scene_dict(integrator, size, ball=ball))
    start = dr.full(mi.Float, 0.5, true.size)
    return _descend(scene, ["ball.vertex_color"], [start], [true], 0.02, (0, 1))


def more_and_more_lights(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """A scene that is loaded again with one more light, up to three, every ten steps."""

    def lights(count: int) -> dict[str, Any]:
        places = [[float(np.cos(2 * k)), float(np.sin(2 * k)), 2.5] for k in range(count)]
        colour = {"type": "rgb", "value": [3.0] * 3}
        return {f"light{k}": {"type": "point", "position": place, "intensity": colour} for k, place in enumerate(places)}

    reference = mi.render(mi.load_dict(_scene_dict(integrator, size, lamp=None, **lights(3))), spp=_MANY)
    known: dict[str, Any] = {}
    count, step = 0, 0
    while True:
        count = min(count + 1, 3)
        scene = mi.load_dict(_scene_dict(integrator, size, lamp=None, **lights(count)))
        params, names = mi.traverse(scene), [f"light{k}.intensity.value" for k in range(count)]
        opt = mi.ad.Adam(lr=0.2)
        for name in names:
            opt[name] = known.get(name, mi.Color3f(0.5))
        params.update(opt)
        for _ in range(10):
            dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=_SPP, seed=step) - reference), axis=None))
            opt.step()
            params.update(opt)
            step += 1
            yield sum(_error(opt[name], [3.0] * 3) for name in names) + 2.5 * (3 - count)
        known = {name: dr.detach(opt[name]) for name in names}


def saved_and_loaded(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """A run that is pickled every ten steps, and continues from there in a scene that is loaded again."""
    stored = pickle.dumps([0.1, 0.9, 0.3])
    while True:
        scene = mi.load_dict(_scene_dict(integrator, size))
        start = mi.Color3f(*pickle.loads(stored))
        reference, params = mi.render(scene, spp=_MANY), mi.traverse(scene)
        opt = mi.ad.Adam(lr=0.04)
        opt[_FLOOR] = start
        params.update(opt)
        for step in range(10):
            dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=_SPP, seed=step) - reference), axis=None))
            opt.step()
            opt[_FLOOR] = dr.clip(opt[_FLOOR], 0, 1)
            params.update(opt)
            yield _error(opt[_FLOOR], _TRUE_FLOOR)
        stored = pickle.dumps([float(c[0]) for c in opt[_FLOOR]])


def two_scenes(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """One colour of two scenes, one of which has a glossy material."""
    glossy = {"type": "roughplastic", "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.6]}}
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.4]).scale(0.3), "bsdf": glossy}
    scenes = [mi.load_dict(_scene_dict(integrator, size)), mi.load_dict(_scene_dict(integrator, size, ball=box))]
    references = [mi.render(scene, spp=_MANY) for scene in scenes]
    tables = [mi.traverse(scene) for scene in scenes]
    opt = mi.ad.Adam(lr=0.04)
    opt["colour"] = mi.Color3f(0.1, 0.9, 0.3)
    step = 0
    while True:
        for scene, params, reference in zip(scenes, tables, references, strict=True):
            params[_FLOOR] = opt["colour"]
            params.update()
            dr.backward(dr.mean(dr.square(mi.render(scene, params, spp=_SPP, seed=step) - reference), axis=None))
        opt.step()
        opt["colour"] = dr.clip(opt["colour"], 0, 1)
        step += 1
        yield _error(opt["colour"], _TRUE_FLOOR)


def cells_run_again(integrator: dict[str, Any], size: int) -> Iterator[float]:
    """A notebook's cell, run again every ten steps: a new scene is loaded while the old one is still referenced."""
    while True:
        loop = clipped_colours(integrator, size)
        for _ in range(10):
            yield next(loop)


LOOPS: dict[str, Loop] = {
    "clipped colours": Loop(clipped_colours, _MATERIALS),
    "kept parameters": Loop(kept_parameters, _MATERIALS),
    "sensors in turns": Loop(sensors_in_turns, _MATERIALS),
    "batch sensor": Loop(batch_sensor, _MATERIALS),
    "PyTorch": Loop(pytorch, _MATERIALS),
    "moved light": Loop(moved_light, _MOVES, count=20),
    "object pose": Loop(object_pose, {"type": "direct_projective"}, size=64),
    "large steps": Loop(large_steps, _MOVES, bar=0.7),
    "remeshing": Loop(remeshing, _MOVES, count=30, bar=0.8),
    "texture": Loop(texture, _MATERIALS),
    "vertex colours": Loop(vertex_colours, _MATERIALS, bar=0.8),
    "more and more lights": Loop(more_and_more_lights, _MATERIALS, count=30),
    "saved and loaded": Loop(saved_and_loaded, _MATERIALS, count=30),
    "two scenes": Loop(two_scenes, _MATERIALS),
    "cells run again": Loop(cells_run_again, _MATERIALS, count=20, bar=0.8),
}


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each loop."""
    return [Unit(name, functools.partial(_measure, options, name)) for name in LOOPS]


def _measure(options: BenchOptions, name: str, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Time of our steps and the original's in turns, first and last errors, and the growth of memory over many steps."""
    loop = LOOPS[name]
    size = loop.size or options.what.loop_size
    all_ = loop.contenders(size)
    seconds: dict[str, list[float]] = {key: [] for key in all_}
    errors: dict[str, list[float]] = {key: [] for key in all_}

    def advance(key: str) -> None:
        errors[key].append(next(all_[key]))

    with gc_quiet():
        for step in range(loop.count):
            update(step, loop.count, name)
            for key in all_:
                spent = timed(functools.partial(advance, key))
                if step >= _WARM_UP:
                    seconds[key].append(spent)
    result = {"size": size, "original": loop.original, **compare(seconds, [("original", "ours"), ("sppi 0", "ours")])}
    # Unlike the ratio of medians, this includes the steps for which a loop loads its scene again and renders its reference.
    result["ratio_of_totals"] = sum(seconds["original"]) / sum(seconds["ours"])
    result["errors"] = {key: {"first": values[0], "last": values[-1]} for key, values in errors.items()}
    if options.what.loop_steps:
        update(0, 1, f"{options.what.loop_steps} steps")
        arguments = {"name": name, "size": size, "count": options.what.loop_steps}
        result["memory"] = run_child("bench.loops:measure_memory", arguments, _SECONDS)
    return result


def measure_memory(name: str, size: int, count: int, emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Peak memory (bytes) of this process in the first steps, and in all later ones."""
    steps = LOOPS[name].steps(OURS, size)
    for step in range(count):
        next(steps)
        if step == _SETTLED:
            dr.sync_thread()
            settled = peak_memory()
            forget_peak_memory()
    return {"steps": count, "settled": settled, "later": peak_memory()}
