"""Edges of meshes and anti-aliasing on PyTorch tensors. Functions of :mod:`shadowmap_dr.raster`."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import torch

from .. import raster as _raster
from ..errors import ShadowmapError
from ..jit.types import Bool, Float, TensorXf
from .bridge import drjit_turn, mask_array, to_drjit
from .checks import check_devices, check_flags, check_floats, check_kind, check_same, number_of
from .crossing import Repeated, cross, eager
from .raster import Ranges, parts_of
from .records import FaceSets, Raster, Topology, check_set_images, plain_faces
from .transforms import outside, plain

_FIXED = "give values that are the same for all of the batch"


@eager
def build_topology(faces: torch.Tensor, positions: torch.Tensor, *, ranges: Ranges | None = None) -> Topology:
    """Find the edges of a mesh, or of one mesh for each image (on the host, once). No gradients.

    Args:
        faces: integers (F, 3), vertex indices, or (B, F, 3), those of each image.
        positions: float32 (V, 3) or, for faces of images, (B, V, 3), vertices. Vertices at the same place count as one: seams of
            texture coordinates or normals duplicate vertices, but are no boundaries of the surface.
        ranges: (first face, number of faces) of each image, as given to :func:`rasterize`.
    """
    check_floats("positions", positions, ("V", 3), ("B", "V", 3))
    count = positions.shape[-2]
    indices, sets = plain_faces(faces, count), FaceSets.of(faces, ranges)
    points = plain("positions", positions, _FIXED)
    device = check_devices(faces=indices, positions=points)
    if positions.ndim == 3:
        if sets.shared:
            raise ShadowmapError(f"positions: shape {tuple(points.shape)}, but must be (V, 3) for faces {sets}.")
        check_set_images(sets, len(points))
    places, numbers = (outside(lambda own: own.cpu().numpy().copy(), tensor) for tensor in (points, indices))
    edges = []
    with drjit_turn(device) as module:
        for k, part in enumerate(sets.split(numbers)):
            own = places[k] if places.ndim == 3 else places
            edges.append(_raster.build_topology(part, own, module.UInt32))
    if not all(found.count for found in edges):
        raise ShadowmapError("faces: all triangles have two corners at the same place, so that the mesh has no edges.")
    return Topology(indices.clone(), count, tuple(edges), sets)


@eager
def antialias(
    image: torch.Tensor,
    raster: Raster,
    positions: torch.Tensor,
    topology: Topology,
    *,
    intersections: bool = True,
    creases: torch.Tensor | None = None,
    crease_weights: torch.Tensor | None = None,
    face_normals: torch.Tensor | None = None,
    gap: float = _raster.DEPTH_GAP,
    continued: bool = False,
) -> torch.Tensor:
    """Blend pixels along silhouettes by the share that each side covers, so that silhouettes are differentiable.

    See :func:`shadowmap_dr.raster.antialias`.

    Args:
        image: float32 (B, H, W, C).
        raster: from :func:`rasterize`.
        positions: the clip-space vertices that were rasterized, (V, 4) or (B, V, 4).
        topology: of the mesh that was rasterized.
        intersections: blend (and differentiate) the lines where surfaces pass through each other or touch, too.
        creases: bool (F, 3), or (B, F, 3) as the faces: True if colours jump at the edge from corner k to k + 1 of a face, as on
            flat-shaded meshes. Such edges are blended (and differentiated) like silhouettes.
        crease_weights: float32 (B, H, W), weight of creases at each pixel, 0 to 1; 1 without. No gradients.
        face_normals: float32 (F, 3), or (B, F, 3) as the faces, of any length, in any space: if given, creases between faces in
            one plane do not count. No gradients.
        gap: least depth (``z / w``) between a silhouette and the surface behind it, besides 1e-5 of the depth there. Use 0 for
            depths that keep their relative precision.
        continued: for derivatives by the edges' positions, extrapolate colours linearly from the pixels to the edge instead of
            taking them as constant: right for shaded images, and the same for images of constant colours.

    Returns:
        float32 (B, H, W, C), attached to ``image`` and, through the edges, to ``positions``.
    """
    check_kind("raster", raster, Raster)
    check_kind("topology", topology, Topology)
    size, sets, found, count = raster._size, raster._sets, raster._found, topology.vertex_count
    check_floats("image", image, (*size, "C"))
    shapes = [(size[0], count, 4), (count, 4)]
    check_floats("positions", positions, *(shapes if size[0] == 1 or not sets.shared else shapes[:1]))
    if topology._sets != sets:
        if topology._sets.shared and sets.shared:
            check_same("faces of topology", len(topology.faces), sets.shape[0], "give that of the mesh that was rasterized")
        check_same("faces of topology", str(topology._sets), str(sets), "give that of the mesh that was rasterized")
    check_devices(image=image, raster=raster.triangle, positions=positions, topology=topology.faces)
    for name, value in (("intersections", intersections), ("continued", continued)):
        check_kind(name, value, bool)
    options = _crease_options(creases, crease_weights, face_normals, raster)
    least = number_of("gap", gap, float)
    if not 0 <= least < math.inf:
        raise ShadowmapError(f"gap: {least}; give a finite depth of at least 0.")

    def run(image: TensorXf, positions: TensorXf) -> tuple[TensorXf, ...]:
        images = [one.batch for one in found]
        vertices = [positions.array] * len(found)
        if len(positions.shape) == 3:
            vertices = parts_of(positions.array, images)
        sets_of = zip(parts_of(image.array, images), found, vertices, topology._edges, options, strict=True)
        results = [
            _raster.antialias(values, one, own, edges, meetings=intersections, gap=least, continued=continued, **given)
            for values, one, own, edges, given in sets_of
        ]
        return (type(image)(results[0] if len(results) == 1 else dr.concat(results), image.shape),)

    return cross(Repeated("antialias", run), image, positions)[0]


def _crease_options(
    creases: torch.Tensor | None, weights: torch.Tensor | None, normals: torch.Tensor | None, raster: Raster
) -> list[dict[str, Any]]:
    """Checked arguments of the core's function for each set of faces."""
    sets, found = raster._sets, raster._found
    if creases is None:
        for name, value in (("crease_weights", weights), ("face_normals", normals)):
            if value is not None:
                raise ShadowmapError(f"{name}: given without creases; give these, too.")
        return [{} for _ in found]
    check_flags("creases", creases, sets.shape)
    check_devices(raster=raster.triangle, creases=creases)
    edges = [mask_array(part) for part in sets.split(plain("creases", creases, _FIXED))]
    options: list[dict[str, Any]] = [{"creases": own} for own in edges]
    if weights is not None:
        check_floats("crease_weights", weights, raster._size)
        check_devices(raster=raster.triangle, crease_weights=weights)
        flat = _array(plain("crease_weights", weights, _FIXED))
        for own, weight in zip(options, parts_of(flat, [one.batch for one in found]), strict=True):
            own["crease_weights"] = weight
    if normals is not None:
        check_floats("face_normals", normals, sets.shape)
        check_devices(raster=raster.triangle, face_normals=normals)
        split = sets.split(plain("face_normals", normals, _FIXED))
        for own, flags, part in zip(options, edges, split, strict=True):
            own["folds"] = _coplanar(flags, part)
    return options


def _coplanar(creases: Bool, normals: torch.Tensor) -> _raster.CoplanarCreases:
    return _raster.CoplanarCreases(creases, _array(torch.nn.functional.pad(normals, (0, 1))))


def _array(values: torch.Tensor) -> Float:
    with drjit_turn(values.device):
        flat = to_drjit(values).array
        dr.eval(flat)
    return flat
