"""Meshes as users bring them, made from formulas: thin bars, plates with rims, loose parts, needles, plants of single faces.

None is symmetric about the vertical axis, nor nearly so within the range of the starts: such an object has no pose to be found.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Mesh = tuple[Array, Array]


def joined(parts: Iterable[Mesh]) -> Mesh:
    """One mesh of several, (V, 3) vertices and (F, 3) faces, without common vertices."""
    vertices: list[Array] = []
    faces: list[Array] = []
    count = 0
    for points, corners in parts:
        vertices.append(np.asarray(points, np.float64))
        faces.append(np.asarray(corners, np.int64) + count)
        count += len(points)
    return np.concatenate(vertices), np.concatenate(faces)


def box(centre: Sequence[float] | Array, size: Sequence[float] | Array, turn: Array | None = None) -> Mesh:
    """A box of 12 triangles, turned by a matrix (3, 3) about its centre."""
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * np.asarray(size)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [corner for a, b, c, d in quads for corner in ((a, b, c), (a, c, d))]
    return corners @ (np.eye(3) if turn is None else turn).T + np.asarray(centre), np.array(faces)


def tube(path: Array, radius: float | Array, sides: int = 8, closed: bool = False) -> Mesh:
    """A tube around a path (n, 3), with flat ends unless it is closed. The radius may change along it."""
    path = np.asarray(path, np.float64)
    n = len(path)
    along = np.roll(path, -1, 0) - np.roll(path, 1, 0) if closed else np.gradient(path, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normal = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    rings = []
    angle = 2 * np.pi * np.arange(sides) / sides
    for k in range(n):
        normal = normal - (normal @ along[k]) * along[k]
        normal /= np.linalg.norm(normal)
        other = np.cross(along[k], normal)
        r = np.broadcast_to(radius, n)[k]
        rings.append(path[k] + r * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * other))
    vertices = np.concatenate(rings)
    faces = _strips(n, sides, closed)
    if closed:
        return vertices, faces
    last = (n - 1) * sides
    caps = [(0, k + 1, k) for k in range(1, sides - 1)] + [(last, last + k, last + k + 1) for k in range(1, sides - 1)]
    return vertices, np.concatenate([faces, caps])


def rod(start: Sequence[float] | Array, end: Sequence[float] | Array, radius: float, sides: int = 8) -> Mesh:
    """A straight bar between two points."""
    return tube(np.array([start, end]), radius, sides)


def revolved(profile: Array, sides: int) -> Mesh:
    """A surface of revolution about the y axis of a profile (n, 2) of radii and heights, closed if the profile is."""
    angle = 2 * np.pi * np.arange(sides) / sides
    r, y = np.asarray(profile, np.float64).T
    rings = [np.stack([a * np.cos(angle), np.full(sides, h), a * np.sin(angle)], 1) for a, h in zip(r, y, strict=True)]
    return np.concatenate(rings), _strips(len(r), sides, False)[:, ::-1]


def _strips(rings: int, sides: int, closed: bool) -> Array:
    """Triangles (F, 3) between neighbouring rings of vertices."""
    i, j = np.meshgrid(np.arange(rings if closed else rings - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = (i + 1) % rings * sides + j, (i + 1) % rings * sides + (j + 1) % sides
    return np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])


def turned(mesh: Mesh, x: float = 0, y: float = 0, z: float = 0, move: Sequence[float] = (0, 0, 0)) -> Mesh:
    """A mesh turned about x, then y, then z (degrees), then moved."""
    matrix = np.eye(3)
    for axis, degrees in ((0, x), (1, y), (2, z)):
        matrix = rotation(axis, degrees) @ matrix
    return mesh[0] @ matrix.T + np.asarray(move), mesh[1]


def rotation(axis: int, degrees: float) -> Array:
    """Matrix (3, 3) of a rotation about a coordinate axis."""
    s, c = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    matrix, (a, b) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
    matrix[a, a] = matrix[b, b] = c
    matrix[b, a], matrix[a, b] = s, -s
    return matrix


def plate(cells: Sequence[str], thickness: float, sides: int = 24) -> Mesh:
    """A plate in the xy plane, of squares of side 1: ``#`` full, ``o`` and ``O`` with a small or a large hole, ``.`` none.

    Holes have rims: rings of 0.05 that stand out on both sides.
    """
    angle = 2 * np.pi * np.arange(sides) / sides + np.pi / 4
    unit = np.stack([np.cos(angle), np.sin(angle)], 1)
    square = 0.5 * unit / np.abs(unit).max(1, keepdims=True)
    parts = []
    h = thickness / 2
    for row, line in enumerate(cells):
        for column, cell in enumerate(line):
            at = np.array([column, -row, 0.0])
            if cell == "#":
                parts.append(box(at, (1, 1, thickness)))
            elif cell in "oO":
                hole = {"o": 0.22, "O": 0.38}[cell]
                loops = [(square, h), (unit * (hole + 0.05), h), (unit * (hole + 0.05), 2 * h), (unit * hole, 2 * h)]
                loops += [(loop, -z) for loop, z in reversed(loops)]
                points = np.concatenate([np.column_stack([loop, np.full(sides, z)]) for loop, z in loops]) + at
                parts.append((points, _strips(len(loops), sides, True)))
    return joined(parts)


def frame() -> Mesh:
    """Edges of an uneven box with some diagonals, as bars a third of a pixel wide at 128 x 128."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-0.8, 0.8) for z in (-0.5, 0.5)]) * [1, 1, 1]
    corners[3] *= 0.6
    corners[6] *= [0.7, 0.5, 1]
    pairs = [(0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7), (0, 7), (2, 5)]
    return joined(rod(corners[a], corners[b], 0.012, 6) for a, b in pairs)


