"""Analytic anti-aliasing of silhouettes, which is also what makes them differentiable."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ._types import RasterOutput, backend, pixel_coordinates
from .silhouette import Crossings, crossing_position, find_crossings
from .topology import Topology


def antialias(
    values: Any,
    raster: RasterOutput,
    positions: Any,
    topology: Topology,
    *,
    crossings: Crossings | None = None,
    creases: Any = None,
    crease_weights: Any = None,
) -> Any:
    """Blend each pixel with the neighbours from which a silhouette separates it, by the share of the pixel they cover.

    Where a silhouette crosses the segment between two pixel centres, the pixel into which the other one's surface reaches
    becomes a mix of both. The weights are at least 0 and sum to 1 over a pixel and its neighbours, and are the same for all
    channels: a moment pair stays a moment pair.

    Args:
        values: tensor (H, W, C) or (B, H, W, C), or a flat ``Float`` array with C = 1.
        raster: rasterizer output for the same images.
        positions: clip-space vertices as given to the rasterizer.
        topology: :func:`shadowmap_dr.raster.build_topology` of the mesh.
        crossings: result of :func:`find_crossings`, to share the search between several calls.
        creases, crease_weights: edges of faces that are blended (and differentiated) like silhouettes, and how much, see
            :func:`find_crossings`.

    Returns:
        The blended values in the shape of ``values``. Gradients flow to ``values`` and, through the position of the
        silhouettes, to ``positions``.

    Source: the idea of blending along the axis that crosses the edge is that of Laine et al., "Modular Primitives for
    High-Performance Differentiable Rendering", 2020, section 3.6; the search for edges and the weights are different.
    """
    is_tensor = dr.is_tensor_v(values)
    flat = values.array if is_tensor else values
    pixels = raster.batch * raster.height * raster.width
    count = dr.width(flat)
    if count == 0 or count % pixels != 0:
        raise ValueError(f"values hold {count} numbers for {raster.batch} image(s) of {raster.height} x {raster.width} pixels")
    positions, vertex_count = _flat_positions(positions, raster)
    if crossings is None:
        crossings = find_crossings(positions, topology, raster, vertex_count, creases, crease_weights)
    weights = blend_weights(positions, raster, crossings, vertex_count)
    blended = blend(flat, weights, raster, count // pixels)
    return type(values)(blended, shape=values.shape) if is_tensor else blended


def _flat_positions(positions: Any, raster: RasterOutput) -> tuple[Any, int]:
    flat = positions.array if dr.is_tensor_v(positions) else positions
    if dr.width(flat) % (4 * raster.batch) != 0:
        raise ValueError(f"positions hold {dr.width(flat)} numbers, which is not {raster.batch} image(s) of (V, 4) vertices")
    return flat, dr.width(flat) // (4 * raster.batch)


def blend_weights(positions: Any, raster: RasterOutput, crossings: Crossings, vertex_count: int) -> tuple[Any, Any]:
    """Signed weights of the (right, lower) pairs, attached to ``positions``.

    Positive: so much of the pixel reaches into its neighbour; negative: so much of the neighbour into the pixel.
    """
    c = crossings
    t_right = crossing_position(positions, raster, (c.right_a, c.right_b), vertex_count, down=False)
    t_down = crossing_position(positions, raster, (c.down_a, c.down_b), vertex_count, down=True)
    right, down = c.right_share * (t_right - 0.5), c.down_share * (t_down - 0.5)
    if c.second is not None:
        more_right, more_down = blend_weights(positions, raster, c.second, vertex_count)
        right, down = right + more_right, down + more_down
    return right, down


def blend(values: Any, weights: tuple[Any, Any], raster: RasterOutput, channels: int) -> Any:
    """Apply the weights of all pairs to flat, interleaved values of ``channels`` channels."""
    module = backend(values)
    _, row, column = pixel_coordinates(module, raster.batch, raster.height, raster.width)
    index = dr.arange(module.UInt32, raster.batch * raster.height * raster.width)
    right, down = weights
    has_left, has_up = column > 0, row > 0
    neighbours = (
        (index + 1, dr.maximum(-right, 0)),
        (index + raster.width, dr.maximum(-down, 0)),
        (index - 1, dr.maximum(dr.gather(module.Float, right, index - 1, has_left), 0)),
        (index - raster.width, dr.maximum(dr.gather(module.Float, down, index - raster.width, has_up), 0)),
    )
    # Up to four neighbours may each claim half of an isolated pixel; more than all of it they cannot have.
    scale = dr.rcp(dr.maximum(1, sum(w for _, w in neighbours)))
    result = dr.empty(module.Float, channels * dr.width(index)) if channels > 1 else None
    blended = []
    for c in range(channels):
        own = dr.gather(module.Float, values, index * channels + c) if channels > 1 else values
        total = own
        for other, weight in neighbours:
            value = dr.gather(module.Float, values, other * channels + c, weight > 0)
            total = dr.fma(weight * scale, dr.select(weight > 0, value - own, 0), total)
        blended.append(total)
    if channels == 1:
        return blended[0]
    for c in range(channels):
        dr.scatter(result, blended[c], index * channels + c)
    return result
