"""Which references are stored, and the simple scenes whose derivative images are.

`CASES` names the derivative images: each is the derivative of `build(parameter)` at zero. All scenes have the shapes `floor`
and `object`, the emitter `light` and the sensor `camera`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from shadowmap_dr import assets

FOLDER = Path(__file__).parent
RESOLUTION = 128
SCENES = ("pose", "gallery", "still_life", "meadow", "pavilion")

DIRECTION = np.array([-0.55, -1.0, -0.30])
SPOT_ORIGIN, SPOT_TARGET = np.array([1.6, 3.2, 1.2]), np.array([-0.3, 0.0, -0.2])


@dataclass(frozen=True)
class Case:
    """A derivative image.

    Attributes:
        build: Scene for a parameter value; zero is where the derivative is taken.
        step: Half the distance of the two renderings, such that shadow boundaries move by 0.5 to 1 pixel in between.
        parameter: What the parameter is.
    """

    name: str
    build: Callable[[float], mi.Scene]
    step: float
    parameter: str

    @property
    def path(self) -> Path:
        return FOLDER / f"derivative_{self.name}.exr"


def rotated_direction(angle: float) -> np.ndarray:
    """The light's direction turned by an angle (radians) about the world's x axis."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) @ DIRECTION


def directional_light(angle: float = 0.0) -> dict:
    return {"type": "directional", "direction": rotated_direction(angle).tolist(), "irradiance": 3.0}


def spot_light(shift: float = 0.0) -> dict:
    """A spot light moved along the world's x axis without turning."""
    T = mi.ScalarTransform4f
    base = T().look_at(SPOT_ORIGIN.tolist(), SPOT_TARGET.tolist(), [0, 1, 0])
    return {"type": "spot", "to_world": T().translate([shift, 0, 0]) @ base, "intensity": 30.0,
            "cutoff_angle": 28.0, "beam_width": 22.0}


def caster(name: str, shift: float = 0.0) -> dict:
    """A box or a cow above the floor, moved along the world's x axis."""
    T = mi.ScalarTransform4f
    place = T().translate([shift, 0.85, 0])
    diffuse = {"type": "diffuse", "reflectance": 0.6}
    if name == "box":
        pose = place @ T().rotate([0, 1, 0], 25) @ T().rotate([1, 0, 0], 35) @ T().scale(0.38)
        return {"type": "cube", "to_world": pose, "bsdf": diffuse}
    pose = place @ T().rotate([0, 1, 0], 60) @ T().scale(0.65)
    return {"type": "ply", "filename": str(assets.mesh(name)), "face_normals": True, "to_world": pose, "bsdf": diffuse}


def scene(light: dict, object_: dict, resolution: int = RESOLUTION) -> mi.Scene:
    """A floor, a caster and a light, seen from above at an angle."""
    T = mi.ScalarTransform4f
    return mi.load_dict({
        "type": "scene",
        "camera": {
            "type": "perspective", "fov": 32,
            "to_world": T().look_at([0, 4.2, 3.2], [-0.2, 0.2, -0.1], [0, 1, 0]),
            "sampler": {"type": "multijitter", "sample_count": 64},
            "film": {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"},
                     "pixel_format": "rgb", "component_format": "float32", "sample_border": True},
        },
        "light": light,
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90) @ T().scale(4),
                  "bsdf": {"type": "diffuse", "reflectance": 0.5}},
        "object": object_,
    }, optimize=False)


CASES = (
    Case("light_direction_box", lambda a: scene(directional_light(a), caster("box")), 0.009, "rotation about x, radians"),
    Case("light_direction_cow", lambda a: scene(directional_light(a), caster("spot")), 0.009, "rotation about x, radians"),
    Case("spot_position_box", lambda t: scene(spot_light(t), caster("box")), 0.025, "translation along x"),
    Case("spot_position_cow", lambda t: scene(spot_light(t), caster("spot")), 0.025, "translation along x"),
    Case("caster_translation_box", lambda t: scene(directional_light(), caster("box", t)), 0.010, "translation along x"),
    Case("caster_translation_cow", lambda t: scene(directional_light(), caster("spot", t)), 0.010, "translation along x"),
)