def crane() -> Mesh:
    """A mast and a jib of thin bars."""
    parts = []
    for k in range(10):
        y, z = 0.2 * k, 0.2
        ring = np.array([[0, y, 0], [z, y, 0], [z, y, z], [0, y, z]])
        for i in range(4):
            parts += [rod(ring[i], ring[i] + [0, z, 0], 0.01, 5), rod(ring[i], ring[(i + 1) % 4], 0.01, 5)]
            parts.append(rod(ring[i], ring[(i + 1) % 4] + [0, z, 0], 0.007, 5))
    for k in range(-4, 10):
        x = 0.2 * k
        tri = np.array([[x, 2, 0], [x, 2, 0.2], [x, 2.17, 0.1]])
        for i in range(3):
            parts += [rod(tri[i], tri[i] + [0.2, 0, 0], 0.01, 5), rod(tri[i], tri[(i + 1) % 3], 0.007, 5)]
            parts.append(rod(tri[i], tri[(i + 1) % 3] + [0.2, 0, 0], 0.007, 5))
    parts += [box((-0.7, 1.85, 0.1), (0.3, 0.3, 0.25)), rod((1.4, 2, 0.1), (1.4, 1.2, 0.1), 0.008, 5)]
    return joined(parts)


def cad_plate() -> Mesh:
    """A plate with holes of two sizes and rims around them."""
    return turned(plate(("o##O#", "#O##o", "o###.", "##O..", "o#..."), 0.12, 40), y=25)


def bracket() -> Mesh:
    """Two plates at a right angle, with holes and a rib."""
    one = plate(("o#o", "#O#", "###"), 0.2, 32)
    other = turned(plate(("#O", "o#", "##"), 0.2, 32), x=90, move=(0, -2.4, 1.0))
    rib = np.array([[1.4, -2.4, 0], [1.4, -2.4, 1.6], [1.4, -0.8, 0], [1.5, -2.4, 0], [1.5, -2.4, 1.6], [1.5, -0.8, 0]])
    faces = np.array([[0, 1, 2], [3, 5, 4], [0, 3, 1], [1, 3, 4], [1, 4, 2], [2, 4, 5], [0, 2, 3], [2, 5, 3]])
    return turned(joined([one, other, (rib, faces)]), y=-35)


