"""Meshes of the problems: those of this package, and everyday things made of simple parts.

All lie in [-1, 1]^3 around the middle of their box, y up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ....io import assets
from ....io.meshes import read_mesh

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """(V, 3) vertices and (F, 3) faces; ``smooth``: shaded with normals of vertices."""

    vertices: Array
    faces: Faces
    smooth: bool


@functools.cache
def mesh(name: str) -> Mesh:
    """A mesh by its name: one of `MADE`, one of this package, or the path of a file."""
    made, smooth = MADE.get(name, (None, name not in _FACETED))
    points, corners = made() if made is not None else read_mesh(assets.mesh(name))
    vertices, faces = np.asarray(points, np.float64), np.asarray(corners, np.uint32)
    low, high = vertices.min(0), vertices.max(0)
    return Mesh((vertices - (low + high) / 2) * (2 / (high - low).max()), faces, smooth)


Part = tuple[Array, npt.NDArray[np.int64]]


def _joined(parts: Sequence[Part]) -> Part:
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    faces = [corners + offset for (_, corners), offset in zip(parts, offsets, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _box(low: Sequence[float], high: Sequence[float]) -> Part:
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return corners.astype(float), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _grid(points: Array, *, closed: tuple[bool, bool]) -> Part:
    """Triangles of a grid (n, m, 3) of points that closes in either direction."""
    n, m = points.shape[:2]
    i, j = np.meshgrid(np.arange(n - (not closed[0])), np.arange(m - (not closed[1])), indexing="ij")
    a, b, c, d = ((i + di) % n * m + (j + dj) % m for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return points.reshape(-1, 3), faces


def _capped(rings: Array) -> Part:
    """A grid (n, m, 3) of rings around an axis, closed by a point at each end."""
    vertices, faces = _grid(rings, closed=(False, True))
    n, m = rings.shape[:2]
    k = np.arange(m)
    ends = [(k, (k + 1) % m, np.full(m, n * m)), ((n - 1) * m + (k + 1) % m, (n - 1) * m + k, np.full(m, n * m + 1))]
    caps = np.concatenate([np.stack(end, -1) for end in ends])
    return _outward(np.concatenate([vertices, rings[[0, -1]].mean(1)]), np.concatenate([faces, caps]))


def _outward(vertices: Array, faces: npt.NDArray[np.int64]) -> Part:
    """A closed part with its faces outwards."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return vertices, faces if np.sum(np.cross(a, b) * c) > 0 else faces[:, ::-1]


def _lathe(profile: Sequence[tuple[float, float]], around: int = 32) -> Part:
    """A body of revolution about y from (radius, height)s, upwards."""
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)
    radius, height = np.array(profile, float).T
    points = [radius[:, None] * np.cos(angle), np.broadcast_to(height[:, None], (len(height), around))]
    return _capped(np.stack([*points, -radius[:, None] * np.sin(angle)], -1)[:, ::-1])


def _tube(path: Array, radius: float | Array, *, closed: bool = False, around: int = 12) -> Part:
    """A tube around a curve (n, 3)."""
    ahead = np.roll(path, -1, 0) - np.roll(path, 1, 0)
    if not closed:
        ahead[0], ahead[-1] = path[1] - path[0], path[-1] - path[-2]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, [0.31, 0.87, 0.38])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(ahead, side)
    angle = np.linspace(0, 2 * np.pi, around, endpoint=False)[:, None]
    size = np.broadcast_to(radius, (len(path),))[:, None, None]
    rings = path[:, None] + size * (np.cos(angle) * side[:, None] + np.sin(angle) * up[:, None])
    return _outward(*_grid(rings, closed=(True, True))) if closed else _capped(rings)


def _ball(centre: Sequence[float], radii: Sequence[float], count: int = 20) -> Part:
    theta = np.linspace(0, np.pi, count + 1)[1:-1]
    vertices, faces = _lathe([(np.sin(t), -np.cos(t)) for t in theta], 2 * count)
    vertices[-1], vertices[-2] = (0, 1, 0), (0, -1, 0)
    if vertices[0, 1] > 0:
        vertices[[-1, -2]] = vertices[[-2, -1]]
    return vertices * np.array(radii) + np.array(centre), faces


def _prism(outline: Array, depth: float) -> Part:
    """An outline (n, 2) that the origin sees all of, along z."""
    rings = np.stack([np.column_stack([outline, np.full(len(outline), z)]) for z in (-depth / 2, depth / 2)])
    vertices, faces = _capped(rings)
    vertices[-2:, :2] = 0
    return vertices, faces


def _chair() -> Part:
    legs = [_box((x, 0, z), (x + 0.1, 0.9, z + 0.1)) for x in (-0.5, 0.4) for z in (-0.5, 0.4)]
    back = [_box((x, 1.0, -0.5), (x + 0.1, 1.7, -0.42)) for x in (-0.5, -0.05, 0.4)]
    return _joined([*legs, *back, _box((-0.55, 0.9, -0.55), (0.55, 1.0, 0.55)), _box((-0.55, 1.7, -0.52), (0.55, 1.95, -0.4))])


