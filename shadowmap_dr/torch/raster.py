"""Visibility and vertex attributes on PyTorch tensors: rasterize, interpolate. Functions of :mod:`shadowmap_dr.raster`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeAlias

import drjit as dr
import torch

from .. import raster as _raster
from ..errors import ShadowmapError
from ..jit.arrays import backend
from ..jit.types import Bool, Float, TensorXf
from ..raster import RasterOutput
from .bridge import IN_TENSOR, drjit_turn, index_array, mask_array, to_drjit, to_torch
from .checks import check_devices, check_flags, check_floats, check_kind, check_same, number_of
from .crossing import Repeated, cross, eager
from .records import FaceSets, Raster, check_set_images, pieces, plain_faces
from .transforms import plain

#: First face and number of faces of each image.
Ranges: TypeAlias = "Sequence[tuple[int, int]] | torch.Tensor"

_BATCH = "give positions (B, V, 4), one set for each image"


@eager
def rasterize(
    positions: torch.Tensor,
    faces: torch.Tensor,
    resolution: tuple[int, int],
    *,
    ranges: Ranges | None = None,
    transparent: Callable[[Raster], torch.Tensor] | None = None,
    layers: int = 4,
) -> Raster:
    """Find the nearest triangle at each pixel centre. See :func:`shadowmap_dr.raster.rasterize` for the rules.

    Args:
        positions: float32 (V, 4), the same for all images, or (B, V, 4), clip-space vertices; visible where
            ``-w <= x, y, z <= w``.
        faces: integers (F, 3), vertex indices, the same for all images, or (B, F, 3).
        resolution: (height, width) in pixels, each 1 to 4096.
        ranges: (first face, number of faces) of each image, integers (B, 2): images show different parts of faces (F, 3).
        transparent: alpha test. A function of a :class:`Raster` (detached) that returns a bool tensor (B, H, W), True for pixels
            whose surface is transparent there; these see the surface behind it. No gradients. All images must show the same
            faces.
        layers: maximum number of surfaces tested for each pixel, front to back. The last surface counts as opaque.

    Returns:
        :class:`Raster`, attached to ``positions``; B is 1 if no argument has images.
    """
    check_floats("positions", positions, ("V", 4), ("B", "V", 4))
    indices = plain_faces(faces, positions.shape[-2])
    device, sets = check_devices(positions=positions, faces=indices), FaceSets.of(faces, ranges)
    batch = check_set_images(sets, len(positions) if positions.ndim == 3 else None)
    try:
        size = _raster.check_resolution(resolution)
    except (ValueError, TypeError) as error:
        raise ShadowmapError(str(error)) from None
    _check_alpha_test(transparent, layers, sets)
    own_faces = [index_array(part) for part in sets.split(indices)]
    images = batch if sets.shared else 1
    numbers = plain("positions", positions, _BATCH)

    def test(output: RasterOutput) -> Bool:
        assert transparent is not None, "called only where there is one"
        return _alpha(transparent, output, sets)

    with drjit_turn(device):
        vertices, found = to_drjit(numbers).array, []
        alpha = None if transparent is None else test
        for part, own in zip(_of_sets(vertices, sets, positions.ndim), own_faces, strict=True):
            one = dr.detach(_raster.visible_triangles(part, own, size, batch=images, transparent=alpha, layers=layers))
            # Only the visible triangles: tensors hold the rest.
            found.append(replace(one, u=IN_TENSOR, v=IN_TENSOR, depth=IN_TENSOR, w=IN_TENSOR))
            dr.eval(found[-1].triangle, found[-1].records)
        triangle = torch.cat([
            _triangles(one, start) for one, start in zip(found, sets.starts(), strict=True)
        ])  # fmt: skip

    def run(positions: TensorXf) -> tuple[TensorXf, ...]:
        parts = _of_sets(positions.array, sets, len(positions.shape))
        seen = [_raster.locate(*each) for each in zip(found, parts, own_faces, strict=True)]
        return tuple(
            type(positions)(_joined([getattr(one, name) for one in seen]), (batch, *size)) for name in ("u", "v", "depth")
        )

    u, v, depth = cross(Repeated("rasterize", run, _BATCH), positions)
    return Raster(triangle, u, v, depth, tuple(found), sets)


@eager
def interpolate(attributes: torch.Tensor, raster: Raster, faces: torch.Tensor) -> torch.Tensor:
    """Interpolate vertex attributes over the visible triangles, perspective-correct.

    Args:
        attributes: float32 (V, C), the same for all images, or (B, V, C).
        raster: from :func:`rasterize`.
        faces: integers (F, 3) or (B, F, 3), indices into ``attributes``: the faces that were rasterized, or other indices for the
            same triangles (such as those of texture coordinates).

    Returns:
        float32 (B, H, W, C), 0 where nothing is seen. Attached to ``attributes`` and, through ``raster.u`` and ``raster.v``, to
        the positions that were rasterized.
    """
    check_kind("raster", raster, Raster)
    size, sets, found = raster._size, raster._sets, raster._found
    check_floats("attributes", attributes, ("V", "C"), (size[0], "V", "C"))
    indices = plain_faces(faces, attributes.shape[-2], "rows of attributes")
    if tuple(faces.shape) != sets.shape:
        if faces.ndim == len(sets.shape) == 2:
            check_same("faces", len(faces), sets.shape[0], "give one row for each triangle that was rasterized")
        check_same("shape of faces", tuple(faces.shape), sets.shape, "give one row for each triangle that was rasterized")
    check_floats("raster.u", raster.u, size)
    check_floats("raster.v", raster.v, size)
    check_devices(attributes=attributes, faces=indices, raster=raster.triangle, u=raster.u, v=raster.v)
    own_faces = [index_array(part) for part in sets.split(indices)]

    def run(attributes: TensorXf, u: TensorXf, v: TensorXf) -> tuple[TensorXf, ...]:
        channels, shape = attributes.shape[-1], tuple(attributes.shape)
        images = _of_pixels(found, u.array), _of_pixels(found, v.array)
        values = [attributes]
        if not sets.shared:
            shape = shape[-2:]
            values = [type(attributes)(part, shape) for part in _of_sets(attributes.array, sets, len(attributes.shape))]
        results = []
        for value, one, own, u_own, v_own in zip(values, found, own_faces, *images, strict=True):
            result = _raster.interpolate(value, replace(one, u=u_own, v=v_own), own, check_indices=False)
            results.append(result.array)
        return (type(attributes)(_joined(results), (*size, channels)),)

    return cross(Repeated("interpolate", run), attributes, raster.u, raster.v)[0]


def _check_alpha_test(transparent: object, layers: object, sets: FaceSets) -> None:
    if number_of("layers", layers, int) < 1:
        raise ShadowmapError(f"layers: {layers}; give 1 or more surfaces.")
    if transparent is not None and not callable(transparent):
        raise ShadowmapError(f"transparent: {type(transparent).__name__}, but must be a function of a Raster.")
    if transparent is not None and not sets.shared:
        raise ShadowmapError(f"transparent: given beside faces {sets}; rasterize the images one by one.")


def _alpha(transparent: Callable[[Raster], torch.Tensor], output: RasterOutput, sets: FaceSets) -> Bool:
    """The caller's alpha test of the triangles that pixels see."""
    shape = output.batch, output.height, output.width
    module = backend(output.triangle)
    u, v, depth = (to_torch(module.TensorXf(value, shape)) for value in (output.u, output.v, output.depth))
    found = replace(dr.detach(output), u=IN_TENSOR, v=IN_TENSOR, depth=IN_TENSOR, w=IN_TENSOR)
    with torch.no_grad():
        mask = transparent(Raster(_triangles(found, 0), u, v, depth, (found,), sets))
    check_flags("result of transparent", mask, shape)
    check_devices(positions=u, **{"result of transparent": mask})
    return mask_array(plain("result of transparent", mask, _BATCH))