def flange() -> Mesh:
    """A disk with a neck, uneven bolts and thin steps."""
    profile = np.array([[0.3, 0], [1, 0], [1, 0.03], [0.97, 0.03], [0.97, 0.06], [1, 0.06], [1, 0.15], [0.5, 0.17], [0.5, 0.6],
                        [0.53, 0.6], [0.53, 0.65], [0.3, 0.65], [0.3, 0]])  # fmt: skip
    parts = [revolved(profile, 64)]
    for degrees in (10, 60, 95, 170, 215, 320):
        a = np.radians(degrees)
        at = np.array([0.75 * np.cos(a), 0.1, 0.75 * np.sin(a)])
        parts += [rod(at, at + [0, 0.25, 0], 0.05, 12), rod(at, at + [0, 0.12, 0], 0.1, 6)]
    return turned(joined(parts), x=60, z=20)


def loose_parts() -> Mesh:
    """Sixty boxes that run through each other, each with its own vertices at all corners of all faces."""
    rng = np.random.default_rng(1)
    parts = []
    for _ in range(60):
        turn = rotation(0, rng.uniform(0, 360)) @ rotation(1, rng.uniform(0, 360))
        parts.append(box(rng.uniform(-0.8, 0.8, 3) * [1, 0.7, 0.6], rng.uniform(0.03, 0.5, 3), turn))
    return _unwelded(joined(parts))


def _unwelded(mesh: Mesh) -> Mesh:
    return mesh[0][mesh[1]].reshape(-1, 3), np.arange(3 * len(mesh[1])).reshape(-1, 3)


def urchin() -> Mesh:
    """A ball with four hundred needles of uneven lengths."""
    rng = np.random.default_rng(2)
    parts = []
    for _ in range(400):
        out = rng.normal(size=3)
        out /= np.linalg.norm(out)
        side = np.cross(out, rng.normal(size=3))
        side *= 0.02 / np.linalg.norm(side)
        other = np.cross(out, side)
        length = 0.5 + 0.5 * rng.random() ** 2 + 0.3 * max(out[0], 0)
        root = 0.35 * out
        points = np.array([root + side, root - 0.5 * side + 0.87 * other, root - 0.5 * side - 0.87 * other, length * out])
        parts.append((points, np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3]])))
    ball = revolved(np.array([[0.4 * np.sin(a), -0.4 * np.cos(a)] for a in np.linspace(0, np.pi, 17)]), 32)
    return joined([*parts, ball])


def palm() -> Mesh:
    """A bent trunk, and fronds whose leaflets are single triangles."""
    rng = np.random.default_rng(3)
    t = np.linspace(0, 1, 20)
    trunk = np.stack([0.35 * t**2, 1.5 * t, 0.1 * t], 1)
    parts = [tube(trunk, 0.07 - 0.035 * t, 8)]
    for k in range(11):
        a = 2 * np.pi * k / 11 + rng.uniform(-0.2, 0.2)
        length, droop = rng.uniform(0.6, 1.0), rng.uniform(0.4, 0.9)
        s = np.linspace(0, 1, 24)[:, None]
        out = np.array([np.cos(a), 0, np.sin(a)])
        spine = trunk[-1] + length * s * out + np.array([0, 1, 0]) * (0.5 * s - (0.5 + droop) * s**2)
        side = np.array([-np.sin(a), 0, np.cos(a)])
        for i in range(23):
            for sign in (-1, 1):
                tip = spine[i] + sign * 0.3 * np.sin(np.pi * (i + 2) / 26) * side + 0.1 * out - [0, 0.12, 0]
                parts.append((np.stack([spine[i], spine[i + 1], tip]), np.array([[0, 1, 2]])))
    return joined(parts)