def _house() -> Part:
    roof = np.array([[-0.8, 0.8, -1.1], [0.8, 0.8, -1.1], [0, 1.5, -1.1], [-0.8, 0.8, 1.1], [0.8, 0.8, 1.1], [0, 1.5, 1.1]])
    faces = np.array([[0, 2, 1], [3, 4, 5], [0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4], [2, 0, 3], [2, 3, 5]])
    parts = [_box((-0.65, 0, -1), (0.65, 0.8, 1)), (roof, faces), _box((0.3, 0.9, 0.3), (0.5, 1.65, 0.5))]
    return _joined([*parts, _box((0.65, 0, -0.9), (1.1, 0.55, -0.1))])


def _cam() -> Part:
    """A wheel with teeth of different lengths."""
    corners = []
    for k, length in enumerate((0.95, 0.7, 0.9, 0.75, 1.0, 0.8, 0.7, 0.85)):
        middle = 2 * np.pi * k / 8
        corners += [(0.55, middle - 0.38), (length, middle - 0.2), (length, middle + 0.2), (0.55, middle + 0.38)]
    radius, angle = np.array(corners).T
    wheel = _prism(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]), 0.3)
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    return _joined([wheel, _prism(0.2 * np.column_stack([np.cos(turn), np.sin(turn)]), 0.8)])


def _knot() -> Part:
    t = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    ring = 2 + np.cos(3 * t)
    return _tube(np.column_stack([ring * np.cos(2 * t), 1.3 * np.sin(3 * t), ring * np.sin(2 * t)]), 0.42, closed=True)


def _spring() -> Part:
    t = np.linspace(0, 1, 140)
    turn = 2 * np.pi * 3.5 * t
    path = np.column_stack([(1.0 - 0.35 * t) * np.cos(turn), 2.2 * t, (1.0 - 0.35 * t) * np.sin(turn)])
    return _tube(path, 0.14, around=10)


def _bracket() -> Part:
    corners = [(-0.7, 0.15), (0.5, 0.15), (-0.7, 1.0)]
    rib = np.array([[x, y, z] for x, y in corners for z in (-0.1, 0.1)])
    faces = np.array([[0, 4, 2], [1, 3, 5], [0, 2, 3], [0, 3, 1], [2, 4, 5], [2, 5, 3], [4, 0, 1], [4, 1, 5]])
    plates = [_box((-0.9, 0, -0.5), (0.9, 0.15, 0.5)), _box((-0.9, 0.15, -0.5), (-0.7, 1.4, 0.3))]
    return _joined([*plates, (rib, faces), _box((0.55, 0.15, 0.1), (0.8, 0.45, 0.35))])


def _rock() -> Part:
    vertices, faces = _ball((0, 0, 0), (1, 1, 1), 24)
    random = np.random.default_rng(5)
    bump = np.zeros(len(vertices))
    for k in range(9):
        bump += np.sin(vertices @ random.normal(0, 1.2 + 0.35 * k, 3) + random.uniform(0, 6)) / (2 + k)
    return vertices * (1 + 0.28 * bump[:, None]) * np.array([1.0, 0.75, 0.85]), faces


def _glider() -> Part:
    def wing(chord: float, span: float, back: float, x: float, y: float) -> Part:
        corners = [(x, -0.03), (x - chord, -0.03), (x, 0.03), (x - chord, 0.03)]
        inner = np.array([[a, y + b, 0] for a, b in corners])
        outer = np.array([[a - back, y + 0.1 * span + b / 2, 0] for a, b in corners])
        points = np.concatenate([outer - [0, 0, span], inner, outer + [0, 0, span]]).reshape(3, 4, 3)[:, [0, 1, 3, 2]]
        return _capped(points)

    fin = _box((-1.0, 0.05, -0.03), (-0.75, 0.5, 0.03))
    wings = [wing(0.42, 1.0, 0.3, 0.35, 0.05), wing(0.22, 0.4, 0.1, -0.75, 0.1)]
    return _joined([_ball((0, 0, 0), (1.05, 0.16, 0.16)), *wings, fin])


def _stairs() -> Part:
    steps = [_box((-0.9 + 0.36 * k, 0, -0.45), (-0.54 + 0.36 * k, 0.28 * (k + 1), 0.45)) for k in range(5)]
    rail = [_box((-0.76 + 0.72 * k, 0.28 + 0.56 * k, 0.38), (-0.7 + 0.72 * k, 0.75 + 0.56 * k, 0.44)) for k in range(3)]
    return _joined([*steps, *rail])


