"""Lights of uniform colour: their light is the colour times the light of a white copy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mitsuba as mi

from ..jit.types import Bool, Color3f
from ..scene.lights.area import AreaLight
from ..scene.lights.punctual import DirectionalLight, PointLight, SpotLight
from ..scene.lights.read import Light, colour_of
from ..scene.mitsuba_objects import varies


def colour_of_light(light: Light | AreaLight) -> Color3f | None:
    """Irradiance, intensity or radiance (colour) of a light of uniform colour, None of others. Attached."""
    if isinstance(light, AreaLight):
        return None if light.textured else light.radiance(mi.Point2f(0))
    if isinstance(light, DirectionalLight):
        return light.irradiance
    plain = untextured(light)
    return plain.intensity if isinstance(plain, PointLight | SpotLight) else None


def white_area_light(light: AreaLight) -> AreaLight:
    """The same light in white: :func:`colour_of_light` is 1."""
    return replace(light, emitter=_White(), scale=1.0)


def white_light(light: Light) -> Light:
    """The same light in white: :func:`colour_of_light` is 1."""
    one = mi.UnpolarizedSpectrum(1)
    if isinstance(light, DirectionalLight):
        return replace(light, irradiance=one)
    plain = untextured(light)
    assert isinstance(plain, PointLight | SpotLight), "lights without a colour have no white twin"
    return replace(plain, intensity=one)


def untextured(light: Light) -> DirectionalLight | PointLight | SpotLight | None:
    """The same light without a texture if its colour is uniform, else None. Mitsuba's spot lights always have a texture."""
    if not isinstance(light, SpotLight):
        return light if isinstance(light, DirectionalLight | PointLight) else None
    if light.texture is None or varies(light.texture):
        return light if light.texture is None else None
    return replace(light, intensity=light.intensity * colour_of(light.texture), texture=None)


def colours_of(lights: Sequence[Light | AreaLight]) -> list[Color3f] | None:
    """:func:`colour_of_light` of all lights; None if the colour of any is not uniform."""
    found = [colour_of_light(light) for light in lights]
    return None if any(colour is None for colour in found) else [mi.UnpolarizedSpectrum(colour) for colour in found]


class _White:
    """An emitter with Mitsuba's interface and a radiance of 1."""

    def eval(self, si: mi.SurfaceInteraction3f, active: Bool | bool = True) -> Color3f:
        return mi.UnpolarizedSpectrum(1) & mi.Bool(active)