def screw() -> Mesh:
    """A hexagonal head and a thread of twelve turns."""
    s = np.linspace(0, 12, 12 * 32)
    path = np.stack([0.22 * np.cos(2 * np.pi * s), -0.12 * s, 0.22 * np.sin(2 * np.pi * s)], 1)
    parts = [rod((0, 0, 0), (0, -1.5, 0), 0.2, 32), tube(path, 0.035, 5), rod((0, 0, 0), (0, 0.25, 0), 0.5, 6)]
    return turned(joined(parts), z=65, y=20)


def gear() -> Mesh:
    """A toothed wheel with a keyway, a hub beside its middle and four uneven holes."""
    teeth, depth = 28, 0.15
    steps = np.arange(teeth * 4)
    radius = np.where(steps % 4 < 2, 1.0, 0.86)
    angle = 2 * np.pi * steps / (4 * teeth)
    outer = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    inner = 0.6 * np.stack([np.cos(angle), np.sin(angle)], 1)
    loops = [(outer, depth / 2), (inner, depth / 2), (inner, -depth / 2), (outer, -depth / 2)]
    points = np.concatenate([np.column_stack([loop, np.full(len(loop), z)]) for loop, z in loops])
    parts = [(points, _strips(4, len(outer), True)), rod((0, 0, -0.3), (0, 0, 0.2), 0.25, 40)]
    for degrees, width in ((0, 0.16), (80, 0.1), (150, 0.2), (260, 0.12)):
        a = np.radians(degrees)
        parts.append(box((0.42 * np.cos(a), 0.42 * np.sin(a), 0), (0.5, width, 0.1), rotation(2, degrees)))
    return turned(joined(parts), y=30, x=15)


def lattice() -> Mesh:
    """Struts between the points of an uneven cubic lattice."""
    rng = np.random.default_rng(4)
    n = 4
    grid = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).astype(float)
    points = grid * [1, 0.8, 0.7] + rng.uniform(-0.2, 0.2, grid.shape)
    parts = []
    for i, j, k in np.ndindex(n, n, n):
        for step in np.eye(3, dtype=int):
            a, b, c = np.array([i, j, k]) + step
            if max(a, b, c) < n and rng.random() < 0.85:
                parts.append(rod(points[i, j, k], points[a, b, c], 0.035, 6))
    return joined(parts)


def chair() -> Mesh:
    """A chair with thin legs, slats and one arm."""
    parts = [box((0, 0, 0), (1, 0.05, 1))]
    parts += [rod((x, 0, z), (1.1 * x, -0.9, 1.1 * z), 0.025, 8) for x in (-0.45, 0.45) for z in (-0.45, 0.45)]
    parts += [rod((x, 0, -0.45), (1.1 * x, 1.0, -0.6), 0.025, 8) for x in (-0.45, 0.45)]
    parts += [box((0, y, -0.52 - 0.1 * y), (0.95, 0.06, 0.015)) for y in (0.35, 0.55, 0.75, 0.93)]
    parts += [rod((0.5, 0.4, -0.5), (0.5, 0.4, 0.4), 0.03, 8), rod((0.5, 0.4, 0.4), (0.47, 0, 0.4), 0.02, 8)]
    return turned(joined(parts), y=30)


def letters() -> Mesh:
    """The letters R, 2 and F of small boxes, as an extruded font with serrated edges."""
    glyphs = {
        "R": ("####.", "#...#", "#...#", "####.", "#.#..", "#..#.", "#...#"),
        "2": (".###.", "#...#", "....#", "..##.", ".#...", "#....", "#####"),
        "F": ("#####", "#....", "#....", "####.", "#....", "#....", "#...."),
    }
    parts = []
    for place, glyph in enumerate("R2F"):
        for row, line in enumerate(glyphs[glyph]):
            for column, cell in enumerate(line):
                if cell == "#":
                    parts.append(box((column + 6 * place, -row, 0.3 * place), (1, 1, 1.2)))
    return joined(parts)