def _cactus() -> Part:
    bend = np.linspace(0, np.pi / 2, 10)

    def arm(side: float, height: float, reach: float, rise: float, z: float) -> Part:
        curve = [(side * (reach + 0.25 * np.sin(a) - 0.25), height + 0.25 * (1 - np.cos(a)), z) for a in bend]
        path = np.array([(0, height, 0), *curve, (side * reach, height + 0.25 + rise, z)])
        return _joined([_tube(path, 0.14), _ball(path[-1], (0.14, 0.14, 0.14), 8)])

    stem = _joined([_lathe([(0.25, 0), (0.28, 0.5), (0.27, 1.2), (0.24, 1.7)]), _ball((0, 1.7, 0), (0.24, 0.26, 0.24), 10)])
    return _joined([stem, arm(1, 0.6, 0.75, 0.5, 0.1), arm(-1, 0.9, 0.65, 0.25, -0.05), _lathe([(0.42, -0.4), (0.55, 0.02)])])


def _mug() -> Part:
    outside = [(0.6, 0.0), (0.66, 0.05), (0.66, 1.4), (0.62, 1.45), (0.58, 1.4), (0.58, 0.12)]
    turn = np.linspace(-0.45 * np.pi, 0.45 * np.pi, 20)
    handle = _tube(np.column_stack([0.6 + 0.42 * np.cos(turn), 0.75 + 0.45 * np.sin(turn), 0 * turn]), 0.09)
    return _joined([_lathe(outside), handle])


def _arch() -> Part:
    angle = np.linspace(0, np.pi, 17)
    inner, outer = (r * np.column_stack([np.cos(angle), np.sin(angle)]) + [0, 0.7] for r in (0.5, 0.85))
    corners = [(inner, -0.3), (outer, -0.3), (outer, 0.3), (inner, 0.3)]
    rings = np.stack([np.column_stack([side, np.full(len(side), z)]) for side, z in corners], 1)
    legs = [_box((x, 0, -0.3), (x + 0.35, 0.7, 0.3)) for x in (-0.85, 0.5)]
    return _joined([_capped(rings), *legs, _box((0.95, 0, -0.45), (1.3, 0.5, -0.1))])


def _hill() -> Part:
    """A landscape of hills over a square, without a bottom."""
    x, z = np.meshgrid(np.linspace(-1, 1, 49), np.linspace(-1, 1, 49), indexing="ij")
    bumps = ((0.5, -0.3, 0.2, 0.35), (0.35, 0.5, -0.4, 0.25), (0.25, 0.3, 0.6, 0.2), (0.2, -0.6, -0.6, 0.22))
    height = sum(h * np.exp(-((x - a) ** 2 + (z - b) ** 2) / (2 * s * s)) for h, a, b, s in bumps)
    return _grid(np.stack([x, height, z], -1)[:, ::-1], closed=(False, False))


def _crank() -> Part:
    path = np.array([(-1.2, 0, 0), (-0.5, 0, 0), (-0.5, 0.7, 0), (0.2, 0.7, 0), (0.2, 0, 0), (0.8, 0, 0), (0.8, 0, 0.5)], float)
    bars = []
    for a, b in zip(path[:-1], path[1:], strict=True):
        low, high = np.minimum(a, b) - 0.11, np.maximum(a, b) + 0.11
        bars.append(_box(low.tolist(), high.tolist()))
    return _joined([*bars, _ball((-1.25, 0, 0), (0.25, 0.25, 0.25), 12)])


def _tower() -> Part:
    """Boxes on each other, each turned and shifted."""
    boxes = []
    for k, (width, depth, turn) in enumerate(((1.0, 0.8, 0.1), (0.7, 0.75, 0.5), (0.8, 0.4, 1.1), (0.35, 0.5, 0.3))):
        corners, faces = _box((-width / 2, 0.5 * k, -depth / 2), (width / 2, 0.5 * k + 0.5, depth / 2))
        c, s = np.cos(turn), np.sin(turn)
        boxes.append((corners @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + [0.1 * (k % 2), 0, 0.05 * k], faces))
    return _joined(boxes)


def _globe() -> Part:
    return _ball((0, 0, 0), (1, 1, 1), 24)


#: Meshes made here: how, and whether they are smooth.
MADE: dict[str, tuple[Callable[[], Part], bool]] = {
    "arch": (_arch, False),
    "bracket": (_bracket, False),
    "cactus": (_cactus, True),
    "cam": (_cam, False),
    "chair": (_chair, False),
    "crank": (_crank, False),
    "glider": (_glider, False),
    "globe": (_globe, True),
    "hill": (_hill, True),
    "house": (_house, False),
    "knot": (_knot, True),
    "mug": (_mug, False),
    "rock": (_rock, True),
    "spring": (_spring, True),
    "stairs": (_stairs, False),
    "tower": (_tower, False),
}
# Meshes of this package that have edges.
_FACETED = ("teapot",)
