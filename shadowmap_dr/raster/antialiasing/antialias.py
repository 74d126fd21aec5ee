"""Analytic anti-aliasing of silhouettes; it also makes visibility differentiable."""

from __future__ import annotations

from typing import Literal, cast, overload

import drjit as dr

from ...jit.handover import computed
from ...jit.types import Bool, Float, TensorXf
from ..topology import Topology
from ..types import RasterOutput, check_array
from .blend import Canvas, blend
from .colour_jumps import Surroundings
from .creases import CoplanarCreases
from .edge_crossings import DEPTH_GAP, Crossings, find_crossings


@overload
def antialias(
    values: TensorXf,
    raster: RasterOutput,
    positions: TensorXf | Float,
    topology: Topology,
    *,
    crossings: Crossings | None = ...,
    creases: Bool | None = ...,
    crease_weights: Float | None = ...,
    meetings: bool = ...,
    gap: float = ...,
    folds: CoplanarCreases | None = ...,
    continued: bool = ...,
    derivatives_only: bool = ...,
) -> TensorXf: ...


@overload
def antialias(
    values: list[Float],
    raster: RasterOutput,
    positions: TensorXf | Float,
    topology: Topology,
    *,
    crossings: Crossings | None = ...,
    creases: Bool | None = ...,
    crease_weights: Float | None = ...,
    meetings: bool = ...,
    gap: float = ...,
    folds: CoplanarCreases | None = ...,
    continued: bool = ...,
    derivatives_only: bool = ...,
    separate: Literal[True],
) -> list[Float]: ...


@overload
def antialias(
    values: Float | list[Float] | tuple[Float, ...],
    raster: RasterOutput,
    positions: TensorXf | Float,
    topology: Topology,
    *,
    crossings: Crossings | None = ...,
    creases: Bool | None = ...,
    crease_weights: Float | None = ...,
    meetings: bool = ...,
    gap: float = ...,
    folds: CoplanarCreases | None = ...,
    continued: bool = ...,
    derivatives_only: bool = ...,
) -> Float: ...


def antialias(
    values: TensorXf | Float | list[Float] | tuple[Float, ...],
    raster: RasterOutput,
    positions: TensorXf | Float,
    topology: Topology,
    *,
    crossings: Crossings | None = None,
    creases: Bool | None = None,
    crease_weights: Float | None = None,
    meetings: bool = False,
    gap: float = DEPTH_GAP,
    folds: CoplanarCreases | None = None,
    continued: bool = False,
    derivatives_only: bool = False,
    separate: bool = False,
) -> TensorXf | Float | list[Float]:
    """Blend each pixel with the neighbours from which a silhouette separates it, by the share of the pixel they cover.

    Where a silhouette crosses the segment between two pixel centres, the pixel into which the other one's surface reaches
    becomes a mix of both. The weights are at least 0 and sum to 1 over a pixel and its neighbours, and are the same for all
    channels: a moment pair stays a moment pair.

    Args:
        values: tensor (H, W, C) or (B, H, W, C), or a flat ``Float`` array in the same order, or (cheapest) a list of C ``Float``
            arrays with one number for each pixel, or one for all.
        raster: rasterizer output for the same images.
        positions: clip-space vertices as given to the rasterizer.
        topology: :func:`shadowmap_dr.raster.build_topology` of the mesh.
        crossings: result of :func:`find_crossings`, with the same creases, to share the search between several calls.
        creases, crease_weights: edges of faces that are blended (and differentiated) like silhouettes, and their weights, see
            :func:`find_crossings`.
        meetings: blend (and differentiate) where surfaces intersect without an edge, too, see :func:`find_crossings`.
        gap: least depth between a silhouette and the surface behind it, see :func:`find_crossings`.
        folds: creases that do not count between coplanar faces, see :func:`find_crossings`.
        continued: for derivatives by the edges' positions, extrapolate values linearly from the pixels to the edge, instead of
            taking them as constant (:mod:`shadowmap_dr.raster.antialiasing.colour_jumps`).
        derivatives_only: with a list, leave the blended values undefined if derivatives do not need them.
        separate: return a list for a list. Cheaper where the channels are not needed interleaved.

    Returns:
        The blended values in the shape of ``values``; flat, with interleaved channels, for a list, or a list if ``separate``.
        Gradients flow to ``values`` and, through the position of the silhouettes, to ``positions``.

    Raises:
        ValueError: values, positions, topology, creases or crossings do not fit the raster; the topology has no edges;
            ``separate`` without a list.

    Source: the idea of blending along the axis that crosses the edge is that of Laine et al., "Modular Primitives for
    High-Performance Differentiable Rendering", 2020, section 3.6; the search for edges and the weights are different.
    """
    check_array("positions", positions)
    for array in values if isinstance(values, list | tuple) else [values]:
        check_array("values", array)
    if separate and not isinstance(values, list):
        raise ValueError("separate: channels are separate only in a list of arrays")
    tensor = cast("TensorXf", values) if dr.is_tensor_v(values) else None
    flat = _checked_values(values, raster)
    positions, vertex_count = _flat_positions(positions, raster, topology)
    crease_weights = _checked_creases(creases, crease_weights, raster)
    if isinstance(flat, list) and derivatives_only and not dr.grad_enabled(positions):
        canvas = Canvas.blank_for(flat, separate)
    elif isinstance(flat, list):
        canvas, crease_weights = Canvas.of(flat, crease_weights, separate)
    else:
        with dr.suspend_grad():
            dr.eval(flat)
        canvas = Canvas(dr.detach(flat))
    if crossings is None:
        crossings = computed(
            "crossings",
            lambda: find_crossings(positions, topology, raster, vertex_count, creases, crease_weights, meetings, gap, folds),
        )
    elif dr.width(crossings.right) != raster.batch * raster.height * raster.width:
        raise ValueError(f"crossings are those of {dr.width(crossings.right)} pixels, but {_size_of(raster)} are given")
    surroundings = Surroundings.of(raster, positions, topology, crossings.marked, crease_weights) if continued else None
    blended = blend(flat, positions, raster, crossings, canvas, surroundings)
    return blended if tensor is None else type(tensor)(blended, shape=tensor.shape)


