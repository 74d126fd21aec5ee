"""Results of the raster functions: visible triangles and edges, of images that show the same triangles or different ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import torch

from .. import raster as _raster
from ..errors import ShadowmapError
from ..raster import RasterOutput
from .checks import check_face_shape, check_indices, check_kind, number_of
from .transforms import plain

_ArrayT = TypeVar("_ArrayT", torch.Tensor, np.ndarray)

_SHARED = "give indices that are the same for all of the batch"


@dataclass(frozen=True)
class FaceSets:
    """The faces that the images of a batch show.

    Attributes:
        shape: of the faces: (F, 3), or (B, F, 3) with faces for each image.
        ranges: (first face, number of faces) of each image; None if they all show all faces (F, 3).
    """

    shape: tuple[int, ...]
    ranges: tuple[tuple[int, int], ...] | None

    @classmethod
    def of(cls, faces: torch.Tensor, ranges: Sequence[tuple[int, int]] | torch.Tensor | None) -> FaceSets:
        """From a caller's arguments. Raises ShadowmapError if they do not fit each other."""
        check_face_shape("faces", faces, batched=True)
        shape = tuple(faces.shape)
        if ranges is None:
            return cls(shape, None)
        if len(shape) == 3:
            raise ShadowmapError(f"ranges: given beside faces {shape}; give faces (F, 3) with them.")
        return cls(shape, tuple(_checked_range(k, each, shape[0]) for k, each in enumerate(_listed(ranges))))

    @property
    def count(self) -> int:
        """Number of sets: 1 if all images show the same faces, else one for each image."""
        if self.ranges is not None:
            return len(self.ranges)
        return self.shape[0] if len(self.shape) == 3 else 1

    @property
    def shared(self) -> bool:
        """True if all images show the same faces."""
        return self.ranges is None and len(self.shape) == 2

    def split(self, values: _ArrayT) -> list[_ArrayT]:
        """The part of each set in values (F, ...) or (B, F, ...) of faces."""
        if self.ranges is not None:
            return [values[first : first + count] for first, count in self.ranges]
        return list(values) if len(self.shape) == 3 else [values]

    def starts(self) -> list[int]:
        """Index of the first face of each set."""
        return [0] * self.count if self.ranges is None else [first for first, _ in self.ranges]

    def __str__(self) -> str:
        return f"{self.shape}" if self.ranges is None else f"{self.shape} in ranges {list(self.ranges)}"


@dataclass(frozen=True)
class Raster:
    """Triangles that the pixels of B images see.

    Attributes:
        triangle: int32 (B, H, W), index of the visible triangle in the faces (F, 3), or in those of its image where faces are
            (B, F, 3); -1 for none.
        u, v: float32 (B, H, W), perspective-correct weights of the triangle's vertices 1 and 2 (vertex 0 has ``1 - u - v``).
        depth: float32 (B, H, W), ``z / w`` in clip space, 1 (the far plane) where nothing is seen.

    ``u``, ``v`` and ``depth`` are attached to the positions, for a fixed visible triangle; :func:`antialias` differentiates
    changes of visibility. Read only: the other functions ignore a changed ``triangle``.
    """

    triangle: torch.Tensor
    u: torch.Tensor
    v: torch.Tensor
    depth: torch.Tensor
    _found: tuple[RasterOutput, ...] = field(repr=False)  # one for each set
    _sets: FaceSets = field(repr=False)

    @property
    def covered(self) -> torch.Tensor:
        """Bool (B, H, W): whether a pixel sees a triangle."""
        return self.triangle >= 0

    @property
    def _size(self) -> tuple[int, int, int]:
        """(B, H, W)."""
        one = self._found[0]
        return sum(found.batch for found in self._found), one.height, one.width


@dataclass(frozen=True)
class Topology:
    """Edges of a mesh, or of one mesh for each image, from :func:`build_topology`. Valid as long as the faces stay the same.

    Attributes:
        faces: int32 (F, 3) or (B, F, 3), vertex indices.
        vertex_count: number of vertices V.
    """

    faces: torch.Tensor
    vertex_count: int
    _edges: tuple[_raster.Topology, ...] = field(repr=False)  # one for each set
    _sets: FaceSets = field(repr=False)

    @property
    def _single(self) -> _raster.Topology:
        """The edges of one mesh. Raises ShadowmapError if there are several."""
        if not self._sets.shared:
            raise ShadowmapError(f"topology: of faces {self._sets}; give that of one mesh, with faces (F, 3).")
        return self._edges[0]


def plain_faces(faces: torch.Tensor, count: int, what: str = "vertices") -> torch.Tensor:
    """The (checked) numbers of faces, int32 (F, 3) or (B, F, 3)."""
    check_face_shape("faces", faces, batched=True)
    numbers = plain("faces", faces, _SHARED)
    check_indices("faces", numbers.reshape(-1, 3), count, what)
    return numbers.to(torch.int32)


def pieces(sizes: Sequence[int], length: int) -> Iterator[tuple[int, int]]:
    """(start, end) of consecutive parts of ``sizes`` (images, for instance) with ``length`` numbers each."""
    start = 0
    for size in sizes:
        yield start, start + size * length
        start += size * length


def _listed(ranges: Sequence[tuple[int, int]] | torch.Tensor) -> Sequence[tuple[int, int]]:
    if isinstance(ranges, torch.Tensor):
        found = plain("ranges", ranges, _SHARED).tolist()
        ranges = found if isinstance(found, list) else []
    check_kind("ranges", ranges, list, tuple)
    if not ranges:
        raise ShadowmapError("ranges: empty; give (first face, number of faces) for each image.")
    return ranges


def _checked_range(k: int, given: object, most: int) -> tuple[int, int]:
    if not isinstance(given, list | tuple) or len(given) != 2:
        raise ShadowmapError(f"ranges[{k}]: {given!r}, but must be (first face, number of faces).")
    first, count = (number_of(f"ranges[{k}]", number, int) for number in given)
    if first < 0 or count < 1 or first + count > most:
        raise ShadowmapError(f"ranges[{k}]: ({first}, {count}); there are {most} faces, and each image shows one or more.")
    return first, count


def check_set_images(sets: FaceSets, batch: int | None) -> int:
    """Number of images of positions (``batch`` None: the same for all). Raises ShadowmapError if faces are for other ones."""
    if sets.shared:
        return 1 if batch is None else batch
    if batch is not None and batch != sets.count:
        raise ShadowmapError(f"positions: of {batch} images, but faces {sets} are for {sets.count}; give one set for each image.")
    return sets.count
