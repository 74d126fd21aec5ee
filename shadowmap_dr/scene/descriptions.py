"""Descriptions of a scene's shapes, made once: validation of their buffers, and a ``ShapeInfo`` for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .geometry import ShapeInfo, rows_of, with_faces
from .mitsuba_meshes import has_reversed_faces
from .mitsuba_objects import is_even
from .shapes.sources import ShapeSource

# Most squared distance of vertices from a common plane, relative to the shape's squared extent, for a planar shape.
_FLAT = 1e-10
# Faces of each shape that a first, cheap test of planarity looks at.
_TRIED = 6


@dataclass(frozen=True)
class Parts:
    """Buffers of several shapes, one after the other: S shapes, V vertices, F faces.

    points, normals  float32 (V, 3), as Mitsuba holds them; normals are 0 for shapes without
    faces            (F, 3), counted from each shape's own first vertex
    vertex_counts, face_counts  (S,)
    """

    points: npt.NDArray[np.float32]
    normals: npt.NDArray[np.float32]
    faces: npt.NDArray[np.uint32]
    vertex_counts: npt.NDArray[np.int64]
    face_counts: npt.NDArray[np.int64]

    def only(self, shapes: npt.NDArray[np.bool_]) -> Parts:
        """The buffers of some of the shapes."""
        if shapes.all():
            return self
        counts = self.vertex_counts[shapes], self.face_counts[shapes]
        vertices, faces = rows_of(self.vertex_starts[shapes], counts[0]), self.face_rows(shapes)
        return Parts(self.points[vertices], self.normals[vertices], self.faces[faces], *counts)

    def face_rows(self, shapes: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
        """Rows of the faces of some of the shapes."""
        return rows_of(self.face_starts[shapes], self.face_counts[shapes])

    @property
    def vertex_starts(self) -> npt.NDArray[np.int64]:
        """First vertex of each shape."""
        return np.cumsum(self.vertex_counts) - self.vertex_counts

    @property
    def face_starts(self) -> npt.NDArray[np.int64]:
        """First face of each shape."""
        return np.cumsum(self.face_counts) - self.face_counts


def describe_all(
    names: Sequence[str],
    sources: Sequence[ShapeSource],
    held: Sequence[tuple[bool, bool]],
    mirrored: tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]],
    parts: Parts,
) -> tuple[ShapeInfo, ...]:
    """Validate the buffers of all shapes and describe them.

    ``held``: (has normals, has texture coordinates) of each shape. ``mirrored``: see ``Soup.mirrored``.

    Raises:
        ShadowmapError: a mesh is broken.
    """
    _validate(names, parts)
    own, placed = mirrored
    meshes = np.array([isinstance(source.shape, mi.Mesh) for source in sources])
    kinds = [source.shape.class_name() for source in sources]
    has_normals = np.array([normals for normals, _ in held])
    # A mirrored cylinder has its normals on the other side: they are computed from its parametrisation.
    turned_over = own & ~meshes
    reversed_ = turned_over != placed
    inverted = turned_over & np.array([kind == "Cylinder" for kind in kinds])
    flipped = np.array([has_reversed_faces(source.shape) for source in sources]) != inverted
    # Mitsuba computes normals from the winding once vertices change; those of a rectangle never change.
    turned = _turned(parts, has_normals & np.array([kind == "Rectangle" for kind in kinds]))
    faceted, planar = _faceted(parts, meshes & has_normals & ~reversed_), _planar(parts)
    see_through: dict[mi.BSDF, bool] = {}
    even: dict[mi.BSDF, bool] = {}
    infos = []
    columns = (reversed_, flipped, turned, faceted, planar)
    sizes = (parts.vertex_starts, parts.vertex_counts, parts.face_starts, parts.face_counts)
    rows = zip(*(column.tolist() for column in (*columns, *sizes)), strict=True)
    for name, source, kind, (normals, texcoords), row in zip(names, sources, kinds, held, rows, strict=True):
        mirrored_, flip, turn, facets, flat, first_vertex, vertices, first_face, faces = row
        bsdf = source.shape.bsdf()
        if bsdf not in see_through:
            see_through[bsdf] = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)
            even[bsdf] = is_even(bsdf)
        emitter = source.shape.emitter()
        infos.append(
            ShapeInfo(
                name=name,
                plugin=kind,
                vertex_start=first_vertex,
                vertex_count=vertices,
                face_start=first_face,
                face_count=faces,
                has_normals=normals,
                has_texcoords=texcoords,
                flip_geometric=flip != mirrored_,
                flip_shading=flip,
                reads_attributes=isinstance(source.shape, mi.Mesh) and source.shape.has_mesh_attributes(),
                planar=flat,
                against_winding=mirrored_ != turn,
                see_through=see_through[bsdf],
                unseen=bsdf.class_name() == "Null" and emitter is None,
                varied=not even[bsdf] or not (emitter is None or is_even(emitter)),
                faceted=facets,
            )
        )
    return tuple(infos)


def _validate(names: Sequence[str], parts: Parts) -> None:
    empty = np.flatnonzero((parts.vertex_counts == 0) | (parts.face_counts == 0))
    if len(empty):
        k = int(empty[0])
        counts = f"{parts.vertex_counts[k]} vertices, {parts.face_counts[k]} faces"
        raise ShadowmapError(f"Shape '{names[k]}' is an empty mesh ({counts}): remove it.")
    if not np.isfinite(parts.points).all():
        bad = np.flatnonzero(~np.isfinite(parts.points).all(-1))
        k = int(np.searchsorted(parts.vertex_starts, bad[0], "right")) - 1
        where, point = f"Vertex {bad[0] - parts.vertex_starts[k]} of shape '{names[k]}'", parts.points[bad[0]].tolist()
        raise ShadowmapError(f"{where} is {point}: positions must be finite.")
    bad = np.flatnonzero(np.maximum.reduceat(parts.faces.ravel(), 3 * parts.face_starts) >= parts.vertex_counts)
    if len(bad):
        k = int(bad[0])
        count, faces = parts.vertex_counts[k], parts.faces[parts.face_starts[k] :][: parts.face_counts[k]]
        face = int(np.argmax(faces.max(-1) >= count))
        where = f"Face {face} of shape '{names[k]}' refers to vertex {faces[face].max()}"
        raise ShadowmapError(f"{where}, but there are only {count} vertices.")


def _corners(parts: Parts, shapes: npt.NDArray[np.bool_]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(faces (K, 3) of some shapes, indexing all vertices; first face of each of these shapes; their corners (K, 3, 3))."""
    counts = parts.face_counts[shapes]
    faces = parts.faces[parts.face_rows(shapes)] + np.repeat(parts.vertex_starts[shapes], counts)[:, None]
    return faces, np.cumsum(counts) - counts, parts.points[faces].astype(np.float64)


