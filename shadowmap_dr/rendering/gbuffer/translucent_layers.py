"""Translucent surfaces that a camera sees, in layers from front to back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ...jit.types import Bool, Float, UInt32
from ...raster import NO_TRIANGLE, RasterOutput, peeled_layers, with_triangles
from ...scene.geometry import Geometry
from .translucent_faces import Faces
from .transmission import whole_triangles


@dataclass(frozen=True)
class Layers:
    """The translucent surfaces that a camera sees, K at most along each ray.

    Attributes:
        translucent: K rasters of the whole mesh, front to back, with nothing where rays meet fewer of them.
        textured: True if transmittance needs tangents and texture coordinates.
        bsdfs: BSDFs of the translucent surfaces.
        levels: K + 1 rasters for anti-aliasing: the first, second, ... surface of each ray, of which the opaque one is the last.
    """

    translucent: tuple[RasterOutput, ...]
    levels: tuple[RasterOutput, ...]
    bsdfs: tuple[mi.BSDF, ...]
    textured: bool

    @property
    def nearest(self) -> RasterOutput:
        """The nearest surfaces of all."""
        return self.levels[0]


def see_layers(
    clip: Float,
    geometry: Geometry,
    faces: Faces,
    opaque: RasterOutput,
    counts: tuple[int, int],
    solid: Callable[[RasterOutput], Bool] | None,
) -> Layers:
    """Peel the translucent faces before the opaque ones.

    Args:
        clip: (4 V,) clip-space vertices. Attached.
        geometry: all triangles.
        faces: the translucent ones among them.
        opaque: raster of the opaque ones, with records of all.
        counts: numbers of layers that are kept, and that are looked at.
        solid: mask of the surfaces that take light away, for rasters of the translucent faces alone; None if all do.
    """
    end = dr.select(opaque.valid, dr.detach(opaque.depth), mi.Float(dr.inf))

    def before(raster: RasterOutput) -> Bool:
        found = dr.detach(raster.depth) < end
        return found if solid is None else found & solid(raster)

    size = opaque.height, opaque.width
    peeled = peeled_layers(clip, faces.corners, size, layers=counts[0], passes=counts[1], counts=before)
    triangles = [whole_triangles(layer, faces) for layer in peeled]
    used = sum((dr.select(triangle != NO_TRIANGLE, mi.UInt32(1), 0) for triangle in triangles), mi.UInt32(0))

    def raster(triangle: UInt32) -> RasterOutput:
        return with_triangles(opaque, triangle, clip, geometry.faces)

    levels = [
        dr.select(used == k, opaque.triangle, triangles[k] if k < len(triangles) else mi.UInt32(NO_TRIANGLE))
        for k in range(len(triangles) + 1)
    ]
    dr.eval(triangles, levels)
    return Layers(tuple(map(raster, triangles)), tuple(map(raster, levels)), faces.bsdfs, faces.cutouts)
