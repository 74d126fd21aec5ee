"""Errors of derivatives at the limits of docs/limits.md: against central differences of images with 256 samples a pixel.

    python docs/examples/limits.py [--size 64] [--samples 1 16]

Prints the cosine between both derivative images and the scale of ours, after a blur of 5 pixels.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
import trimesh

import shadowmap_dr  # noqa: F401  (adds the integrator, and chooses the LLVM library)

# isort: split
import drjit as dr
import mitsuba as mi

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--size", type=int, default=64)
parser.add_argument("--samples", type=int, nargs="+", default=[1, 16])
options = parser.parse_args()

mi.set_variant("llvm_ad_rgb")
T = mi.ScalarTransform4f


def camera(origin: list[float], target: list[float], up: list[float]) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": options.size, "height": options.size, "rfilter": {"type": "box"}}
    return {"type": "perspective", "fov": 40, "to_world": T().look_at(origin, target, up), "film": film}


FRONT, ABOVE = camera([0, -4, 0], [0, 0, 0], [0, 0, 1]), camera([0, -0.5, 4], [0, 0, 0], [0, 1, 0])
SUN = {"type": "directional", "direction": [0, 0.3, -1], "irradiance": 3.0}


def ball(subdivisions: int) -> Any:
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.8)
    mesh = mi.Mesh("mesh", len(sphere.vertices), len(sphere.faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.float32(sphere.vertices).ravel()
    params["faces"] = np.uint32(sphere.faces).ravel()
    params.update()
    return mesh


def moved(key: str, axis: list[float]) -> Callable[[Any, Any, Any], Any]:
    def change(rest: Any, x: Any) -> Any:
        if key.endswith("to_world"):
            return mi.Transform4f().translate(mi.Vector3f(axis) * x) @ rest
        return dr.ravel(dr.unravel(mi.Point3f, rest) + mi.Vector3f(axis) * x)

    return change


def grown(rest: Any, x: Any) -> Any:
    return mi.Transform4f().scale(mi.Vector3f(1 + x)) @ rest


def blurred(image: np.ndarray) -> np.ndarray:
    for axis in (0, 1):
        image = sum(np.roll(image, k, axis) for k in range(-2, 3)) / 5
    return image


def measure(name: str, parts: dict[str, Any], key: str, change: Any, unit: float = 1.0, shadows: str = "none") -> None:
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "shadowmap", "shadow_method": shadows})
    rest = type(params[key])(params[key])

    def render(x: Any, spp: int) -> Any:
        params[key] = change(rest, unit * x)
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=spp)

    step = 0.02
    ends = [render(mi.Float(side * step), 256).numpy() for side in (1, -1)]
    expected = blurred((ends[0] - ends[1]).sum(-1) / (2 * step))
    for spp in options.samples:
        x = mi.Float(0)
        dr.enable_grad(x)
        image = render(x, spp)
        dr.forward(x)
        found = blurred(dr.grad(image).numpy().sum(-1))
        both = (found * expected).sum()
        cosine, scale = both / max(np.linalg.norm(found) * np.linalg.norm(expected), 1e-12), both / (expected**2).sum()
        print(f"{name}, {spp} samples: cosine {cosine:.3f}, scale {scale:.3f}", flush=True)


lamp = {"type": "directional", "direction": [0, 1, 0]}
sphere = {"type": "sphere", "radius": 0.8}
measure("ball lit from the camera, grows", {"camera": FRONT, "sun": lamp, "ball": sphere}, "ball.to_world", grown)
for level in (1, 2):
    side = {"type": "point", "position": [4, 0, 0], "intensity": 30.0}
    parts = {"camera": FRONT, "lamp": side, "mesh": ball(level)}
    name = f"ball of {20 * 4**level} smooth triangles lit from the side"
    measure(name, parts, "mesh.vertex_positions", moved("mesh", [1, 0, 0]))
plastic = {"type": "twosided", "bsdf": {"type": "plastic"}}
for radius in (0.5, 0.12):
    shape = {"type": "cylinder", "p0": [-0.8, 0, 0], "p1": [0.8, 0, 0], "radius": radius, "bsdf": plastic}
    parts = {"camera": ABOVE, "sun": SUN, "tube": shape}
    measure(f"tube of plastic, radius {radius}", parts, "tube.to_world", moved("tube.to_world", [0, 1, 0]))
for unit in (1.0, 1e-4, 1e-6):
    small = T().scale(unit)
    view = {**ABOVE, "to_world": small @ ABOVE["to_world"] @ T().scale(1 / unit)}
    view |= {"near_clip": 0.01 * unit, "far_clip": 100 * unit}
    cube = {"type": "cube", "to_world": small @ T().translate([0, 0, 0.8]).scale(0.3)}
    slanted = {**SUN, "direction": [0.5, 0.3, -1]}
    parts = {"camera": view, "sun": slanted, "floor": {"type": "rectangle", "to_world": small @ T().scale(2)}, "cube": cube}
    measure(f"box and shadow, unit {unit:g}", parts, "cube.vertex_positions", moved("cube", [1, 0, 0]), unit, "evsm4")
