"""Light records, read from Mitsuba emitters. Those that throw a picture or a beam: :mod:`shadowmap_dr.beams`.

``illuminate`` returns what ``emitter.sample_direction`` returns for the same point, without any visibility. All fields that
are not names may carry gradients; replace them with ``dataclasses.replace``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .beams import Beam, Outlined, Projector, beam_of, picture, projector_of, share_inside, towards
from .environments import ENVIRONMENTS, SUNSKY, Environment, SunSky, environment_of
from .errors import ShadowmapError
from .gpu import looked_up
from .shadow.camera import unit
from .traversal import children, parameters, varies

_DEGREE = math.pi / 180.0


@dataclass(frozen=True)
class DirectionalLight:
    """Parallel light. ``direction``: Vector3f, in which light travels, world space, any length but 0; ``irradiance``: colour."""

    name: str
    direction: Any
    irradiance: Any

    def __post_init__(self) -> None:
        # Numbers are looked at on the spot; an array is not waited for, unless it is a constant.
        if dr.is_jit_v(self.direction):
            nowhere = dr.all(self.direction == 0)
            zero = nowhere.state == dr.VarState.Literal and nowhere[0]
        else:
            zero = not any(self.direction)
        if zero:
            raise ShadowmapError(f"light '{self.name}' has the direction (0, 0, 0): give one in which its light travels.")

    def illuminate(self, p_world: Any, active: Any = True) -> tuple[Any, Any]:
        """(wo, weight): unit direction to the light (Vector3f) and its irradiance on a surface that faces it."""
        return -unit(mi.Vector3f(self.direction)), self.irradiance & mi.Bool(active)


@dataclass(frozen=True)
class PointLight:
    """Light from a point. ``position``: Point3f, world space; ``intensity``: colour, W/sr."""

    name: str
    position: Any
    intensity: Any

    def illuminate(self, p_world: Any, active: Any = True) -> tuple[Any, Any]:
        """(wo, weight) with weight = intensity / distance^2."""
        wo, inverse_squared = towards(p_world, self.position)
        return wo, (self.intensity * inverse_squared) & mi.Bool(active)


@dataclass(frozen=True)
class SpotLight(Outlined):
    """Cone of light along the local +z axis.

    to_world      Transform4f
    intensity     colour on the axis, W/sr
    cutoff_angle  Float, degrees, half-angle of the cone beyond which there is no light
    beam_width    Float, degrees, half-angle up to which intensity is full; in between it falls off linearly in the angle
    texture       ``mi.Texture`` over the square that circumscribes the cone, or None
    """

    name: str
    to_world: Any
    intensity: Any
    cutoff_angle: Any
    beam_width: Any
    texture: Any = None

    @property
    def position(self) -> Any:
        """Point3f, world space."""
        matrix = self.to_world.matrix
        return mi.Point3f(matrix[0, 3], matrix[1, 3], matrix[2, 3])

    @property
    def direction(self) -> Any:
        """Vector3f, unit axis of the cone, the direction in which light travels, world space."""
        matrix = self.to_world.matrix
        return dr.normalize(mi.Vector3f(matrix[0, 2], matrix[1, 2], matrix[2, 2]))

    @property
    def rim(self) -> Any:
        """Float, radians: width of the rim in which light falls off from full to none. Attached to both angles."""
        return (self.cutoff_angle - self._full) * _DEGREE

    @property
    def widest(self) -> Any:
        """Float, radians: the rim is never made wider than this."""
        return dr.detach(self.cutoff_angle) * _DEGREE

    def illuminate(self, p_world: Any, active: Any = True, inside: Any = None) -> tuple[Any, Any]:
        """(wo, weight) with weight = intensity * falloff * texture / distance^2.

        ``p_world`` Point3f (N,), world space. ``inside``: the falloff, if known (:func:`~shadowmap_dr.beams.share_inside`), Float
        (N,). Attached to points and all fields.
        """
        wo, inverse_squared = towards(p_world, self.position)
        local = self._local(wo)
        inside = share_inside(self, p_world) if inside is None else inside
        lit = (inside > 0) & mi.Bool(active)
        weight = self.intensity * (inside * inverse_squared)
        if self.texture is not None:
            # Lanes outside the cone may have z = 0, and those within a pixel of it lie off the texture: it may not begin anew.
            scale = 0.5 * dr.rcp(dr.select(lit, local.z, 1.0) * dr.tan(self.cutoff_angle * _DEGREE))
            uv = mi.Point2f(0.5 + local.x * scale, 0.5 + local.y * scale)
            weight = weight * picture(self.texture, dr.clip(uv, 0, 1), lit)
        return wo, weight & lit

    def distances(self, p_world: Any) -> list[Any]:
        """Angle between the middle of the rim and points (Float), positive inside, in radians. Attached."""
        angle = dr.safe_acos(self._local(towards(p_world, self.position)[0]).z)
        return [0.5 * (self.cutoff_angle + self._full) * _DEGREE - angle]

    @property
    def _full(self) -> Any:
        """Angle up to which intensity is full, in degrees: a beam wider than the cone ends where that does."""
        return dr.minimum(self.beam_width, self.cutoff_angle)

    def _local(self, wo: Any) -> Any:
        """Unit direction in the light's own space in which light travels that arrives from ``wo``."""
        return dr.normalize(mi.Vector3f(dr.rcp(mi.Matrix3f(self.to_world.matrix)) @ mi.Vector3f(-wo)))


