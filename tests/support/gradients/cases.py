"""Scenes of the gradient tests, and the parameters that move."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from . import scenes
from .changes import (
    brighter,
    controlled,
    increased,
    moved,
    one_corner,
    repainted,
    scaled,
    stretched,
    swung,
    swung_locally,
    translated,
    turned,
    waved,
)
from .model import Case, Parameter
from .soft_cases import SOFT_CASES, SOFT_TRACED

CENTRE = (0.0, 0.85, 0.0)


def without(parameters: dict[str, Parameter], *names: str) -> dict[str, Parameter]:
    return {name: parameter for name, parameter in parameters.items() if name not in names}


CASTER = {
    "caster_translation": Parameter("object.vertex_positions", translated(1, 0, 0), 0.010),
    "caster_rise": Parameter("object.vertex_positions", translated(0, 1, 0), 0.010),
    "caster_rotation": Parameter("object.vertex_positions", turned((0.3, 1, 0.2), CENTRE), 0.015),
    "caster_scale": Parameter("object.vertex_positions", scaled(CENTRE), 0.012),
    "caster_deformation": Parameter("object.vertex_positions", waved(3.0), 0.010),
}
SPOT = {
    "spot_position": Parameter("light.to_world", moved(1, 0, 0), 0.025),
    "spot_direction": Parameter("light.to_world", swung_locally((1, 0.5, 0)), 0.004),
    "spot_cone": Parameter("light.cutoff_angle", increased(), 0.25),
    "spot_beam": Parameter("light.beam_width", increased(), 0.25),
    "spot_intensity": Parameter("light.intensity.value", brighter, 0.05),
}
CAMERA = {
    "camera_shift": Parameter("camera.to_world", moved(1, 0.2, 0), 0.012),
    "camera_turn": Parameter("camera.to_world", swung_locally((0.3, 1, 0.5)), 0.002),
}
SUN = {
    "light_direction": Parameter("light.to_world", swung((1, 0, 0)), 0.009),
    "irradiance": Parameter("light.irradiance.value", brighter, 0.05),
}
GREY = {
    "floor_reflectance": Parameter("floor.bsdf.reflectance.value", brighter, 0.05),
    "object_reflectance": Parameter("object.bsdf.reflectance.value", brighter, 0.05),
}


def crossing_boxes() -> Any:
    """Two boxes of different colours in one another, and both in the floor: no edge where they meet."""
    T = mi.ScalarTransform4f
    first = T().translate([-0.25, 0.35, 0]) @ T().rotate([0, 1, 0], 25) @ T().rotate([1, 0, 0], 35) @ T().scale(0.5)
    second = T().translate([0.35, 0.3, 0.2]) @ T().rotate([0.2, 1, 0.3], 60) @ T().scale(0.45)
    return scenes.scene(
        light=scenes.sun(),
        object=scenes.box(scenes.diffuse(0.8, 0.2, 0.1), first),
        other=scenes.box(scenes.diffuse(0.1, 0.3, 0.8), second),
    )


def crossing_meshes() -> Any:
    """A smooth ball of triangles below a pixel in a cow, both in the floor."""
    ball = scenes.mesh("other", *scenes.ball(5, 0.45, (0.35, 0.6, 0.3)), scenes.diffuse(0.1, 0.3, 0.8), normals=True)
    return scenes.scene(light=scenes.sun(), object=scenes.cow(scenes.diffuse(0.8, 0.2, 0.1)), other=ball)


def textured_spot() -> Any:
    floor = scenes.floor({"type": "diffuse", "reflectance": scenes.checker()})
    return scenes.scene(light=scenes.spot(), object=scenes.cow(), floor=floor)


def standing_box() -> Any:
    """A box whose lower face lies in the floor's plane: where it stands, neither of its edges is in front of the floor."""
    T = mi.ScalarTransform4f
    place = T().translate([0, 0.4, 0]) @ T().rotate([0, 1, 0], 25) @ T().scale(0.4)
    return scenes.scene(light=scenes.sun(), object=scenes.box(scenes.diffuse(0.8, 0.2, 0.1), place))


def upright(key: str) -> dict[str, Parameter]:
    """Ways to move what stands on the floor that leave it there."""
    return {
        "caster_translation": Parameter(key, translated(1, 0, 0.4), 0.010),
        "caster_rotation": Parameter(key, turned((0, 1, 0), (0, 0, 0)), 0.015),
        "caster_scale": Parameter(key, scaled((0, 0, 0)), 0.012),
    }


def two_lights() -> Any:
    floor = scenes.floor({"type": "diffuse", "reflectance": scenes.checker(4, 4)})
    ball = scenes.mesh("ball", *scenes.ball(2), normals=True)
    return scenes.scene(floor=floor, ball=ball, sun=scenes.sun(), spot=scenes.spot())


def glossy() -> Any:
    metal = {"type": "roughconductor", "alpha": 0.3}
    return scenes.scene(
        light=scenes.spot(),
        floor=scenes.floor({"type": "principled", "base_color": scenes.checker(1), "roughness": 0.4}),
        object=scenes.cow({"type": "roughplastic", "diffuse_reflectance": 0.4, "alpha": 0.25}, face_normals=False),
        other=scenes.mesh("other", *scenes.ball(3, 0.3, (-0.8, 0.3, 0.4)), metal, normals=True),
    )