def _faceted(parts: Parts, shapes: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """True if the vertex normals are the normals of the faces; False for all but the given shapes."""
    found = np.zeros_like(shapes)
    if shapes.any():
        faces, starts, corners = _corners(parts, shapes)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1)
        normal /= np.where(length > 0, length, 1)[:, None]
        near = np.abs(parts.normals[faces] - normal[:, None]).max((1, 2)) < 1e-6
        found[shapes] = np.logical_and.reduceat((length > 0) & near, starts)
    return found


def _turned(parts: Parts, shapes: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """True if the vertex normals oppose the winding of the faces; False for all but the given shapes."""
    found = np.zeros_like(shapes)
    if shapes.any():
        faces, starts, corners = _corners(parts, shapes)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        found[shapes] = np.add.reduceat((normal * parts.normals[faces].sum(1)).sum(1), starts) < 0
    return found


def _planar(parts: Parts) -> npt.NDArray[np.bool_]:
    """True if all vertices of a shape that belong to faces lie in one plane."""
    found = _may_be_planar(parts)
    if found.any():
        found[found] = _in_one_plane(parts.only(found))
    return found


def _may_be_planar(parts: Parts) -> npt.NDArray[np.bool_]:
    """False for most shapes that are not planar, judged by the corners of a few of their faces."""
    chosen = parts.face_starts[:, None] + np.linspace(0, parts.face_counts - 1, _TRIED).astype(np.int64).T
    corners = parts.faces[chosen].reshape(len(chosen), -1) + parts.vertex_starts[:, None]
    points = parts.points[corners].astype(np.float64)
    points -= points.mean(1, keepdims=True)
    least = np.linalg.eigvalsh(np.einsum("spi,spj->sij", points, points))[:, 0]
    low, high = (end.reduceat(parts.points, parts.vertex_starts).astype(np.float64) for end in (np.minimum, np.maximum))
    extent = (high - low).T
    # The sum over all vertices is at most that of a box's diagonals; a corner counts as often as it is chosen.
    return least <= 2 * 3 * _TRIED * _FLAT * parts.vertex_counts * (extent**2).sum(0)


def _in_one_plane(parts: Parts) -> npt.NDArray[np.bool_]:
    used = with_faces(parts.faces + np.repeat(parts.vertex_starts, parts.face_counts)[:, None], len(parts.points))
    points, counts, starts = parts.points, parts.vertex_counts, parts.vertex_starts
    if not used.all():
        counts = np.add.reduceat(used.astype(np.int64), starts)
        points, starts = points[used], np.cumsum(counts) - counts
    moments = np.empty((len(counts), 3, 3))
    columns = [column.astype(np.float64) for column in points.T]
    centred = [column - np.repeat(np.add.reduceat(column, starts) / counts, counts) for column in columns]
    for i in range(3):
        for j in range(i + 1):
            moments[:, i, j] = moments[:, j, i] = np.add.reduceat(centred[i] * centred[j], starts)
    spread = np.linalg.eigvalsh(moments)
    return spread[:, 0] <= _FLAT * spread[:, 2]
