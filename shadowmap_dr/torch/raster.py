"""Screen-space primitives on PyTorch tensors: rasterize, interpolate, antialias. Functions of :mod:`shadowmap_dr.raster`."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import torch

from .. import raster as _raster
from ..errors import ShadowmapError
from ..jit.types import TensorXf
from ..raster import RasterOutput
from ..raster.rasterize import check_resolution
from .bridge import IN_TENSOR, Repeated, cross, drjit_turn, index_array, to_torch
from .checks import check_devices, check_floats, check_indices, check_kind, check_same


@dataclass(frozen=True)
class Raster:
    """Triangles that the pixels of B images see.

    Attributes:
        triangle: int32 (B, H, W), index of the visible triangle, -1 for none.
        u, v: float32 (B, H, W), perspective-correct weights of the triangle's vertices 1 and 2 (vertex 0 has ``1 - u - v``).
        depth: float32 (B, H, W), ``z / w`` in clip space, 1 (the far plane) where nothing is seen.

    ``u``, ``v`` and ``depth`` are attached to the positions, for a fixed visible triangle; :func:`antialias` differentiates
    changes of visibility. Read only: the other functions ignore a changed ``triangle``.
    """

    triangle: torch.Tensor
    u: torch.Tensor
    v: torch.Tensor
    depth: torch.Tensor
    _found: RasterOutput = field(repr=False)

    @property
    def covered(self) -> torch.Tensor:
        """Bool (B, H, W): whether a pixel sees a triangle."""
        return self.triangle >= 0


@dataclass(frozen=True)
class Topology:
    """Edges of a mesh, from :func:`build_topology`. Valid as long as the faces stay the same.

    Attributes:
        faces: int32 (F, 3), vertex indices.
        vertex_count: number of vertices V.
    """

    faces: torch.Tensor
    vertex_count: int
    _edges: _raster.Topology = field(repr=False)


def rasterize(positions: torch.Tensor, faces: torch.Tensor, resolution: tuple[int, int]) -> Raster:
    """Find the nearest triangle at each pixel centre. See :func:`shadowmap_dr.raster.rasterize` for the rules.

    Args:
        positions: float32 (V, 4) or (B, V, 4), clip-space vertices; visible where ``-w <= x, y, z <= w``.
        faces: integers (F, 3), vertex indices, the same for all images.
        resolution: (height, width) in pixels, each 1 to 4096.

    Returns:
        :class:`Raster`, attached to ``positions``; B is 1 for positions (V, 4).
    """
    check_floats("positions", positions, ("V", 4), ("B", "V", 4))
    check_indices("faces", faces, positions.shape[-2])
    device = check_devices(positions=positions, faces=faces)
    try:
        size = check_resolution(resolution)
    except (ValueError, TypeError) as error:
        raise ShadowmapError(str(error)) from None
    indices = index_array(faces)
    kept: list[RasterOutput] = []

    def run(positions: TensorXf) -> tuple[TensorXf, ...]:
        output = _raster.rasterize(positions, indices, size, check_indices=False)
        kept.append(output)
        shape = (output.batch, output.height, output.width)
        return tuple(type(positions)(value, shape) for value in (output.u, output.v, output.depth))

    u, v, depth = cross(Repeated(run), positions)
    with drjit_turn(device) as module:
        # Only the visible triangles: tensors hold the rest.
        found = dr.detach(replace(kept[0], u=IN_TENSOR, v=IN_TENSOR, depth=IN_TENSOR, w=IN_TENSOR))
        triangle = to_torch(module.TensorXi(module.Int32(found.triangle), u.shape))
    return Raster(triangle, u, v, depth, found)


def interpolate(attributes: torch.Tensor, raster: Raster, faces: torch.Tensor) -> torch.Tensor:
    """Interpolate vertex attributes over the visible triangles, perspective-correct.

    Args:
        attributes: float32 (V, C), the same for all images, or (B, V, C).
        raster: from :func:`rasterize`.
        faces: integers (F, 3), indices into ``attributes``: the faces that were rasterized, or other indices for the same
            triangles (such as those of texture coordinates).

    Returns:
        float32 (B, H, W, C), 0 where nothing is seen. Attached to ``attributes`` and, through ``raster.u`` and ``raster.v``, to
        the positions that were rasterized.
    """
    check_kind("raster", raster, Raster)
    found = raster._found
    shape = (found.batch, found.height, found.width)
    check_floats("attributes", attributes, ("V", "C"), (found.batch, "V", "C"))
    check_indices("faces", faces, attributes.shape[-2], "rows of attributes")
    check_same("faces", len(faces), found.face_count, "give one row for each triangle that was rasterized")
    check_floats("raster.u", raster.u, shape)
    check_floats("raster.v", raster.v, shape)
    check_devices(attributes=attributes, faces=faces, raster=raster.triangle, u=raster.u, v=raster.v)
    indices = index_array(faces)

    def run(attributes: TensorXf, u: TensorXf, v: TensorXf) -> tuple[TensorXf, ...]:
        result = _raster.interpolate(attributes, replace(found, u=u.array, v=v.array), indices, check_indices=False)
        return (type(result)(result.array, (*shape, result.shape[-1])),)

    return cross(Repeated(run), attributes, raster.u, raster.v)[0]


def build_topology(faces: torch.Tensor, positions: torch.Tensor) -> Topology:
    """Find the edges of a mesh (on the host, once).

    Args:
        faces: integers (F, 3), vertex indices.
        positions: float32 (V, 3), vertices. Vertices at the same place count as one: seams of texture coordinates or normals
            duplicate vertices, but are no boundaries of the surface.
    """
    check_floats("positions", positions, ("V", 3))
    check_indices("faces", faces, len(positions))
    with drjit_turn(check_devices(faces=faces, positions=positions)) as module:
        edges = _raster.build_topology(faces.detach().cpu().numpy(), positions.detach().cpu().numpy(), module.UInt32)
    if not edges.count:
        raise ShadowmapError("faces: all triangles have two corners at the same place, so that the mesh has no edges.")
    return Topology(faces.detach().to(torch.int32).clone(), len(positions), edges)


def antialias(image: torch.Tensor, raster: Raster, positions: torch.Tensor, topology: Topology) -> torch.Tensor:
    """Blend pixels along silhouettes by the share that each side covers, so that silhouettes are differentiable.

    See :func:`shadowmap_dr.raster.antialias`.

    Args:
        image: float32 (B, H, W, C).
        raster: from :func:`rasterize`.
        positions: the clip-space vertices that were rasterized, (V, 4) or (B, V, 4).
        topology: of the mesh that was rasterized.

    Returns:
        float32 (B, H, W, C), attached to ``image`` and, through the silhouettes, to ``positions``.
    """
    check_kind("raster", raster, Raster)
    check_kind("topology", topology, Topology)
    found = raster._found
    count = topology.vertex_count
    check_floats("image", image, (found.batch, found.height, found.width, "C"))
    shapes = [(found.batch, count, 4), (count, 4)]
    check_floats("positions", positions, *(shapes if found.batch == 1 else shapes[:1]))
    check_same("faces of topology", len(topology.faces), found.face_count, "give that of the mesh that was rasterized")
    check_devices(image=image, raster=raster.triangle, positions=positions, topology=topology.faces)

    def run(image: TensorXf, positions: TensorXf) -> tuple[TensorXf, ...]:
        return (_raster.antialias(image, found, positions, topology._edges),)

    return cross(Repeated(run), image, positions)[0]
