"""Scene of the experiments on gradients: a receiver, an occluder above it, parallel light, a camera that sees only the shadow.

Its image *is* the visibility: a white diffuse receiver that faces a light of irradiance pi has radiance 1 where it is lit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
from trimesh.transformations import rotation_matrix

from ...errors import ShadowmapError, did_you_mean
from ..common.meshes import Mesh, subdivided, torus
from ..common.objects import occluder

#: z of the receiver, and half of its side.
RECEIVER_Z, RECEIVER_HALF = -2.0, 1.0
#: orthographic: parallel to the light, between occluder and receiver. perspective: beside the light, and not parallel to it.
#: pinhole: a perspective camera in the place of the orthographic one, with the same image of the receiver, pixel by pixel:
#: Mitsuba's projective integrators refuse orthographic cameras.
CAMERAS = ("orthographic", "perspective", "pinhole")
_BETWEEN_Z = -1.0
_BESIDE, _FOV_DEG = (1.0, 0.0, 0.75), 50.0

Array = npt.NDArray[np.float32]


def build(mesh: Mesh, resolution: int, camera: str = "orthographic") -> mi.Scene:
    """``mi.Scene`` with the shapes ``receiver`` and ``occluder``, the emitter ``light`` (along -z) and the sensor ``camera``.

    Args:
        mesh: occluder, world space.
        resolution: pixels along each side of the image, one channel.
        camera: see `CAMERAS`.
    """
    if camera not in CAMERAS:
        raise ShadowmapError(f"no camera {camera!r}: choose from {', '.join(CAMERAS)}.{did_you_mean(camera, CAMERAS)}")
    t = mi.ScalarTransform4f
    film: dict[str, Any] = {
        "type": "hdrfilm",
        "width": resolution,
        "height": resolution,
        "rfilter": {"type": "box"},
        "pixel_format": "luminance",
        "component_format": "float32",
        "sample_border": camera == "pinhole",  # Mitsuba requires it for derivatives of shapes
    }
    if camera == "orthographic":
        place = t().look_at([0, 0, _BETWEEN_Z], [0, 0, RECEIVER_Z], [0, 1, 0]) @ t().scale([RECEIVER_HALF, RECEIVER_HALF, 1])
        sensor: dict[str, Any] = {"type": "orthographic", "to_world": place}
    elif camera == "pinhole":
        place = t().look_at([0, 0, _BETWEEN_Z], [0, 0, RECEIVER_Z], [0, 1, 0])
        fov = 2 * np.degrees(np.arctan(RECEIVER_HALF / (_BETWEEN_Z - RECEIVER_Z)))
        sensor = {"type": "perspective", "fov": float(fov), "to_world": place}
    else:
        place = t().look_at(list(_BESIDE), [0, 0, RECEIVER_Z], [0, 1, 0])
        sensor = {"type": "perspective", "fov": _FOV_DEG, "to_world": place}
    return mi.load_dict(
        {
            "type": "scene",
            "camera": {
                **sensor,
                "near_clip": 0.01,
                "far_clip": 10.0,
                "film": film,
                "sampler": {"type": "multijitter", "sample_count": 64},
            },
            "light": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": float(np.pi)}},
            "receiver": {
                "type": "rectangle",
                "to_world": t().translate([0, 0, RECEIVER_Z]) @ t().scale(RECEIVER_HALF),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1.0}},
            },
            "occluder": occluder("occluder", mesh.vertices, mesh.faces),
        },
        optimize=False,
    )


def ring(faces: int = 130_000, z: float = 0.0, radius: float = 0.6) -> Mesh:
    """A bumpy ring of about ``faces`` triangles around the z axis at a height z, turned by a few degrees about all axes."""
    across = max(3, round(float(np.sqrt(faces / 3.25))))
    across -= across % 2
    around = max(3, round(faces / (2 * across)))
    mesh = torus(around, across)
    rotated = radius * _turned(mesh.vertices, (7.0, -5.0, 4.0))
    return Mesh((rotated + [0.0, 0.0, z]).astype(np.float32), mesh.faces)


def plane(half: float, z: float, turn_deg: float = 0.0) -> Mesh:
    """A square parallel to the receiver, two triangles, turned about the z axis."""
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return Mesh(_turned(corners, (0.0, 0.0, turn_deg)).astype(np.float32), np.array([[0, 1, 2], [0, 2, 3]], np.uint32))


def tessellated(mesh: Mesh, times: int) -> Mesh:
    """The same surface with each triangle divided into 4 ** times triangles."""
    for _ in range(times):
        mesh = subdivided(mesh)
    return mesh


@dataclass(frozen=True)
class Motion:
    """A rigid motion, or a change of size, with one parameter t, about the middle of the mesh's bounding box.

    Attributes:
        velocity: (3,) world units per unit of t.
        spin: (3,) rotation vector, radians per unit of t.
        growth: relative change of size per unit of t.
    """

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    growth: float = 0.0

    def moved(self, mesh: Mesh, t: float) -> Mesh:
        """The mesh at a value of the parameter."""
        points, middle = self._points(mesh)
        turned = (points - middle) @ _rotation(t * np.array(self.spin)).T * (1 + t * self.growth)
        return Mesh((middle + turned + t * np.array(self.velocity)).astype(np.float32), mesh.faces)

    def rate(self, mesh: Mesh) -> npt.NDArray[np.float64]:
        """(V, 3): derivative of the vertices at t = 0."""
        points, middle = self._points(mesh)
        return np.cross(np.array(self.spin), points - middle) + self.growth * (points - middle) + np.array(self.velocity)

    def step(self, mesh: Mesh, resolution: int, pixels: float = 1.0) -> float:
        """Step h such that between t = -h and h no point of the shadow moves by more than ``pixels``.

        If the shadow does not move at all (motion along the light), the points themselves move by ``pixels`` at most.
        """
        rate = self.rate(mesh)
        across = float(np.linalg.norm(rate[:, :2], axis=1).max())
        speed = across if across > 0 else float(np.linalg.norm(rate, axis=1).max())
        return 0.5 * pixels * 2 * RECEIVER_HALF / resolution / speed

    @property
    def unit(self) -> str:
        """Unit of t in words."""
        return "radian" if any(self.spin) else "relative size" if self.growth else "unit of length"

    @property
    def along_light(self) -> bool:
        """True if all points move along the light, so that the shadow does not change."""
        return self.growth == 0 and not any(self.spin) and not any(self.velocity[:2])

    @staticmethod
    def _points(mesh: Mesh) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        points = mesh.vertices.astype(np.float64)
        return points, 0.5 * (points.min(0) + points.max(0))


#: Motions by which the shadow is differentiated.
MOTIONS: Mapping[str, Motion] = {
    "x": Motion(velocity=(1, 0, 0)),
    "y": Motion(velocity=(0, 1, 0)),
    "z": Motion(velocity=(0, 0, 1)),
    "rotation": Motion(spin=(1 / 3, 2 / 3, 2 / 3)),
    "scale": Motion(growth=1.0),
}


def _turned(points: npt.NDArray[Any], vector_deg: tuple[float, float, float]) -> npt.NDArray[np.float64]:
    """Points (V, 3) turned by a rotation vector in degrees."""
    return points.astype(np.float64) @ _rotation(np.radians(vector_deg)).T


def _rotation(vector: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """(3, 3) matrix of a rotation vector, radians."""
    angle = float(np.linalg.norm(vector))
    return np.array(rotation_matrix(angle, vector)[:3, :3]) if angle else np.eye(3)