def rock() -> Mesh:
    """A ball with rough noise on 20,480 triangles."""
    import trimesh

    rng = np.random.default_rng(5)
    ball = trimesh.creation.icosphere(subdivisions=5)
    points = np.asarray(ball.vertices)
    bumps = np.zeros(len(points))
    for scale in (1.5, 3, 6, 12):
        for _ in range(6):
            bumps += np.sin(points @ rng.normal(scale=scale, size=3) + rng.uniform(0, 6)) / (3 * scale)
    return points * (1 + 0.35 * bumps + 0.02 * rng.normal(size=len(points)))[:, None] * [1, 0.8, 0.7], np.asarray(ball.faces)


def terrain() -> Mesh:
    """A landscape of 12,800 triangles."""
    rng = np.random.default_rng(6)
    n = 80
    x, z = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    y = 0.02 * rng.normal(size=x.shape)
    for scale in (2, 4, 8):
        for _ in range(5):
            a, b = rng.normal(scale=scale, size=2)
            y += np.sin(a * x + b * z + rng.uniform(0, 6)) * 0.25 / scale
    return turned(_sheet(x, y, z), x=35)


def foil() -> Mesh:
    """A crumpled sheet of 7,200 triangles without thickness."""
    rng = np.random.default_rng(7)
    n = 60
    u, v = np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij")
    points = np.stack([u, v, 0 * u], -1)
    for _ in range(25):
        normal = rng.normal(size=2)
        normal /= np.linalg.norm(normal)
        fold = np.abs(u * normal[0] + v * normal[1] - rng.uniform(-0.8, 0.8))
        points += 0.12 * fold[..., None] * rng.normal(size=3)
    return _sheet(*np.moveaxis(points, -1, 0))


def _sheet(x: Array, y: Array, z: Array) -> Mesh:
    rows, columns = x.shape
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).ravel()
    faces = np.concatenate([np.stack([a, a + 1, a + columns + 1], 1), np.stack([a, a + columns + 1, a + columns], 1)])
    return np.stack([x, y, z], -1).reshape(-1, 3), faces


def tangle() -> Mesh:
    """A closed wire in many loops, half a pixel wide at 128 x 128."""
    rng = np.random.default_rng(8)
    t = np.linspace(0, 2 * np.pi, 600, endpoint=False)[:, None]
    path = sum(rng.normal(size=3) * np.sin(k * t + rng.uniform(0, 6, 3)) / k**0.7 for k in range(1, 8))
    path = 0.9 * path / np.abs(path).max()
    return tube(path, 0.018, 8, closed=True)


def heat_sink() -> Mesh:
    """A base with thin fins of uneven heights."""
    parts = [box((0, 0, 0), (2, 0.1, 1.2))]
    parts += [box((-0.95 + 0.1 * k, 0.4 - 0.012 * k, 0), (0.02, 0.7 - 0.024 * k, 1.2)) for k in range(20)]
    return turned(joined(parts), x=25, y=-25)


def wheel() -> Mesh:
    """A rim with thin spokes, four of which are missing, and an axle."""
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    parts = [tube(0.97 * ring, 0.035, 8, closed=True), rod((0, 0, -0.2), (0, 0, 0.2), 0.05, 12)]
    for k in range(32):
        if k not in (3, 4, 11, 20):
            a = 2 * np.pi * k / 32
            end = 0.95 * np.array([np.cos(a), np.sin(a), 0])
            parts.append(rod((0, 0, 0.15 * (-1) ** k), end, 0.006, 5))
    parts.append(box((0.7, 0.7, 0.1), (0.2, 0.15, 0.1)))
    return turned(joined(parts), y=35)


def fence() -> Mesh:
    """Pickets of uneven heights in a bent row."""
    rng = np.random.default_rng(9)
    parts = []
    for k in range(25):
        x = -1 + k / 12
        z = 0.3 * x**2 + 0.1 * x
        high = 0.8 + 0.25 * rng.random()
        parts.append(box((x, high / 2, z), (0.035, high, 0.015)))
    along = np.linspace(-1.02, 1.02, 30)
    row = 0.3 * along**2 + 0.1 * along - 0.02
    parts += [tube(np.stack([along, 0 * along + y, row], 1), 0.015, 5) for y in (0.25, 0.65)]
    return joined(parts)


