"""Inputs of light estimation: an object on a floor, a camera above it, target directions and starts of all runs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io import assets
from ...io.meshes import check_suffix, read_mesh
from ..common.objects import load_mesh, occluder

OBJECTS = ("bunny", "dragon", "hand", "spot", "teapot", "suzanne")
#: Opening angle (degrees) of the cone about the vertical in which the directions to the lights lie.
CONE_DEG = 60.0
MOST_LIGHTS = 5
#: Irradiance of all lights together on a surface that faces them.
IRRADIANCE = math.pi
# Of the object.
_REFLECTANCE = 0.7

FloatArray = npt.NDArray[np.float64]


def check_scene(name: str, lights: int, resolution: int) -> Path:
    """The object's file. Raises ShadowmapError if the object does not exist, or a number is out of range."""
    if not 1 <= lights <= MOST_LIGHTS:
        raise ShadowmapError(f"{lights} lights: give 1 to {MOST_LIGHTS}.")
    if not 1 <= resolution <= 4096:
        raise ShadowmapError(f"a resolution of {resolution} pixels: give 1 to 4096.")
    path = assets.mesh(name)
    check_suffix(path)
    return path


def make_scene(name: str, lights: int, resolution: int) -> mi.Scene:
    """Make a scene: an object in [-1, 1]^3 on a diffuse floor, seen from above, under equal directional lights.

    Args:
        name: name of a mesh of this package, or a mesh file, which is centred and scaled into [-1, 1]^3.
        lights: number of lights, called ``light_0``, ``light_1``, ... All shine straight down.
        resolution: width and height of the image in pixels.
    """
    path = check_scene(name, lights, resolution)
    if name in assets.mesh_names():
        thing = load_mesh(path)
        shape: mi.Mesh | dict[str, Any] = {
            "type": "ply",
            "filename": str(path),
            "face_normals": True,
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": _REFLECTANCE}},
        }
    else:
        thing = shape = occluder("object", *read_mesh(path), (_REFLECTANCE,) * 3, both_sides=False)
    ground = float(thing.bbox().min.y)
    transform = mi.ScalarTransform4f
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    camera = transform().look_at(origin=[0, 6.5, 4], target=[0, ground + 0.5, 0], up=[0, 1, 0])
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "direct"},
        "camera": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
        # A rectangle's normal is +z: turn it to face up.
        "floor": {
            "type": "rectangle",
            "to_world": transform().translate([0, ground, 0]).rotate([1, 0, 0], -90).scale(5),
            "bsdf": grey,
        },
        "object": shape,
    }
    for k in range(lights):
        scene[f"light_{k}"] = {
            "type": "directional",
            "direction": [0, -1, 0],
            "irradiance": {"type": "rgb", "value": IRRADIANCE / lights},
        }
    return mi.load_dict(scene, optimize=False)


def random_directions(generator: np.random.Generator, count: int, cone_deg: float = CONE_DEG) -> FloatArray:
    """(count, 3) unit vectors, uniform by solid angle in a cone about +y with an opening angle of ``cone_deg``."""
    cosine = 1 - generator.uniform(0, 1, count) * (1 - math.cos(math.radians(cone_deg / 2)))
    angle = generator.uniform(0, 2 * math.pi, count)
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(angle), cosine, sine * np.sin(angle)], -1)


def target_and_starts(
    seed: int, run: int, lights: int, starts: int = 1, cone_deg: float = CONE_DEG
) -> tuple[FloatArray, FloatArray]:
    """Directions *to* the lights, target (lights, 3) and starts (starts, lights, 3) of a run.

    They depend on seed, run, number of lights and cone only: more starts do not change the target and the first start.
    """
    generator = np.random.default_rng((seed, run))
    target = random_directions(generator, lights, cone_deg)
    return target, np.stack([random_directions(generator, lights, cone_deg) for _ in range(starts)])


def alignment(target: npt.ArrayLike, found: npt.ArrayLike) -> float:
    """Mean dot product of matched directions (n, 3): greedily, the largest of the remaining dot products first."""
    target, found = (np.asarray(v, np.float64) for v in (target, found))
    dots = np.einsum("id,jd->ij", target, found) / np.outer(np.linalg.norm(target, axis=1), np.linalg.norm(found, axis=1))
    total, left = 0.0, dots.copy()
    for _ in range(len(target)):
        i, j = np.unravel_index(np.argmax(left), left.shape)
        total += dots[i, j]
        left[i, :] = left[:, j] = -np.inf
    return float(total / len(target))
