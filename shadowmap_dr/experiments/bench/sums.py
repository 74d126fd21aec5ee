"""Benchmark: agreement of reverse mode, which sums the derivatives of millions of samples, with forward mode.

For a parameter p and an image I the derivative of <I, w> by p is computed twice: in reverse mode, where the device sums the terms
of all samples in single precision, and as the sum of the derivative image, in double precision on the host. ``w`` is constant
where p is a colour: all terms are alike then, which is the worst case for such sums.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError, did_you_mean
from ...jit.arrays import device_tensor
from ...jit.frozen import freeze
from ...jit.types import Float, TensorXf
from ...rendering.renderer import Renderer
from ...scene.mitsuba_meshes import make_mesh
from .common import BenchOptions, Unit, Update, run_child

MODES = ("plug-in", "recorded", "renderer", "frozen")
#: Allowed difference of the two sums, relative.
TOLERANCE = 1e-3
# A case that takes longer than this hangs.
_SECONDS = 900.0


@dataclass(frozen=True)
class Sum:
    """A parameter of a floor with a ball over it: ``light`` and ``material`` by name, ``parameter`` by that in `mi.traverse`."""

    light: str
    material: str
    parameter: str

    def __str__(self) -> str:
        return f"{self.light}, {self.material}, {self.parameter}"


#: Kinds of parameters.
SUMS = (
    Sum("sun", "diffuse", "floor.bsdf.reflectance.value"),
    Sum("sky", "diffuse", "floor.bsdf.reflectance.value"),
    Sum("lamp", "diffuse", "floor.bsdf.reflectance.value"),
    Sum("sun", "texture", "floor.bsdf.reflectance.data"),
    Sum("lamp", "texture", "floor.bsdf.reflectance.data"),
    Sum("point", "plastic", "floor.bsdf.diffuse_reflectance.value"),
    Sum("lamp", "plastic", "floor.bsdf.diffuse_reflectance.value"),
    Sum("lamp", "plastic", "floor.bsdf.alpha"),
    Sum("sun", "diffuse", "light.irradiance.value"),
    Sum("point", "diffuse", "light.intensity.value"),
    Sum("sky", "diffuse", "light.radiance.value"),
    Sum("image", "diffuse", "light.data"),
    Sum("lamp", "diffuse", "light.emitter.radiance.value"),
    Sum("sun", "diffuse", "light.to_world"),
    Sum("point", "diffuse", "light.position"),
    Sum("lamp", "diffuse", "light.to_world"),
    Sum("spot", "diffuse", "light.to_world"),
    Sum("sun", "diffuse", "floor.to_world"),
    Sum("sun", "diffuse", "floor.vertex_positions"),
    Sum("sun", "diffuse", "ball.to_world"),
    Sum("point", "diffuse", "sensor.to_world"),
)


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each kind of parameter, with all its sizes and modes."""
    return [Unit(str(case), functools.partial(_measure, options, case)) for case in SUMS]