def stairs() -> Mesh:
    """A spiral of steps around a post, with a railing."""
    parts = [rod((0, -1, 0), (0, 1, 0), 0.05, 16)]
    a = np.linspace(0, 1.6 * np.pi, 18)
    for k, angle in enumerate(a):
        parts.append(turned(box((0.4, 0, 0), (0.75, 0.025, 0.22)), y=-np.degrees(angle), move=(0, -0.95 + 0.1 * k, 0)))
        out = 0.76 * np.array([np.cos(angle), 0, np.sin(angle)])
        parts.append(rod(out + [0, -0.95 + 0.1 * k, 0], out + [0, -0.55 + 0.1 * k, 0], 0.01, 5))
    rail = np.stack([0.76 * np.cos(a), -0.55 + 0.1 * np.arange(18), 0.76 * np.sin(a)], 1)
    return joined([*parts, tube(rail, 0.02, 6)])


def tree() -> Mesh:
    """Branches that fork six times, with leaves of a single triangle."""
    rng = np.random.default_rng(10)
    parts: list[Mesh] = []

    def grow(start: Array, way: Array, length: float, radius: float, level: int) -> None:
        end = start + length * way
        parts.append(tube(np.array([start, end]), np.array([radius, 0.7 * radius]), 6))
        if level == 0:
            for _ in range(5):
                at = start + rng.random() * (end - start)
                parts.append((at + 0.06 * rng.normal(size=(3, 3)), np.array([[0, 1, 2]])))
            return
        for _ in range(2 if level > 1 else 3):
            bend = way + 0.55 * rng.normal(size=3) + [0, 0.15, 0]
            grow(end, bend / np.linalg.norm(bend), length * rng.uniform(0.65, 0.85), 0.7 * radius, level - 1)

    grow(np.array([0.0, -1, 0]), np.array([0.1, 1, 0]), 0.5, 0.05, 6)
    return joined(parts)