@dataclass(frozen=True)
class SquareSpot:
    """A spot light as in Worchel and Alexa's code: full intensity, at any distance, in the square that its shadow map covers."""

    light: SpotLight

    def illuminate(self, p_world: Any, active: Any = True) -> tuple[Any, Any]:
        """(wo, weight) with weight = intensity. What lies outside of the square is dark by its visibility."""
        wo, _ = towards(p_world, self.light.position)
        return wo, self.light.intensity & mi.Bool(active)


@dataclass(frozen=True)
class AreaLight:
    """A shape that shines from its outer side.

    ``shape``: its index; ``emitter``: Mitsuba's ``area``; ``textured``: whether its radiance varies over the shape (static);
    ``scale``: factor of radiance.
    """

    name: str
    shape: int
    emitter: Any
    textured: bool = False
    scale: Any = 1.0

    def radiance(self, uv: Any) -> Any:
        """Radiance (colour) of points with these texture coordinates (Point2f). Attached to the emitter."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        si.uv = uv
        si.wi = mi.Vector3f(0, 0, 1)
        return self.seen(si, mi.Bool(True))

    def seen(self, si: Any, active: Any) -> Any:
        """Radiance (colour) of surface points towards ``si.wi``."""
        return looked_up(lambda *where: mi.UnpolarizedSpectrum(self.emitter.eval(*where)), si, active) * self.scale


Light = DirectionalLight | PointLight | SpotLight | Projector | Beam

_LIGHTS = ("DirectionalEmitter", "PointLight", "SpotLight", "Projector")
_BEAMS = ("Rectangle", "Disk")


def objection(emitter: Any) -> str | None:
    """Why a ``mi.Emitter`` is not supported, as the end of a sentence about it; None if it is."""
    kind = emitter.class_name()
    if kind == "AreaLight":
        # Mitsuba's own direct light from one is far too dark: it has no way to sample such a texture.
        attributes = any(part.class_name() == "MeshAttribute" for _, part in children(emitter))
        return "has a mesh_attribute for its radiance, which does not shine: use a bitmap" if attributes else None
    if kind in _LIGHTS or kind in ENVIRONMENTS:
        return None
    if kind == "DirectionalArea":
        shape = emitter.get_shape().class_name()
        return None if shape in _BEAMS else f"shines along the normals of a {shape}: only rectangles and disks may"
    around = emitter.is_environment()
    wanted = "constant, envmap or sunsky" if around else "area, directional, spot or point lights, or projectors"
    return f"is not supported: use {wanted}"


def lights_of(scene: Any) -> tuple[Light, ...]:
    """Records of the lights of a ``mi.Scene`` without extent, of its projectors and beams, in the scene's order.

    Area lights and environments have functions of their own; what is not supported (:func:`objection`) is left out. Names are
    Mitsuba ids; lights without one are called ``light_0``, ... The sun of a sky called ``sky`` is the light ``sky.sun``. Fields
    are attached where the emitters' parameters are.
    """
    return tuple(
        _light_of(emitter, name)
        for name, emitter in named_emitters(scene)
        if emitter.class_name() in (*_LIGHTS, "DirectionalArea", SUNSKY) and objection(emitter) is None
    )


def area_lights_of(scene: Any, shapes: Sequence[Any]) -> tuple[AreaLight, ...]:
    """Records of the area lights of a ``mi.Scene``.

    ``shapes``: its ``mi.Shape`` objects in the order of the soup; the lights of others are left out. Lights have the names of
    their shapes: emitters inside of shapes are all called the same. What is not supported (:func:`objection`) is left out.
    """
    found = []
    numbers: dict[Any, int] = {}
    for name, emitter in named_emitters(scene):
        if emitter.class_name() == "AreaLight" and objection(emitter) is None:
            shape = emitter.get_shape()
            if not numbers:
                numbers = {other: len(shapes) - 1 - k for k, other in enumerate(reversed(shapes))}  # the first of equal ones
            index = numbers.get(shape)
            textures = [part for _, part in children(emitter) if isinstance(part, mi.Texture)]
            if index is not None:
                textured = any(varies(texture) for texture in textures)
                found.append(AreaLight(shape.id() or name, index, emitter, textured))
    return tuple(found)


def environments_of(scene: Any) -> tuple[Environment, ...]:
    """Records of the ``constant``, ``envmap`` and ``sunsky`` emitters of a ``mi.Scene`` (at most one)."""
    found = ((name, emitter) for name, emitter in named_emitters(scene) if emitter.class_name() in ENVIRONMENTS)
    return tuple(environment_of(emitter, name) for name, emitter in found)


def named_emitters(scene: Any) -> list[tuple[str, Any]]:
    """(name, ``mi.Emitter``) of all emitters of a ``mi.Scene``."""
    return [(emitter.id() or f"light_{i}", emitter) for i, emitter in enumerate(scene.emitters())]


def _light_of(emitter: Any, name: str) -> Light:
    if emitter.class_name() == SUNSKY:
        return DirectionalLight(f"{name}.sun", *SunSky(name, emitter).sun())
    kind, values, parts = emitter.class_name(), parameters(emitter), dict(children(emitter))
    if kind == "DirectionalEmitter":
        matrix = values["to_world"].matrix
        direction = mi.Vector3f(matrix[0, 2], matrix[1, 2], matrix[2, 2])
        length = dr.norm(direction)  # Mitsuba's becomes brighter with a transformation that scales
        return DirectionalLight(name, direction / length, colour_of(parts["irradiance"]) * length)
    if kind == "PointLight":
        return PointLight(name, mi.Point3f(values["position"]), colour_of(parts["intensity"]))
    if kind == "Projector":
        return projector_of(emitter, name, values, parts["irradiance"])
    if kind == "DirectionalArea":
        return beam_of(emitter, name, parameters(emitter.get_shape())["to_world"], parts["radiance"])
    return SpotLight(
        name=name,
        to_world=values["to_world"],
        intensity=colour_of(parts["intensity"]),
        cutoff_angle=mi.Float(values["cutoff_angle"]),
        beam_width=mi.Float(values["beam_width"]),
        texture=parts.get("texture"),
    )


def colour_of(texture: Any) -> Any:
    """The colour of a spectrum that does not vary over space, as ``mi.UnpolarizedSpectrum``."""
    return texture.eval(dr.zeros(mi.SurfaceInteraction3f))
