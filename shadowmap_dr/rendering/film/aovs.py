"""Further image channels, which are by-products of the passes."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from ...jit.types import Float, UInt32
from ...raster import RasterOutput
from ...scene.lights.read import Light
from ..gbuffer.surface import Surface

#: Name -> channel suffixes. ``visibility`` has one channel for each light, named after it.
AOVS: dict[str, tuple[str, ...]] = {
    "depth": ("",),
    "position": (".X", ".Y", ".Z"),
    "normal": (".X", ".Y", ".Z"),
    "shape_index": ("",),
    "prim_index": ("",),
    "visibility": (),
}


def split_aovs(aovs: str | Iterable[str]) -> tuple[str, ...]:
    """Entries of further channels, from text with commas or from a sequence of names; without blanks and empty entries."""
    parts = aovs.split(",") if isinstance(aovs, str) else aovs
    return tuple(filter(None, (part.strip() for part in parts)))


def aov_names(aovs: tuple[str, ...], light_names: list[str]) -> list[str]:
    """Channel names in the order of :func:`collect_aovs`."""
    names = []
    for name in aovs:
        if name == "visibility":
            names += [f"visibility.{light}" for light in light_names]
        else:
            names += [name + suffix for suffix in AOVS[name]]
    return names


def collect_aovs(
    aovs: tuple[str, ...], seen: Surface, raster: RasterOutput, lights: tuple[Light, ...], visible: list[Float]
) -> list[Float]:
    """Channels (Float, one entry a pixel), 0 in the background, but visibility 1.

    ``depth``: distance from the camera, world units (as Mitsuba's). ``position``, ``normal``: world space, the normal is the
    shading normal. ``shape_index``, ``prim_index``: counted from 0, -1 where nothing is seen. Not anti-aliased, and not passed
    through the film's reconstruction filter.
    """
    width = dr.width(raster.triangle)

    def masked(value: Float | UInt32, empty: float = 0.0) -> Float:
        full = dr.select(seen.active, mi.Float(value), empty)
        return full if dr.width(full) == width else full + dr.zeros(mi.Float, width)

    channels: list[Float] = []
    for name in aovs:
        if name == "depth":
            channels.append(masked(seen.si.t))
        elif name == "position":
            channels += [masked(seen.p_world[k]) for k in range(3)]
        elif name == "normal":
            channels += [masked(seen.si.sh_frame.n[k]) for k in range(3)]
        elif name == "shape_index":
            channels.append(masked(seen.shape, -1.0))
        elif name == "prim_index":
            channels.append(masked(seen.si.prim_index, -1.0))
        elif name == "visibility":
            channels += [masked(fraction, 1.0) for fraction in visible]
    return channels