def sponge() -> Mesh:
    """Menger's sponge of two levels, with a corner cut off."""
    parts = []
    for place in np.ndindex(9, 9, 9):
        at = np.array(place)
        solid = all((level == 1).sum() < 2 for level in (at // 3, at % 3))
        if solid and at.sum() < 17:
            parts.append(box(at - 4.0, (1, 1, 1)))
    return turned(joined(parts), y=20, x=10)


def grass() -> Mesh:
    """Three hundred blades of a single triangle each."""
    rng = np.random.default_rng(11)
    parts = []
    for _ in range(300):
        root = np.array([rng.uniform(-1, 1), -0.5, rng.uniform(-0.5, 0.5)])
        tip = root + [rng.normal(scale=0.15), rng.uniform(0.3, 1.0) * (1.2 - 0.5 * root[0]), rng.normal(scale=0.15)]
        side = np.array([rng.normal(), 0, rng.normal()]) * 0.02
        parts.append((np.stack([root - side, root + side, tip]), np.array([[0, 1, 2]])))
    return joined(parts)


def crystals() -> Mesh:
    """Pointed prisms that grow from one place."""
    rng = np.random.default_rng(12)
    parts = []
    for _ in range(25):
        way = rng.normal(size=3) * [1, 0.6, 0.8] + [0.3, 0.8, 0]
        way /= np.linalg.norm(way)
        length, radius = rng.uniform(0.4, 1.2), rng.uniform(0.04, 0.16)
        steps = np.array([0, 0.8, 1])[:, None] * length * way
        parts.append(tube(steps, np.array([radius, radius, 0.001]), 6))
    return joined(parts)


def bicycle() -> Mesh:
    """Two wheels of wire, a frame of tubes, a saddle and handlebars."""
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    back, front, seat, head, crank = (np.array([x, y, 0.0]) for x, y in ((-0.6, 0), (0.6, 0), (-0.2, 0.5), (0.42, 0.5), (0, 0)))
    parts = [tube(at + 0.38 * ring, 0.018, 6, closed=True) for at in (back, front)]
    for at in (back, front):
        parts += [rod(at, at + 0.37 * ring[k], 0.004, 4) for k in range(0, 48, 3)]
    pairs = [(back, seat), (back, crank), (crank, seat), (crank, head), (seat, head), (head, front)]
    parts += [rod(a, b, 0.02, 8) for a, b in pairs]
    parts += [rod(head, head + [0, 0.15, 0], 0.015, 6), rod(head + [0, 0.15, -0.25], head + [0, 0.15, 0.25], 0.015, 6)]
    parts += [box(seat + [0, 0.08, 0], (0.25, 0.04, 0.1)), rod(crank + [0, 0, -0.15], crank + [0, 0, 0.15], 0.02, 6)]
    return turned(joined(parts), y=25)


def net() -> Mesh:
    """A hanging net of threads a third of a pixel wide at 128 x 128."""
    t = np.linspace(0, 1, 25)
    parts = []
    for k in range(13):
        s = k / 12
        for u, v in ((t, 0 * t + s), (0 * t + s, t)):
            sag = -0.5 * np.sin(np.pi * u) * (1 - 0.5 * v)
            parts.append(tube(np.stack([2 * u - 1, 1.2 * v + sag, 0.4 * np.sin(3 * u + 2 * v)], 1), 0.01, 5))
    return joined(parts)


def antenna() -> Mesh:
    """A tripod, a mast and rods of decreasing length."""
    parts = [rod((0, 0, 0), (0, 1.2, 0), 0.02, 8), rod((-0.3, 1.2, -0.1), (0.9, 1.25, 0.1), 0.015, 6)]
    parts += [rod((0, 0.4, 0), (0.45 * np.cos(a), -0.4, 0.45 * np.sin(a)), 0.015, 6) for a in (0.3, 2.4, 4.5)]
    for x, half in zip(np.linspace(-0.25, 0.85, 9), np.linspace(0.5, 0.2, 9), strict=True):
        parts.append(rod((x, 1.22, -half), (x, 1.22, half), 0.01, 5))
    return joined(parts)


def dense_scan() -> Mesh:
    """A blob of 81,920 triangles with the noise of a scanner."""
    import trimesh

    rng = np.random.default_rng(13)
    ball = trimesh.creation.icosphere(subdivisions=6)
    points = np.asarray(ball.vertices)
    bumps = sum(np.sin(points @ rng.normal(scale=2.5, size=3) + rng.uniform(0, 6)) for _ in range(6)) / 6
    return points * (1 + 0.5 * bumps + 0.003 * rng.normal(size=len(points)))[:, None] * [1, 0.7, 0.8], np.asarray(ball.faces)


#: Makers by name.
MAKERS: dict[str, Callable[[], Mesh]] = {
    maker.__name__.replace("_", "-"): maker
    for maker in (
        antenna, bicycle, bracket, cad_plate, chair, crane, crystals, dense_scan, fence, flange, foil, frame, gear, grass,
        heat_sink, lattice, letters, loose_parts, net, palm, rock, screw, sponge, stairs, tangle, terrain, tree, urchin, wheel,
    )
}  # fmt: skip
#: Meshes that are written as STL, without common vertices.
UNWELDED = ("bracket", "cad-plate", "flange", "gear", "loose-parts")


def write(name: str, folder: Path) -> Path:
    """Write a mesh of `MAKERS` into a folder, as PLY or STL. Returns its file."""
    import trimesh

    path = folder / f"{name}.{'stl' if name in UNWELDED else 'ply'}"
    folder.mkdir(parents=True, exist_ok=True)
    vertices, faces = MAKERS[name]()
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path
