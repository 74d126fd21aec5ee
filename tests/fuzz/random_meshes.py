"""Random triangle meshes: sound ones, and ones with every fault that a mesh can have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .values import NUMBERS, chance, pick

_CUBE = np.array([(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)], np.float32)
_CUBE_FACES = np.array(
    [
        (0, 3, 2),
        (0, 2, 1),
        (4, 5, 6),
        (4, 6, 7),
        (0, 1, 5),
        (0, 5, 4),
        (1, 2, 6),
        (1, 6, 5),
        (2, 3, 7),
        (2, 7, 6),
        (3, 0, 4),
        (3, 4, 7),
    ]
)
# Few numbers of vertices and faces: kernels are compiled for some sizes anew.
_SIZES = (3, 8, 20)


@dataclass(frozen=True)
class RandomMesh:
    """Vertices (V, 3) and faces (F, 3).

    Attributes:
        sound: all indices are in range, and all vertices finite and of moderate size.
        usable: all indices are in range, and there is at least one face.
    """

    vertices: npt.NDArray[np.float32]
    faces: npt.NDArray[Any]

    @property
    def usable(self) -> bool:
        return bool(len(self.faces)) and bool(self.faces.min() >= 0 and self.faces.max() < len(self.vertices))

    @property
    def finite(self) -> bool:
        return bool(np.isfinite(self.vertices).all())

    @property
    def moderate(self) -> bool:
        """True if sums of a few coordinates are in the range of single precision, where they are finite at all."""
        return not (np.abs(self.vertices[np.isfinite(self.vertices)]) > 1e37).any()

    @property
    def sound(self) -> bool:
        return self.usable and self.finite and bool(np.abs(self.vertices).max() < 1e4)


def random_mesh(rng: np.random.Generator) -> RandomMesh:
    """A mesh; one of two is sound."""
    vertices, faces = _start(rng)
    if chance(rng, 0.5):
        for _ in range(int(rng.integers(1, 3))):
            vertices, faces = _FAULTS[int(rng.integers(len(_FAULTS)))](rng, vertices, faces)
    return RandomMesh(vertices.astype(np.float32), faces)


def _start(rng: np.random.Generator) -> tuple[Any, Any]:
    kind = rng.integers(3)
    if kind == 0:
        return _CUBE * rng.uniform(0.2, 1.2), _CUBE_FACES
    count = pick(rng, _SIZES)
    vertices = rng.uniform(-1, 1, (count, 3))
    if kind == 1:  # a lattice: many ties
        vertices = np.round(vertices * 3) / 3
    return vertices, rng.integers(0, count, (pick(rng, (1, 12, 24)), 3))


def _bad_vertices(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    changed = np.array(vertices, np.float64)
    for _ in range(int(rng.integers(1, 4))):
        with np.errstate(over="ignore"):
            changed[int(rng.integers(len(changed))), int(rng.integers(3))] = np.float32(pick(rng, NUMBERS))
    return changed, faces


def _all_bad(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return np.full_like(vertices, pick(rng, (np.nan, np.inf, 0.0, 1e38)), np.float64), faces


def _scaled(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return vertices * pick(rng, (1e-38, 1e-20, 1e-6, 1e6, 1e18, 1e37)), faces


def _moved(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return vertices + pick(rng, (1e3, 1e6, 1e20)), faces


def _flat(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return vertices * [pick(rng, (0, 1)), pick(rng, (0, 1)), 0], faces


def _degenerate(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    changed = np.array(faces)
    some = rng.random(len(changed)) < 0.5
    changed[some, 1] = changed[some, 0]
    return vertices, changed


def _duplicates(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return vertices, np.concatenate([faces, faces[:, ::-1], faces])


def _fan(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    """All faces at one edge."""
    rest = np.arange(len(vertices))
    return vertices, np.stack([np.zeros_like(rest), np.ones_like(rest), rest], 1)


def _out_of_range(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    changed = np.array(faces)
    if not len(changed):
        return vertices, changed
    changed[int(rng.integers(len(changed))), int(rng.integers(3))] = pick(rng, (-1, len(vertices), 2**31 - 1, 10**6, -(2**31)))
    return vertices, changed


def _no_faces(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return vertices, faces[:0]


def _one_face(rng: np.random.Generator, vertices: Any, faces: Any) -> tuple[Any, Any]:
    return vertices, faces[:1]


_FAULTS = (
    *(_bad_vertices, _bad_vertices, _all_bad, _scaled, _moved, _flat, _degenerate, _duplicates, _fan),
    *(_out_of_range, _out_of_range, _no_faces, _one_face),
)
