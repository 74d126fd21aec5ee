"""Benchmark: rasterization alone, beside ray casting with Embree through Mitsuba, and all raster functions together."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ...jit.arrays import device_array
from ...jit.frozen import freeze, recordings_of
from ...jit.types import Float, Matrix4f, UInt32
from ...raster import Topology, antialias, build_topology, interpolate, rasterize
from ...scene.load import load
from ...scene.mitsuba_meshes import set_positions
from ..common import meshes as bench_meshes
from ..common.timing import Contender, alternate, compare
from .common import BenchOptions, Unit, Update

DRTK_NOTE = "DRTK, native C++ kernels, 2 threads, on two cores with AVX-512; measured earlier and quoted, not measured here."
#: Milliseconds of Meta's DRTK (C++ kernels for the CPU) for Spot over the wall, as `DRTK_NOTE` says.
DRTK_MS = {
    "rasterize": {"128": 0.34, "512": 2.4, "1024": 9.0},
    "rasterize and interpolate": {"128": 0.46, "512": 4.6, "1024": 18.0},
    "forward and backward": {"128": 4.4, "512": 70.0, "1024": 270.0},
}

RATIOS = (("embree update and trace", "ours"), ("embree trace", "ours"))


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each mesh at each resolution, worst cases included, then the forward and backward passes."""
    what = options.what
    result = [
        Unit(f"{kind}@{resolution}", functools.partial(measure_raster, options, kind, resolution))
        for kind in dict.fromkeys((*what.meshes, *what.worst.values(), *what.worst))
        for resolution in what.raster_resolutions
    ]
    kind, resolutions = what.full_raster
    for resolution in resolutions:
        result.append(Unit(f"full {kind}@{resolution}", functools.partial(measure_full, options, kind, resolution)))
    return result


@dataclass(frozen=True)
class RasterScene:
    """Inputs of the raster functions for a scene, and the scene itself for Mitsuba.

    Attributes:
        scene: the ``mi.Scene``.
        p_rest: Float (3V,), world-space vertices of all shapes.
        moving: Float (V,), 1 for the vertices of the object, 0 for those of the wall.
        matrix: Matrix4f of scalars, world to clip space.
        faces: UInt32 (3F,).
        shape_rest: Float (3W,), world-space vertices of the object alone.
    """

    scene: mi.Scene
    p_rest: Float
    moving: Float
    matrix: Matrix4f
    faces: UInt32
    shape_rest: Float

    @property
    def triangles(self) -> int:
        return dr.width(self.faces) // 3

    def topology(self) -> Topology:
        return build_topology(np.array(self.faces), np.array(self.p_rest).reshape(-1, 3), mi.UInt32)


def raster_scene(options: BenchOptions, kind: str, resolution: int) -> RasterScene:
    """The wall and a mesh of `common.meshes`, seen from the camera of `scenes/pose.xml`."""
    scene = bench_meshes.scene(bench_meshes.stored(kind, options.work), resolution)
    data = load(scene)
    geometry = data.geometry
    info = next(info for info in geometry.shapes if info.name == "object")
    index = dr.arange(mi.UInt32, geometry.vertex_count)
    moving = (index >= info.vertex_start) & (index < info.vertex_start + info.vertex_count)
    # The clip planes of the scene's camera (0.01 and 10,000) would leave little precision for depths.
    camera = replace(data.sensors[0][0], near=mi.Float(1), far=mi.Float(20))
    matrix = mi.Matrix4f(camera.view_projection)
    p_rest = mi.Float(dr.detach(geometry.positions))
    shape_rest = cast("Float", dr.ravel(geometry.shape_positions("object")))
    result = RasterScene(scene, p_rest, dr.select(moving, mi.Float(1), 0), matrix, mi.UInt32(geometry.faces), shape_rest)
    dr.make_opaque(result.p_rest, result.moving, result.matrix, result.faces, result.shape_rest)
    return result


