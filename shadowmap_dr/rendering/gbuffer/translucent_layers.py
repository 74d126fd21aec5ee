"""Translucent surfaces that a camera sees, in layers from front to back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError
from ...jit.arrays import backend
from ...jit.branches import branch
from ...jit.kernel_inputs import uint_input
from ...jit.memory import physical_memory
from ...jit.types import Bool, Float, UInt32
from ...raster import NO_TRIANGLE, Crossings, FrontSurfaces, RasterOutput, peeled_layers, stacked, with_triangles
from ...raster.triangle_setup import centred
from ...raster.types import by_pixel
from ...scene.geometry import Geometry
from .translucent_faces import Faces
from .transmission import whole_triangles

# Most pixels, numbers of vertices or of triangles, of layers that are shaded at once.
_MOST_NUMBERS = 1 << 22
# Bytes for each sample of each layer: while it is shaded, from then on, and from then on if it has derivatives. Measured with 24
# layers of 512 to 2048 samples along a side.
_SHADED, _KEPT, _KEPT_FOR_DERIVATIVES = 320, 32, 160


@dataclass(frozen=True)
class Layers:
    """The translucent surfaces that a camera sees, K at most along each ray.

    Attributes:
        translucent: K rasters of the translucent faces alone, front to back, with nothing where rays meet fewer of them.
        faces: these faces.
        front: the translucent surfaces of each ray: their number, and the last one.
        opaque: K + 1 rasters of the opaque surfaces that are seen behind no, one, ... translucent surfaces.
        nearest: raster of the nearest surfaces of all.
        attached: False if places and outlines of the translucent surfaces carry no gradients.
    """

    translucent: tuple[RasterOutput, ...]
    faces: Faces
    opaque: tuple[RasterOutput, ...]
    nearest: RasterOutput
    front: FrontSurfaces
    attached: bool

    def check_memory(self, attached: bool) -> None:
        """Raise ShadowmapError if the layers take more memory than the machine has. ``attached``: with derivatives."""
        samples, count, memory = dr.width(self.front.count), len(self.translucent), physical_memory()
        kept = count * (_KEPT_FOR_DERIVATIVES if attached else _KEPT)
        needed = _SHADED * min(count * samples, max(samples, _MOST_NUMBERS)) + kept * samples
        if needed > memory:
            raise ShadowmapError(
                f"{count} translucent layers of {samples:,} samples take {needed / 2**30:.3g} GiB"
                f"{', derivatives included' if attached else ''}, but this machine has {memory / 2**30:.3g} GiB: lower spp or "
                "translucent_layers, or render parts of the image with crop windows."
            )

    def outlines(self, raster: RasterOutput, crossings: Crossings) -> tuple[Crossings, ...]:
        """The outlines of each of the rasters ``opaque``, from those of all opaque surfaces.

        An outline belongs to the nearer one of the surfaces that it separates. A line along which a translucent surface
        intersects an opaque one belongs to what lies behind the surfaces before that one.

        Args:
            raster: of all opaque surfaces.
            crossings: their outlines.
        """
        used, pixel = self.front.count, dr.arange(mi.UInt32, dr.width(self.front.count))
        levels, cuts = [], crossings.cuts or (mi.Float(0), mi.Float(0))
        for weight, cut, step in zip((crossings.right, crossings.down), cuts, (1, raster.width), strict=True):

            def level(pixel: UInt32, used: UInt32, cut: Float, step: int = step) -> UInt32:
                other = pixel + uint_input(backend(pixel), "width", step)
                there = dr.gather(mi.UInt32, self.front.count, other)
                nearer = dr.select(_depth(raster, pixel) <= _depth(raster, other), used, there)
                return dr.select(cut != 0, dr.minimum(used, there), nearer)

            # Few pixels have an outline beside them.
            lanes = pixel, used, cut
            levels.append(branch(weight != 0, level, lambda pixel, used, cut: used, lanes, "level of an outline"))
        right, down = levels
        parts = [
            (dr.select(right == k, crossings.right, 0), dr.select(down == k, crossings.down, 0)) for k in range(len(self.opaque))
        ]
        dr.eval(parts)
        return tuple(replace(crossings, right=right, down=down) for right, down in parts)

    def at_once(self, clip: Float) -> int:
        """Number of layers that are shaded at once. ``clip``: clip-space vertices (4 V,) of the scene."""
        pixels = dr.width(self.front.count)
        return max(1, _MOST_NUMBERS // max(pixels, dr.width(clip), 4 * dr.width(self.faces.corners)))

    def in_batches(self, clip: Float) -> Iterator[tuple[RasterOutput, Float]]:
        """Rasters of several translucent layers each, one image for each layer, and the clip-space vertices of these images.

        From the last layers to the first, so that images without derivatives need memory for some layers at once only.

        ``clip``: clip-space vertices (4 V,) of the scene. Attached.
        """
        at_once, clip, corners = self.at_once(clip), clip if self.attached else dr.detach(clip), self.faces.corners
        for start in reversed(range(0, len(self.translucent), at_once)):
            yield stacked(self.translucent[start : start + at_once], clip, corners, 1)


def _depth(raster: RasterOutput, pixel: UInt32) -> Float:
    """NDC depths of the surfaces that pixels see, 1 (the far plane) where they see none. Detached."""
    triangle = dr.gather(mi.UInt32, raster.triangle, pixel)
    hit = triangle != NO_TRIANGLE
    image, row, column = by_pixel(pixel, raster.batch, raster.height, raster.width)
    x, y = centred(backend(pixel), row, column, raster.height, raster.width)
    dx, dy, start = raster.depth_plane(image, triangle, hit)
    return dr.select(hit, dr.fma(dx, x, dr.fma(dy, y, start)), 1)


def see_layers(
    clip: Float,
    geometry: Geometry,
    faces: Faces,
    opaque: RasterOutput,
    counts: tuple[int, int],
    solid: Callable[[RasterOutput], Bool] | None,
    attached: bool,
) -> Layers:
    """Peel the translucent faces before the opaque ones.

    Args:
        clip: (4 V,) clip-space vertices. Attached.
        geometry: all triangles.
        faces: the translucent ones among them.
        opaque: raster of the opaque ones, with records of all.
        counts: numbers of layers that are kept, and that are looked at.
        solid: mask of the surfaces that take light away, for rasters of the translucent faces alone; None if all do.
        attached: False if neither these faces nor the camera carry gradients.
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

    behind = [dr.select(used == k, opaque.triangle, NO_TRIANGLE) for k in range(len(triangles) + 1)]
    nearest = dr.select(used == 0, opaque.triangle, triangles[0])
    last = mi.UInt32(NO_TRIANGLE)
    for triangle in triangles:
        last = dr.select(triangle != NO_TRIANGLE, triangle, last)
    dr.eval(triangles, behind, nearest, used, last)
    front = FrontSurfaces(used, last)
    return Layers(tuple(peeled), faces, tuple(map(raster, behind)), raster(nearest), front, attached)
