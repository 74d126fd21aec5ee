"""Vertex attributes at pixels."""

from __future__ import annotations

from typing import cast

import drjit as dr

from ..jit.arrays import backend, ravel
from ..jit.kernel_inputs import uint_input
from ..jit.types import TensorXf, TensorXu, UInt32
from .types import RasterOutput, check_array, check_range, pixel_coordinates


def interpolate(attributes: TensorXf, raster: RasterOutput, faces: TensorXu | UInt32, *, check_indices: bool = True) -> TensorXf:
    """Interpolate vertex attributes over the visible triangles, perspective-correct.

    Args:
        attributes: tensor (V, C), the same for all images, or (B, V, C).
        raster: rasterizer output.
        faces: indices into ``attributes``, tensor (F, 3) or flat: the faces given to the rasterizer, or other indices for the
            same triangles (such as those of texture coordinates).
        check_indices: verify that no index is out of range. This reads back one number. Switch it off for (constant) faces
            that have been checked before, and inside ``dr.freeze``.

    Returns:
        Tensor (H, W, C), or (B, H, W, C) for more than one image; 0 where no triangle is visible. Gradients flow to
        ``attributes`` and, through the barycentrics, to the rasterized positions.

    Raises:
        ValueError: attributes or faces do not fit the images or each other; an index is out of range.
    """
    check_array("attributes", attributes)
    check_array("faces", faces, integer=True)
    if not dr.is_tensor_v(attributes):
        raise ValueError(f"attributes are of type {type(attributes).__name__}; expected a tensor (V, C) or (B, V, C)")
    shape = tuple(attributes.shape)
    if len(shape) not in (2, 3) or 0 in shape:
        raise ValueError(f"attributes have shape {shape}; expected (V, C) or (B, V, C), not empty")
    if len(shape) == 3 and shape[0] != raster.batch:
        raise ValueError(f"attributes of shape {shape} do not fit {raster.batch} image(s)")
    module = backend(attributes)
    face_indices = cast("UInt32", faces.array if dr.is_tensor_v(faces) else faces)
    if dr.width(face_indices) != 3 * raster.face_count:
        raise ValueError(f"faces hold {dr.width(face_indices)} indices, but {raster.face_count} triangles were rasterized")
    if check_indices:
        check_range(face_indices, shape[-2], "attribute row")
    channels = shape[-1]
    image, _, _ = pixel_coordinates(module, raster.batch, raster.height, raster.width)
    first = image * uint_input(module, "attributes", shape[1]) if len(shape) == 3 else 0
    hit = raster.valid
    corners = dr.gather(module.Array3u, module.UInt32(face_indices), raster.triangle, hit)
    weights = (1 - raster.u - raster.v, raster.u, raster.v)
    totals = []
    for c in range(channels):
        total = module.Float(0)
        for k in range(3):
            value = dr.gather(module.Float, attributes.array, (first + corners[k]) * channels + c, hit)
            total = dr.fma(weights[k], value, total)
        totals.append(dr.select(hit, total, 0))
    # All channels in one kernel: separate scatters would be separate kernels.
    result = totals[0] if channels == 1 else ravel(module.ArrayXf(totals))
    size = (raster.height, raster.width, channels)
    return type(attributes)(result, shape=size if raster.batch == 1 else (raster.batch, *size))