def _checked_values(values: TensorXf | Float | list[Float] | tuple[Float, ...], raster: RasterOutput) -> Float | list[Float]:
    """Flat values, or a list of channels of full width."""
    pixels = raster.batch * raster.height * raster.width
    where = _size_of(raster)
    if isinstance(values, list | tuple):
        if not values or any(dr.width(channel) not in (1, pixels) for channel in values):
            raise ValueError(f"channels hold {[dr.width(channel) for channel in values]} numbers for {where}")
        return [channel if dr.width(channel) == pixels else channel + dr.zeros(type(channel), pixels) for channel in values]
    flat = cast("Float", values)
    if dr.is_tensor_v(values):
        size, shape = (raster.batch, raster.height, raster.width), tuple(values.shape)
        if shape[:-1] != size and (raster.batch > 1 or shape[:-1] != size[1:]):
            raise ValueError(f"values have shape {shape}; expected (H, W, C) or (B, H, W, C) for {where}")
        flat = values.array
    count = dr.width(flat)
    if count == 0 or count % pixels != 0:
        raise ValueError(f"values hold {count} numbers for {where}")
    return flat


def _checked_creases(creases: Bool | None, weights: Float | None, raster: RasterOutput) -> Float | None:
    """Weights of creases, one for each pixel; None for 1."""
    pixels, edges = raster.batch * raster.height * raster.width, 3 * raster.face_count
    if creases is not None and dr.width(creases) != edges:
        raise ValueError(f"creases hold {dr.width(creases)} flags, but {raster.face_count} faces have {edges} edges")
    if weights is None or dr.width(weights) == pixels:
        return weights
    if dr.width(weights) != 1:
        raise ValueError(f"crease_weights hold {dr.width(weights)} numbers for {_size_of(raster)}")
    return weights + dr.zeros(type(weights), pixels)


def _size_of(raster: RasterOutput) -> str:
    return f"{raster.batch} image(s) of {raster.height} x {raster.width} pixels"


def _flat_positions(positions: TensorXf | Float, raster: RasterOutput, topology: Topology) -> tuple[Float, int]:
    flat = positions.array if dr.is_tensor_v(positions) else cast("Float", positions)
    if dr.width(flat) % (4 * raster.batch) != 0:
        raise ValueError(f"positions hold {dr.width(flat)} numbers, which is not {raster.batch} image(s) of (V, 4) vertices")
    vertices = dr.width(flat) // (4 * raster.batch)
    if dr.width(topology.faces) != 3 * raster.face_count or topology.vertex_count > vertices:
        raise ValueError(
            f"the topology is that of {dr.width(topology.faces) // 3} faces and {topology.vertex_count} vertices, "
            f"but {raster.face_count} faces were rasterized and there are {vertices} vertices"
        )
    return flat, vertices