def offsets(batch: int = 1) -> Iterator[Float]:
    """Endless small offsets in x, Float (batch,), so that vertices differ from call to call."""
    values = [device_array(mi.Float, np.linspace(0.001 * k, 0.001 * k + 0.01, batch)) for k in range(8)]
    dr.make_opaque(values)
    return itertools.cycle(values)


def to_clip(p_rest: Float, moving: Float, matrix: Matrix4f, offset: Float) -> Float:
    """Clip-space vertices, Float (4VB,), of the scene, its object moved by each of the B offsets. Gradients flow to `p_rest`."""
    vertices, batch = dr.width(p_rest) // 3, dr.width(offset)
    lane = dr.arange(mi.UInt32, vertices * batch)
    image = lane // vertices if batch > 1 else dr.zeros(mi.UInt32, vertices)
    vertex = lane - image * vertices
    p = dr.gather(mi.Point3f, p_rest, vertex)
    x = dr.fma(dr.gather(mi.Float, moving, vertex), dr.gather(mi.Float, offset, image), p.x)
    row = [dr.fma(matrix[r, 0], x, dr.fma(matrix[r, 1], p.y, dr.fma(matrix[r, 2], p.z, matrix[r, 3]))) for r in range(4)]
    return cast("Float", dr.ravel(mi.Point4f(*row)))


def _visible(
    p_rest: Float, moving: Float, matrix: Matrix4f, faces: UInt32, offset: Float, *, size: int
) -> tuple[UInt32, Float, Float, Float]:
    clip = to_clip(p_rest, moving, matrix, offset)
    raster = rasterize(clip, faces, (size, size), batch=dr.width(offset), check_indices=False)
    return raster.triangle, raster.u, raster.v, raster.depth


