"""Lights whose radiance is the same all over: a colour times what the same light does in white."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mitsuba as mi

from ..scene.lights.area import AreaLight
from ..scene.lights.punctual import DirectionalLight, PointLight, SpotLight
from ..scene.lights.read import Light, colour_of
from ..scene.mitsuba_objects import varies


def colour_of_light(light: Light | AreaLight) -> Any:
    """Irradiance, intensity or radiance (colour) of a light that is the same all over, None of others. Attached."""
    if isinstance(light, AreaLight):
        return None if light.textured else light.radiance(mi.Point2f(0))
    if isinstance(light, DirectionalLight):
        return light.irradiance
    plain = untextured(light)
    return None if plain is None else plain.intensity


def white_light(light: Light | AreaLight) -> Any:
    """The same light in white: :func:`colour_of_light` is 1."""
    if isinstance(light, AreaLight):
        return replace(light, emitter=_White(), scale=1.0)
    one = mi.UnpolarizedSpectrum(1)
    return replace(light, irradiance=one) if isinstance(light, DirectionalLight) else replace(untextured(light), intensity=one)


def untextured(light: Light) -> Any:
    """The same light without a texture, of the same colour all over, or None. A spot light always has one in Mitsuba."""
    if not isinstance(light, SpotLight):
        return light if isinstance(light, DirectionalLight | PointLight) else None
    if light.texture is None or varies(light.texture):
        return light if light.texture is None else None
    return replace(light, intensity=light.intensity * colour_of(light.texture), texture=None)


def colours_of(lights: Sequence[Light | AreaLight]) -> list[Any] | None:
    """:func:`colour_of_light` of all lights, None if one of them has none."""
    found = [colour_of_light(light) for light in lights]
    return None if any(colour is None for colour in found) else [mi.UnpolarizedSpectrum(colour) for colour in found]


class _White:
    """An emitter of Mitsuba's interface whose radiance is 1."""

    def eval(self, si: Any, active: Any = True) -> Any:
        return mi.UnpolarizedSpectrum(1) & mi.Bool(active)