def _triangles(found: RasterOutput, start: int) -> torch.Tensor:
    """int32 (B, H, W), indices in all faces, of which ``start`` is the first of this set."""
    module, shape = backend(found.triangle), (found.batch, found.height, found.width)
    triangle = to_torch(module.TensorXi(module.Int32(found.triangle), shape))
    return torch.where(triangle < 0, triangle, triangle + start) if start else triangle


def _of_sets(flat: Float, sets: FaceSets, dimensions: int) -> list[Float]:
    """Numbers of vertices, (V, N) or (B, V, N) as there are ``dimensions``, for each set. Attached."""
    if sets.shared:
        return [flat]
    if dimensions == 2:
        return [flat] * sets.count
    return parts_of(flat, [1] * sets.count)


def _of_pixels(found: Sequence[RasterOutput], flat: Float) -> list[Float]:
    return parts_of(flat, [one.batch for one in found])


def parts_of(flat: Float, images: Sequence[int]) -> list[Float]:
    """The numbers of consecutive groups of images. Attached."""
    if len(images) == 1:
        return [flat]
    module, length = backend(flat), dr.width(flat) // sum(images)
    return [
        dr.gather(type(flat), flat, dr.arange(module.UInt32, start, end), mode=dr.ReduceMode.NoConflicts)
        for start, end in pieces(images, length)
    ]


def _joined(parts: list[Float]) -> Float:
    return parts[0] if len(parts) == 1 else dr.concat(parts)