def near_plane() -> Any:
    """A wall and a bar that pass the camera on their way behind it, and what they and their shadows do in front of it."""
    wall = np.array([[-0.9, 0, -1.5], [-0.9, 1.6, -1.5], [-0.5, 5.5, 6.0], [-0.6, 0.0, 6.0]])
    bar = np.array([[0.9, 0.4, -1.2], [1.1, 0.5, -1.2], [0.4, 4.6, 6.0], [0.1, 4.4, 6.0]])
    quad = np.array([[0, 1, 2], [0, 2, 3]])
    two = lambda *c: {"type": "twosided", "bsdf": scenes.diffuse(*c)}  # noqa: E731
    return scenes.scene(
        light=scenes.sun(),
        floor=scenes.floor(scenes.diffuse(0.5)),
        object=scenes.mesh("object", wall, quad, two(0.7, 0.3, 0.2)),
        other=scenes.mesh("other", bar, quad, two(0.2, 0.4, 0.7)),
    )


def shapes() -> Any:
    """A sphere, and an open cylinder and a disk that are seen from both sides."""
    two = lambda *c: {"type": "twosided", "bsdf": scenes.diffuse(*c)}  # noqa: E731
    T = mi.ScalarTransform4f
    return scenes.scene(
        light=scenes.sun(),
        ball={"type": "sphere", "center": [-0.45, 0.6, 0.2], "radius": 0.35, "bsdf": scenes.diffuse(0.7, 0.3, 0.2)},
        tube={"type": "cylinder", "p0": [0.1, 0.35, -0.6], "p1": [0.6, 0.9, -0.1], "radius": 0.18, "bsdf": two(0.2, 0.5, 0.7)},
        plate={"type": "disk", "to_world": T().look_at([0.4, 0.7, 0.7], [1, 3, 1.5], [0, 0, 1]) @ T().scale(0.3),
               "bsdf": two(0.3, 0.6, 0.3)},
    )  # fmt: skip


def curves() -> Any:
    """A bent wire that tapers to points, each of three control points, and a zigzag of cones and spheres.

    To Mitsuba the walls of an open end have an outside only: its shadows would differ there.
    """
    start, end = (-1.0, 0.3, 0.6, 0.0), (0.6, 0.5, 0.2, 0.0)
    wire = [*3 * [start], (-0.7, 0.5, 0.3, 0.1), (-0.3, 1.0, 0.5, 0.12), (0.3, 0.6, 0.6, 0.08), *3 * [end]]
    stick = [(-0.9, 0.5, -0.5, 0.12), (-0.3, 0.8, -0.6, 0.06), (0.1, 0.4, -0.4, 0.14), (0.7, 0.9, -0.3, 0.1)]
    return scenes.scene(
        light=scenes.sun(),
        wire=scenes.curve("bsplinecurve", "wire", wire, scenes.diffuse(0.7, 0.3, 0.2)),
        stick=scenes.curve("linearcurve", "stick", stick, scenes.diffuse(0.2, 0.5, 0.7)),
    )


