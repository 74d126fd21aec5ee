"""Objects of bars, wires and needles that are about as thin as a pixel."""

from __future__ import annotations

import numpy as np

from .parts import Mesh, box, joined, revolved, rod, tube, turned


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


def tangle() -> Mesh:
    """A closed wire in many loops, half a pixel wide at 128 x 128."""
    rng = np.random.default_rng(8)
    t = np.linspace(0, 2 * np.pi, 600, endpoint=False)[:, None]
    path = sum(rng.normal(size=3) * np.sin(k * t + rng.uniform(0, 6, 3)) / k**0.7 for k in range(1, 8))
    path = 0.9 * path / np.abs(path).max()
    return tube(path, 0.018, 8, closed=True)


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