def _forward(p_rest: Float, moving: Float, matrix: Matrix4f, faces: UInt32, offset: Float, *, size: int) -> Float:
    clip = to_clip(p_rest, moving, matrix, offset)
    raster = rasterize(clip, faces, (size, size), batch=dr.width(offset), check_indices=False)
    return interpolate(mi.TensorXf(p_rest, (dr.width(p_rest) // 3, 3)), raster, faces, check_indices=False).array


def _forward_backward(
    p_rest: Float, moving: Float, matrix: Matrix4f, faces: UInt32, offset: Float, topology: Topology, target: Float, *, size: int
) -> tuple[Float, Float]:
    """Loss and its gradient with respect to the vertices: rasterize, interpolate positions, anti-alias, compare."""
    p_world = mi.Float(p_rest)
    dr.enable_grad(p_world)
    clip = to_clip(p_world, moving, matrix, offset)
    raster = rasterize(clip, faces, (size, size), batch=dr.width(offset), check_indices=False)
    image = interpolate(mi.TensorXf(p_world, (dr.width(p_world) // 3, 3)), raster, faces, check_indices=False)
    image = antialias(image, raster, clip, topology)
    loss = dr.mean(dr.square(image.array - target))
    dr.backward(loss)
    return dr.detach(loss), dr.grad(p_world)


def measure_raster(options: BenchOptions, kind: str, resolution: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Times of our rasterization of moved vertices, of Mitsuba's BVH update with rays for all pixels, and of the rays alone."""
    predicted = _predicted(options, kind, resolution, done)
    if predicted > options.what.call_seconds:
        return {"mesh": kind, "resolution": resolution, "skipped": f"predicted to take {predicted:.0f} s a call"}
    update(0, 1, "mesh")
    data = raster_scene(options, kind, resolution)
    ours = freeze(_visible)
    params, ray, moves = mi.traverse(data.scene), camera_rays(data.scene, resolution), offsets()

    def rasterize_moved() -> tuple[UInt32, Float, Float, Float]:
        result = ours(data.p_rest, data.moving, data.matrix, data.faces, next(moves), size=resolution)
        dr.eval(result)
        return result

    def trace() -> mi.PreliminaryIntersection3f:
        # Not frozen: `dr.freeze` makes it slower.
        hit = data.scene.ray_intersect_preliminary(ray, coherent=True)
        dr.eval(hit)
        return hit

    def update_and_trace() -> mi.PreliminaryIntersection3f:
        offset = dr.gather(mi.Float, next(moves), dr.zeros(mi.UInt32, dr.width(data.shape_rest)))
        x_only = dr.arange(mi.UInt32, dr.width(data.shape_rest)) % 3 == 0
        set_positions(params, dr.select(x_only, data.shape_rest + offset, data.shape_rest), "object")
        params.update()
        return trace()

    limits: dict[str, Any] = {"rounds": options.what.rounds, "warm_up": 3, "seconds": options.what.call_seconds}
    samples = alternate(
        {
            "ours": Contender(rasterize_moved, **limits),
            "embree update and trace": Contender(update_and_trace, **limits),
            "embree trace": Contender(trace, **limits),
        },
        update,
    )
    covered = np.array(rasterize_moved()[0]) != 0xFFFFFFFF
    result = {"mesh": kind, "triangles": data.triangles, "resolution": resolution, **compare(samples, RATIOS)}
    result |= {"recordings": recordings_of(ours), "pixels_covered": float(covered.mean())}
    partner = done.get(f"{options.what.worst.get(kind)}@{resolution}", {})
    if "seconds" in partner:
        name = f"{kind} / {partner['mesh']}"
        result["ratio_of_medians"][name] = result["seconds"]["ours"]["median"] / partner["seconds"]["ours"]["median"]
    return result


def _predicted(options: BenchOptions, kind: str, resolution: int, done: Mapping[str, Any]) -> float:
    """Predicted seconds of a rasterization, from the time for the next smaller image; 0 if there is none."""
    smaller = [r for r in options.what.raster_resolutions if r < resolution]
    before = done.get(f"{kind}@{max(smaller)}", {}) if smaller else {}
    if "skipped" in before:
        return float("inf")
    return before["seconds"]["ours"]["median"] * (resolution / max(smaller)) ** 2 if "seconds" in before else 0.0


def camera_rays(scene: mi.Scene, resolution: int) -> mi.Ray3f:
    """Rays through all pixel centres, evaluated."""
    index = dr.arange(mi.UInt32, resolution * resolution)
    row = index // resolution
    position = mi.Point2f(index - row * resolution, row)
    ray, _ = scene.sensors()[0].sample_ray(0, 0.5, (position + 0.5) / resolution, mi.Point2f(0.5))
    dr.make_opaque(ray)
    return ray


def measure_full(options: BenchOptions, kind: str, resolution: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Time of the raster functions: rasterize; with interpolation; with anti-aliasing, loss and backward pass."""
    update(0, 1, "mesh")
    data = raster_scene(options, kind, resolution)
    topology, moves = data.topology(), offsets()
    common = (data.p_rest, data.moving, data.matrix, data.faces)
    target = mi.Float(_forward(*common, mi.Float([0.2]), size=resolution))
    dr.make_opaque(target, topology)
    steps: dict[str, tuple[Callable[..., object], tuple[object, ...]]] = {
        "rasterize": (freeze(_visible), ()),
        "rasterize and interpolate": (freeze(_forward), ()),
        "forward and backward": (freeze(_forward_backward), (topology, target)),
    }

    def call(name: str) -> object:
        step, more = steps[name]
        result = step(*common, next(moves), *more, size=resolution)
        dr.eval(result)
        return result

    limits: dict[str, Any] = {"rounds": options.what.rounds, "seconds": options.what.call_seconds}
    samples = alternate({name: Contender(functools.partial(call, name), **limits) for name in steps}, update)
    result = {"mesh": kind, "triangles": data.triangles, "resolution": resolution, **compare(samples)}
    drtk = {name: DRTK_MS[name][str(resolution)] for name in steps if str(resolution) in DRTK_MS[name]}
    if kind.startswith("spot-6k") and drtk:
        result["drtk_ms"] = {"note": DRTK_NOTE, **drtk}
        result["drtk_over_ours"] = {name: ms / 1e3 / result["seconds"][name]["median"] for name, ms in drtk.items()}
    return result