CASES = (
    Case(
        "sun_box",
        lambda: scenes.scene(light=scenes.sun(), object=scenes.box()),
        {**SUN, **CASTER, **CAMERA, **GREY,
         "corner": Parameter("object.vertex_positions", one_corner(0, 1, 0.5, 0.3), 0.008),
         "field_of_view": Parameter("camera.x_fov", increased(), 0.2),
         "floor_height": Parameter("floor.to_world", moved(0, 1, 0), 0.01)},
    ),
    Case("sun_cow", lambda: scenes.scene(light=scenes.sun(), object=scenes.cow()), {**SUN, **CASTER, **CAMERA},
         {"shadow_map_resolution": 1024}),
    Case(
        "spot_box",
        lambda: scenes.scene(light=scenes.spot(), object=scenes.box()),
        {"spot_position": SPOT["spot_position"], "spot_direction": SPOT["spot_direction"], **CASTER},
    ),
    Case("spot_cow", textured_spot, {**SPOT, "texture": Parameter("floor.bsdf.reflectance.data", repainted(2), 0.05), **CASTER}),
    Case(
        "point_box",
        lambda: scenes.scene(light=scenes.bulb(), object=scenes.box()),
        {"point_position": Parameter("light.position", translated(1, 0.3, 0.2), 0.015),
         "point_intensity": Parameter("light.intensity.value", brighter, 0.05), **CASTER},
    ),
    Case(
        "orthographic_cow",
        lambda: scenes.scene(light=scenes.sun(), object=scenes.cow(), camera=scenes.camera(kind="orthographic")),
        {**SUN, **CASTER, **CAMERA},
        {"shadow_map_resolution": 1024},
    ),
    Case(
        "glossy", glossy,
        {"roughness": Parameter("floor.bsdf.roughness.value", increased(), 0.02),
         "base_color": Parameter("floor.bsdf.base_color.data", repainted(3), 0.1),
         "metal": Parameter("other.bsdf.alpha.value", increased(), 0.02),
         "spot_position": SPOT["spot_position"], **CASTER, **CAMERA},
    ),
    Case("two_lights", two_lights, {
        "ball": Parameter("ball.vertex_positions", translated(1, 0.2, 0.5), 0.01),
        "ball_reflectance": Parameter("ball.bsdf.reflectance.value", brighter, 0.05),
        "floor": Parameter("floor.to_world", moved(0, 1, 0), 0.01),
        "texture": Parameter("floor.bsdf.reflectance.data", brighter, 0.05),
        "sun_direction": Parameter("sun.to_world", swung((1, 0, 0.5)), 0.009),
        "sun_irradiance": Parameter("sun.irradiance.value", brighter, 0.05),
        "spot_position": Parameter("spot.to_world", moved(1, 0, 0), 0.025),
        "spot_intensity": Parameter("spot.intensity.value", brighter, 0.05),
        **CAMERA}),
    Case("crossing_boxes", crossing_boxes, {**SUN, **CASTER, **CAMERA}),
    Case("crossing_meshes", crossing_meshes, {**SUN, **CASTER, **CAMERA}, {"shadow_map_resolution": 1024}),
    Case("standing_box", standing_box, {**SUN, **CAMERA, **upright("object.vertex_positions")},
         {"shadow_map_resolution": 1024}),
    Case("near_plane", near_plane, {
        **SUN, **CAMERA,
        # Shorter than elsewhere: what the camera passes moves by more pixels.
        "camera_shift": Parameter("camera.to_world", moved(1, 0.2, 0), 0.006),
        "bar_translation": Parameter("other.vertex_positions", translated(1, 0, 0), 0.008),
        "bar_vertex": Parameter("other.vertex_positions", one_corner(0, 1, 0.2, 0), 0.015),
        "wall_vertex": Parameter("object.vertex_positions", one_corner(2, 1, 0.2, 0), 0.02)}),
    Case("shapes", shapes, {
        **SUN, **CAMERA,
        "sphere_translation": Parameter("ball.to_world", moved(1, 0, 0), 0.010),
        "sphere_scale": Parameter("ball.to_world", stretched(1, 1, 1), 0.020),
        "cylinder_turn": Parameter("tube.to_world", swung((1, 0.3, 0), (0.35, 0.6, -0.35)), 0.020),
        "cylinder_radius": Parameter("tube.to_world", stretched(1, 1, 0), 0.040),
        "disk_rise": Parameter("plate.to_world", moved(0, 1, 0), 0.010),
        "disk_turn": Parameter("plate.to_world", swung_locally((0.4, 1, 0)), 0.020)}),
    Case("curves", curves, {
        "wire_translation": Parameter("wire.control_points", controlled(1, 0, 0), 0.010),
        "wire_point": Parameter("wire.control_points", controlled(0.3, 0.5, 1, only=4), 0.015),
        "wire_thickness": Parameter("wire.control_points", controlled(0, 0, 0, 1), 0.008),
        "stick_translation": Parameter("stick.control_points", controlled(0.5, 1, 0), 0.010),
        "stick_point": Parameter("stick.control_points", controlled(0, 0.5, 1, only=1), 0.010),
        "stick_thickness": Parameter("stick.control_points", controlled(0, 0, 0, 1), 0.008),
        **SUN, **CAMERA}, {"shadow_map_resolution": 1024}),
    Case("fine", lambda: scenes.scene(light=scenes.sun(), object=scenes.mesh("object", *scenes.ball(6))),
         {**SUN, **without(CASTER, "caster_rotation"), **CAMERA}),
    # One face is seen from the side, so that its triangles are thinner than a pixel: those that pixels see seldom touch.
    Case("fine_box", lambda: scenes.scene(light=scenes.sun(), object=scenes.mesh("object", *scenes.block(3))),
         {**CASTER, **CAMERA}),
    *SOFT_CASES,
)  # fmt: skip
CASES_BY_NAME = {case.name: case for case in CASES}

# Parameters whose derivative images are compared with path tracing: those that move the boundary of a shadow or a surface.
TRACED = {
    "sun_box": ("light_direction", "caster_translation", "caster_rotation"),
    "sun_cow": ("light_direction", "caster_translation", "caster_rotation"),
    "spot_box": ("spot_position", "spot_direction"),
    "spot_cow": ("spot_position", "spot_cone"),
    "point_box": ("point_position", "caster_translation"),
    "orthographic_cow": ("light_direction", "caster_translation", "camera_shift"),
    "crossing_boxes": ("caster_rise", "camera_shift"),
    "standing_box": ("caster_translation", "camera_turn"),
    "near_plane": ("light_direction", "bar_translation", "camera_turn"),
    "fine": ("caster_translation", "caster_scale"),
    "shapes": ("sphere_translation",),
    "curves": ("wire_point", "wire_thickness", "stick_point", "stick_thickness"),
    **SOFT_TRACED,
}
