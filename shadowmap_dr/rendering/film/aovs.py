"""Further image channels, which are by-products of the passes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import drjit as dr
import mitsuba as mi

from ...jit.types import Color3f, Float, UInt32
from ...jit.vectors import mean_of
from ...raster import RasterOutput
from ..gbuffer.surface import Surface

#: Name -> channel suffixes. ``visibility`` has one channel for each light, named after it, ``transmittance`` three.
AOVS: dict[str, tuple[str, ...]] = {
    "depth": ("",),
    "position": (".X", ".Y", ".Z"),
    "normal": (".X", ".Y", ".Z"),
    "shape_index": ("",),
    "prim_index": ("",),
    "opacity": ("",),
    "visibility": (),
    "transmittance": (),
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
        elif name == "transmittance":
            names += [f"transmittance.{light}{suffix}" for light in light_names for suffix in (".R", ".G", ".B")]
        else:
            names += [name + suffix for suffix in AOVS[name]]
    return names


def collect_aovs(
    aovs: tuple[str, ...],
    seen: Surface,
    raster: RasterOutput,
    visible: Sequence[Float | Color3f],
    through: Callable[[], Sequence[Color3f]],
    coverage: Float | None = None,
) -> list[Float]:
    """Channels (Float, one entry a pixel), 0 in the background, but visibility and transmittance 1.

    ``depth``: distance from the camera, world units (as Mitsuba's). ``position``, ``normal``: world space, the normal is the
    shading normal. ``shape_index``, ``prim_index``: counted from 0, -1 where nothing is seen. ``visibility``: mean over colours
    of the share of each light that arrives; ``transmittance``: share that translucent casters let through, by colour. These are
    of the nearest surfaces, opaque or not. ``opacity``: share of the light from behind all surfaces that they take away.
    Not anti-aliased, but for opacities in scenes with translucent surfaces, and not passed through the film's reconstruction
    filter.

    Args:
        aovs: names of channels.
        seen, raster: the nearest surfaces.
        visible: for each light, the share that arrives: a number or a colour.
        through: returns for each light the share that translucent casters let through.
        coverage: opacities, None if all surfaces are opaque.
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
            channels += [masked(mean_of(fraction), 1.0) for fraction in visible]
        elif name == "opacity":
            channels.append(masked(mi.Float(1)) if coverage is None else coverage)
        elif name == "transmittance":
            channels += [masked(colour[min(k, len(colour) - 1)], 1.0) for colour in through() for k in range(3)]
    return channels