def _measure(options: BenchOptions, case: Sum, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    results = []
    kinds = [mode for mode in MODES if mode in ("plug-in", "recorded") or case.parameter.endswith(_OF_RENDERERS)]
    plan = [(size, spp, mode) for size, spp in options.what.sums for mode in kinds]
    for number, (size, spp, mode) in enumerate(plan):
        update(number, len(plan), f"{size} x {size}, {spp} samples, {mode}")
        arguments = {"case": asdict(case), "size": size, "spp": spp, "mode": mode}
        results.append({"size": size, "spp": spp, "mode": mode, **run_child("bench.sums:measure_sum", arguments, _SECONDS)})
    failed = [result["failed"] for result in results if "failed" in result]
    return {"sums": results} if not failed else {"sums": results, "failed": failed[0]}


def measure_sum(
    case: Mapping[str, str], size: int, spp: int, mode: str, emit: Callable[[dict[str, Any]], None]
) -> dict[str, Any]:
    """Both sums, and their ratio."""
    reverse, forward = both(Sum(**case), size, spp, mode)
    return {"reverse": reverse, "forward": forward, "ratio": reverse / forward}


def both(case: Sum, size: int, spp: int, mode: str = "plug-in") -> tuple[float, float]:
    """The derivative of <image, w> by a change of the parameter: in reverse mode, and summed from the derivative image.

    Args:
        case: the parameter, its light and its material.
        size: pixels along each side of the image.
        spp: samples per pixel.
        mode: one of :data:`MODES`, for the reverse mode; forward mode always uses the plug-in.
    """
    reverse = _reverse(case, size, spp, mode)
    # Virtual calls of materials trace those of all living scenes; forward mode fails if another scene's are attached, too.
    gc.collect()
    return reverse, _forward(case, size, spp)


def _reverse(case: Sum, size: int, spp: int, mode: str) -> float:
    if mode in ("renderer", "frozen"):
        return _of_renderer(case, size, spp, mode == "frozen")
    if mode not in MODES:
        raise ShadowmapError(f"no mode {mode!r}: choose from {', '.join(MODES)}.{did_you_mean(mode, MODES)}")
    scene, change = _changed(case, size)
    integrator = mi.load_dict({"type": "shadowmap", "recorded": mode == "recorded"})
    mi.render(scene, integrator=integrator, spp=spp)
    integrator.render_backward(scene, params=change, grad_in=device_tensor(mi.TensorXf, _weights(case, size)), spp=spp)
    return float(dr.grad(change)[0])


def _forward(case: Sum, size: int, spp: int) -> float:
    scene, change = _changed(case, size)
    dr.forward(change, dr.ADFlag.ClearEdges)
    image = mi.load_dict({"type": "shadowmap"}).render_forward(scene, params=change, spp=spp)
    return float((np.array(image, dtype=np.float64) * _weights(case, size)).sum())


#: Parameters that a renderer takes as arguments.
_OF_RENDERERS = ("irradiance.value", "intensity.value", "position", "vertex_positions")


def _of_renderer(case: Sum, size: int, spp: int, frozen: bool) -> float:
    """Reverse mode through a renderer, whose lights and vertices are arguments."""
    scene, _ = _changed(case, size)
    renderer, weights = Renderer.from_scene(scene), device_tensor(mi.TensorXf, _weights(case, size))
    name, _, field = case.parameter.removesuffix(".value").partition(".")

    def step(change: Float, weights: TensorXf, renderer: Renderer) -> Float:
        dr.enable_grad(change)
        if field == "vertex_positions":
            points = renderer.data.geometry.shape_positions(name)
            image = renderer.render(vertex_positions={name: _moved(case, points, change)}, spp=spp)
        else:
            light = renderer.light(name)
            lights: dict[str, Any] = {name: replace(light, **{field: _moved(case, getattr(light, field), change)})}
            image = renderer.render(lights=lights, spp=spp)
        dr.backward(dr.sum((image * weights).array))
        return dr.grad(change)

    call = freeze(step) if frozen else step
    for _ in range(3 if frozen else 1):
        result = call(dr.opaque(mi.Float, 0), weights, renderer)
    return float(result[0])


def _weights(case: Sum, size: int) -> np.ndarray:
    """Weights w (size, size, 3) with a sum of about 1."""
    weights = np.full((size, size, 3), 1 / (3 * size * size), np.float32)
    if _moves(case):
        # A motion takes radiance from one pixel to the next: under constant weights the sum would be rounding errors only.
        y, x = np.mgrid[:size, :size] / size
        weights *= (1 + x + 0.5 * y)[..., None].astype(np.float32)
    return weights


def _moves(case: Sum) -> bool:
    return case.parameter.endswith(("to_world", "position", "vertex_positions"))


def _moved(case: Sum, value: Any, change: Float) -> Any:  # Any: transforms, points or colours, by the parameter
    """A parameter's value, changed."""
    if case.parameter.endswith("to_world"):
        move = mi.Transform4f().translate([change, 0.3 * change, 0.5 * change]).rotate([0.2, 0.3, 1], change * 20)
        return move @ mi.Transform4f(value)
    if case.parameter.endswith("vertex_positions"):
        if dr.depth_v(value) == 1:
            value = dr.unravel(mi.Point3f, value)
            return dr.ravel(value + mi.Vector3f(0, 0, change) * (value.x + 0.5))
        return mi.Point3f(value) + mi.Vector3f(0, 0, change) * (value.x + 0.5)
    if case.parameter.endswith("position"):
        return mi.Point3f(value) + mi.Vector3f(change, 0.5 * change, change)
    return value + change


def _changed(case: Sum, size: int) -> tuple[mi.Scene, Float]:
    """The scene, and the change of its parameter: an attached zero, Float (1,)."""
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}, "width": size, "height": size, "pixel_format": "rgb"}
    camera = t.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "light": _lights()[case.light],
            "floor": _floor(case),
            "ball": {"type": "sphere", "to_world": t.translate([0, 0, 0.4]).scale(0.25)},
            "sensor": {"type": "perspective", "fov": 25, "to_world": camera, "film": film},
        },
        optimize=False,
    )
    params, change = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(change)
    params[case.parameter] = _moved(case, params[case.parameter], change)
    params.update()
    return scene, change


def _floor(case: Sum) -> dict[str, Any] | mi.Mesh:
    """A rectangle that fills the camera's view; a mesh of two triangles where vertices are the parameter."""
    material = _materials()[case.material]
    if not case.parameter.endswith("vertex_positions"):
        return {"type": "rectangle", "bsdf": material}
    corners = [[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    return make_mesh("floor", corners, [[0, 1, 2], [0, 2, 3]], mi.load_dict(material))


def _materials() -> dict[str, Any]:
    return {
        "diffuse": {"type": "diffuse", "reflectance": _rgb(0.5)},
        "texture": {"type": "diffuse", "reflectance": _picture((2, 2), 0.3, 0.7)},
        "plastic": {"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": _rgb(0.5)},
    }


def _lights() -> dict[str, Any]:
    pose = mi.ScalarTransform4f().look_at([1, 0.5, 3], [0, 0, 0], [0, 1, 0])
    glow = {"type": "area", "radiance": _rgb(5)}
    return {
        "sun": {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": _rgb(1)},
        "point": {"type": "point", "position": [1, 0.5, 3], "intensity": _rgb(20)},
        "spot": {"type": "spot", "to_world": pose, "cutoff_angle": 40, "intensity": _rgb(20)},
        "sky": {"type": "constant", "radiance": _rgb(1)},
        "image": {"type": "envmap", "bitmap": _picture((4, 8), 0.5, 1.5)["bitmap"]},
        "lamp": {"type": "rectangle", "to_world": pose.scale(0.3), "emitter": glow},
    }


def _rgb(value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": [value] * 3}


def _picture(size: tuple[int, int], least: float, most: float) -> dict[str, Any]:
    values = np.linspace(least, most, size[0] * size[1] * 3, dtype=np.float32).reshape(*size, 3)
    return {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(values)}
