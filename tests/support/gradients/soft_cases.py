"""Scenes under area lights and skies, and what moves in them. Small images: each pixel sees all samples of its lights."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from . import scenes
from .changes import brighter, lightened, moved, one_corner, swung, translated, turned
from .model import Case, Parameter

SIZE = 64
OPTIONS = {"area_light_samples": 16, "environment_light_samples": 128}
# Twice the steps of the larger images: boundaries move by as many pixels.
CASTER = {
    "caster_translation": Parameter("object.vertex_positions", translated(1, 0, 0), 0.02),
    "caster_rise": Parameter("object.vertex_positions", translated(0, 1, 0), 0.02),
}
RECEIVER = {"floor_height": Parameter("floor.to_world", moved(0, 1, 0), 0.02)}
CAMERA = {"camera_shift": Parameter("camera.to_world", moved(1, 0.2, 0), 0.024)}


def panel(emitter: Any = None) -> dict[str, Any]:
    """A rectangle of side 0.8 above the scene, in view."""
    T = mi.ScalarTransform4f
    place = T().look_at([0.3, 2.2, 0.2], [-0.1, 0, -0.1], [0, 0, 1]) @ T().scale(0.4)
    return {"type": "rectangle", "to_world": place, "emitter": emitter or area(6.0)}


def area(*radiance: float) -> dict[str, Any]:
    return {"type": "area", "radiance": {"type": "rgb", "value": list(radiance) if len(radiance) > 1 else radiance[0]}}


def painted() -> dict[str, Any]:
    pixels = np.random.default_rng(4).uniform(0.5, 12, (4, 4, 3)).astype(np.float32)
    return {"type": "area", "radiance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}


def low_camera() -> dict[str, Any]:
    """Sees the lamp, too."""
    return scenes.camera(SIZE, at=(0, 2.2, 5.2), to=(0, 1.0, 0), fov=34)


def under(light: Any, camera: Any = None, **more: Any) -> Any:
    return scenes.scene(SIZE, camera=camera or scenes.camera(SIZE), light=light, object=scenes.box(), **more)


def globe() -> dict[str, Any]:
    return {"type": "sphere", "center": [0.9, 1.9, 0.5], "radius": 0.25, "emitter": area(9.0, 8.0, 6.0)}


def crystal() -> Any:
    """A cube that shines, tilted. Without vertex normals: Mitsuba takes the emitter's cosine from these, not from the faces."""
    T = mi.ScalarTransform4f
    place = np.asarray((T().translate([0.8, 2.0, 0.4]) @ T().rotate([1, 0.4, 0.2], 40) @ T().scale(0.22)).matrix)
    solid = trimesh.creation.box((2, 2, 2))
    return scenes.mesh("lamp", np.asarray(solid.vertices) @ place[:3, :3].T + place[:3, 3], solid.faces, emitter=area(8.0))


def sky_map() -> dict[str, Any]:
    """Bright above, dim below, and a large sun."""
    rows = 16
    theta = (np.arange(rows) + 0.5)[:, None] / rows * np.pi
    phi = (np.arange(2 * rows) + 0.5)[None] / (2 * rows) * 2 * np.pi
    sky = 0.1 + 0.4 * np.maximum(np.cos(theta), 0) + 12 * np.exp(-((theta - 0.7) ** 2 + (phi - 2.0) ** 2) / 0.08)
    pixels = (sky[..., None] * np.array([1.0, 0.9, 0.7])).astype(np.float32)
    return {"type": "envmap", "bitmap": mi.Bitmap(pixels)}


SOFT_CASES = (
    Case("panel_box", lambda: under(panel()), {
        **CASTER, **RECEIVER, **CAMERA,
        "caster_rotation": Parameter("object.vertex_positions", turned((0.3, 1, 0.2), (0, 0.85, 0)), 0.03),
        "lamp_translation": Parameter("light.to_world", moved(1, 0, 0), 0.04),
        "lamp_rise": Parameter("light.to_world", moved(0, 1, 0), 0.04),
        "lamp_turn": Parameter("light.to_world", swung((1, 0, 0.4), (0.3, 2.2, 0.2)), 0.05),
        "radiance": Parameter("light.emitter.radiance.value", brighter, 0.05)}, OPTIONS),
    Case("painted_box", lambda: under(panel(painted())), {
        "texture": Parameter("light.emitter.radiance.data", lightened(1, 3, 1, 3), 0.2),
        "lamp_translation": Parameter("light.to_world", moved(0.4, 0, 1), 0.04)}, OPTIONS),
    Case("globe_box", lambda: under(globe()), {
        **CASTER,
        "lamp_translation": Parameter("light.to_world", moved(1, 0, 0.3), 0.012),
        "radiance": Parameter("light.emitter.radiance.value", brighter, 0.05)}, OPTIONS),
    # In view: its own outline moves, too.
    Case("crystal_box", lambda: under(crystal(), low_camera()), {
        "lamp_translation": Parameter("light.vertex_positions", translated(1, 0.3, 0), 0.02),
        "lamp_vertex": Parameter("light.vertex_positions", one_corner(4, 0.4, 1, 0.2), 0.03),
        **CAMERA}, OPTIONS),
    # Out of view: parts of it shadow others, which only its light tells.
    Case("shaded_lamp", lambda: scenes.scene(SIZE, light=scenes.shaded_lamp((0.2, 2.6, -1.6), 20.0)), {
        "plate_shift": Parameter("light.vertex_positions", translated(0.3, -1, 0, first=8), 0.04)},
        {"area_light_samples": 256, "soft_map_resolution": 64}, 4),
    Case("constant_box", lambda: under(None, sky={"type": "constant", "radiance": 0.8}), {
        **CASTER, **RECEIVER,
        # Of which there are enough that their hard shadows overlap on the floor, far below the box.
        "radiance": Parameter("sky.radiance.value", brighter, 0.05)}, {"environment_light_samples": 512}, 4),
    Case("sky_box", lambda: under(None, sky=sky_map()), {
        **CASTER, **RECEIVER, **CAMERA,
        "sky_turn": Parameter("sky.to_world", swung((0, 1, 0)), 0.03),
        "sky_pixels": Parameter("sky.data", lightened(2, 6, 8, 13), 0.3)}, OPTIONS),
    # Against all directions at once, each of whose shadows has an edge, a floor moves: enough directions for edges to overlap.
    Case("sky_floor", lambda: under(None, sky=sky_map()), RECEIVER, {"environment_light_samples": 512}, 4),
)  # fmt: skip

# Compared with stored path-traced differences.
SOFT_TRACED = {
    "panel_box": ("caster_translation", "floor_height", "lamp_translation", "lamp_rise", "radiance", "camera_shift"),
    "painted_box": ("texture",),
    "globe_box": ("caster_translation", "lamp_translation"),
    "crystal_box": ("lamp_translation", "lamp_vertex"),
    "shaded_lamp": ("plate_shift",),
    "constant_box": ("floor_height", "caster_translation"),
    "sky_box": ("caster_translation", "sky_turn", "sky_pixels", "camera_shift"),
    "sky_floor": ("floor_height",),
}
