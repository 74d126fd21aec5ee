"""Light records, read from Mitsuba's emitters.

``illuminate`` agrees with ``emitter.sample_direction`` at the same point, without visibility. All fields but names may carry
gradients; replace them with ``dataclasses.replace``.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError
from ...jit.types import Color3f
from ..mitsuba_objects import children, parameters, varies
from ..naming import names_of
from ..transforms import axis
from .area import AreaLight
from .environment import ENVIRONMENTS, SUNSKY, Environment, SunSky, environment_of
from .projected import Beam, Projector, beam_of, projector_of
from .punctual import DirectionalLight, PointLight, SpotLight

Light = DirectionalLight | PointLight | SpotLight | Projector | Beam

_LIGHTS = ("DirectionalEmitter", "PointLight", "SpotLight", "Projector")
_BEAMS = ("Rectangle", "Disk")


def unsupported_reason(emitter: mi.Emitter) -> str | None:
    """Reason for which a ``mi.Emitter`` is not supported, as the end of a sentence about it; None for a supported emitter."""
    kind = emitter.class_name()
    if kind == "AreaLight":
        # Mitsuba's own direct light from such an emitter is far too dark: Mitsuba cannot sample a mesh attribute.
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


def lights_of(scene: mi.Scene) -> tuple[Light, ...]:
    """Records of a ``mi.Scene``'s lights without extent, projectors and beams, in the scene's order.

    Area lights and environments have functions of their own. Unsupported lights (:func:`unsupported_reason`) are left out.
    Names are Mitsuba ids; lights without one are called ``light_0``, ... The sun of a sky called ``sky`` is the light
    ``sky.sun``. Fields are attached where the emitters' parameters are.
    """
    return tuple(
        _light_of(emitter, name)
        for name, emitter in named_emitters(scene)
        if emitter.class_name() in (*_LIGHTS, "DirectionalArea", SUNSKY) and unsupported_reason(emitter) is None
    )


def check_directions(scene: mi.Scene) -> None:
    """ShadowmapError for a directional light without a direction. Mitsuba makes NaN of a direction of (0, 0, 0)."""
    for name, emitter in named_emitters(scene):
        if emitter.class_name() == "DirectionalEmitter":
            direction = dr.detach(axis(parameters(emitter)["to_world"], 2)).numpy()
            with np.errstate(over="ignore"):
                square = float(np.square(direction, dtype=np.float32).sum())
            if not 0 < square < np.inf:
                raise ShadowmapError(
                    f"light '{name}' has no direction: its direction or to_world is zero, too small, too large or not "
                    "finite; give three numbers, not all of them zero."
                )


def area_lights_of(scene: mi.Scene, shapes: Sequence[mi.Shape]) -> tuple[AreaLight, ...]:
    """Records of the area lights of a ``mi.Scene``.

    ``shapes``: its ``mi.Shape`` objects in the order of the soup. Lights of other shapes and unsupported lights
    (:func:`unsupported_reason`) are left out. Lights have the names of their shapes, since emitters inside shapes all have the
    same name.
    """
    found = []
    numbers: dict[mi.Shape, int] = {}
    for name, emitter in named_emitters(scene):
        if emitter.class_name() == "AreaLight" and unsupported_reason(emitter) is None:
            shape = emitter.get_shape()
            if not numbers:
                numbers = {other: len(shapes) - 1 - k for k, other in enumerate(reversed(shapes))}  # the first of equal ones
            index = numbers.get(shape)
            textures = [part for _, part in children(emitter) if isinstance(part, mi.Texture)]
            if index is not None:
                textured = any(varies(texture) for texture in textures)
                found.append(AreaLight(shape.id() or name, index, emitter, textured))
    return tuple(found)


def environments_of(scene: mi.Scene) -> tuple[Environment, ...]:
    """Records of the ``constant``, ``envmap`` and ``sunsky`` emitters of a ``mi.Scene`` (at most one)."""
    found = ((name, emitter) for name, emitter in named_emitters(scene) if emitter.class_name() in ENVIRONMENTS)
    return tuple(environment_of(emitter, name) for name, emitter in found)


def named_emitters(scene: mi.Scene) -> list[tuple[str, mi.Emitter]]:
    """(name, ``mi.Emitter``) of all emitters of a ``mi.Scene``."""
    emitters = scene.emitters()
    return list(zip(names_of(emitters, "light"), emitters, strict=True))


def _light_of(emitter: mi.Emitter, name: str) -> Light:
    if emitter.class_name() == SUNSKY:
        return DirectionalLight(f"{name}.sun", *SunSky(name, emitter).sun())
    kind, values, parts = emitter.class_name(), parameters(emitter), dict(children(emitter))
    if kind == "DirectionalEmitter":
        direction = axis(values["to_world"], 2)
        length = dr.norm(direction)  # in Mitsuba a transformation that scales makes the light brighter
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


def colour_of(texture: mi.Texture) -> Color3f:
    """The colour of a spectrum that does not vary over space, as ``mi.UnpolarizedSpectrum``."""
    return texture.eval(dr.zeros(mi.SurfaceInteraction3f))
