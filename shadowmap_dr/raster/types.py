"""Dr.Jit types and the records that all screen-space primitives share."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import TypeAlias

import drjit as dr
import numpy as np

from ..jit.arrays import backend
from ..jit.kernel_inputs import quotient, split, uint_input
from ..jit.types import Bool, Float, Float64, UInt32, Vector4f

#: Edge functions and depth planes of triangles: coefficients a, b, c, four numbers a triangle each.
Records: TypeAlias = tuple[Float, Float, Float]

#: Triangle index of a pixel that no triangle covers.
NO_TRIANGLE = 0xFFFFFFFF

#: Largest image side for which the single-precision edge functions keep their accuracy (1/256 pixel).
MAX_RESOLUTION = 4096


@dataclass(frozen=True)
class RasterOutput:
    """Visible triangles of the pixels of a batch of images.

    All arrays have ``batch * height * width`` entries, row-major (``(b * height + row) * width + column``).

    Attributes:
        triangle: index of the visible triangle, ``NO_TRIANGLE`` where no triangle is visible.
        u, v: perspective-correct barycentric weights of the triangle's vertices 1 and 2 (vertex 0 has ``1 - u - v``).
        depth: ``z / w`` in clip space, 1 (the far plane) where no triangle is visible.
        w: interpolated clip-space ``w`` (in perspective, distance along the viewing axis), 1 where no triangle is visible.
        records: per-triangle set-up of the rasterizer (three arrays of 4 floats a triangle), for later passes.
        face_count, batch, height, width: sizes.

    ``u``, ``v``, ``depth`` and ``w`` carry gradients to the clip-space positions, for a fixed visible triangle.
    :func:`shadowmap_dr.raster.antialias` adds the derivatives of visibility.
    """

    triangle: UInt32
    u: Float
    v: Float
    depth: Float
    w: Float
    records: Records
    face_count: int
    batch: int
    height: int
    width: int

    def edge_functions(self, image: UInt32, triangle: UInt32, active: Bool | bool = True) -> tuple[Vector4f, Vector4f, Vector4f]:
        """``a x + b y + c``, x and y in pixels from the image centre, as three ``Array4f``. Detached.

        Components 0, 1, 2: distance (pixels) from the edges opposite to vertices 0, 1, 2, positive inside; 3: NDC depth.

        Args:
            image: index of the image in the batch.
            triangle: valid index where ``active``.
        """
        Array4f = backend(self.records[0]).Array4f
        index = self._record(image, triangle)
        a, b, c = (dr.gather(Array4f, record, index, active) for record in self.records)
        return a, b, c

    def depth_plane(self, image: UInt32, triangle: UInt32, active: Bool | bool = True) -> tuple[Float, Float, Float]:
        """NDC depth plane alone, the last component of :func:`edge_functions`: (dx, dy, d). Detached."""
        Float = backend(self.records[0]).Float
        index = 4 * self._record(image, triangle) + 3
        dx, dy, d = (dr.gather(Float, record, index, active) for record in self.records)
        return dx, dy, d

    def _record(self, image: UInt32, triangle: UInt32) -> UInt32:
        return image * uint_input(backend(triangle), "faces", self.face_count) + triangle

    @property
    def valid(self) -> Bool:
        """Mask of the pixels that see a triangle."""
        return self.triangle != NO_TRIANGLE


def precise_rcp(x: Float64) -> Float64:
    """``1 / x`` to full precision. On a GPU, ``dr.rcp`` of a double is good for only some 20 bits."""
    with dr.scoped_set_flag(dr.JitFlag.FastMath, False):
        return dr.rcp(x)


def check_array(name: str, array: object, *, integer: bool = False) -> None:
    """Raise ValueError unless an array is a tensor or a flat array of Dr.Jit's, of integers or in single precision."""
    is_flat = array is not None and dr.is_jit_v(array) and (dr.is_tensor_v(array) or dr.depth_v(array) == 1)
    if not (is_flat and (dr.is_integral_v(array) if integer else dr.type_v(array) == dr.VarType.Float32)):
        wanted = "integer" if integer else "single-precision"
        raise ValueError(f"{name} are of type {type(array).__name__}; expected a Dr.Jit tensor or flat array, {wanted}")


def check_range(faces: UInt32, count: int, what: str) -> None:
    """Raise ValueError if an index in ``faces`` is ``count`` or more; ``what`` names the indexed thing. Reads back one number."""
    largest = int(np.max(dr.max(faces).numpy()))
    if largest >= count:
        raise ValueError(f"faces refer to {what} {largest}, but there are only {count}")


def by_pixel(index: UInt32, batch: int, height: int, width: int) -> tuple[UInt32, UInt32, UInt32]:
    """(image of the batch, row, column) of pixels, from their indices in a flat row-major batch of images."""
    row_flat = quotient(index, "width", width)
    image, row = split(row_flat, "height", height, batch)
    return image, row, index - row_flat * uint_input(backend(index), "width", width)


def pixel_coordinates(module: ModuleType, batch: int, height: int, width: int) -> tuple[UInt32, UInt32, UInt32]:
    """Image index, row and column (``UInt32``) of every entry of a flat row-major batch of images."""
    index = dr.arange(module.UInt32, batch * height * width)
    return by_pixel(index, batch, height, width)


def zeros(module: ModuleType, size: int, count: int) -> list[Float]:
    """``count`` evaluated ``Float`` arrays of zeros, to be written to.

    A kernel of all threads writes them; Dr.Jit fills constant arrays with a single thread. ``size`` is at most 2^28.
    """
    lane = dr.arange(module.UInt32, size)
    # Different shifts, so that Dr.Jit does not merge the arrays into one.
    arrays = [module.Float(lane >> (31 - k)) for k in range(count)]
    dr.eval(arrays)
    return arrays


#: Stands for "no second face" in :attr:`Topology.opposite`.
NO_VERTEX = 0xFFFFFFFF
