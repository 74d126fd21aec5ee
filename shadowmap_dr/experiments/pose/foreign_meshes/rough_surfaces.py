"""Rough surfaces of many triangles, closed and open."""

from __future__ import annotations

import numpy as np

from .parts import Array, Mesh, turned


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


def dense_scan() -> Mesh:
    """A blob of 81,920 triangles with the noise of a scanner."""
    import trimesh

    rng = np.random.default_rng(13)
    ball = trimesh.creation.icosphere(subdivisions=6)
    points = np.asarray(ball.vertices)
    bumps = sum(np.sin(points @ rng.normal(scale=2.5, size=3) + rng.uniform(0, 6)) for _ in range(6)) / 6
    return points * (1 + 0.5 * bumps + 0.003 * rng.normal(size=len(points)))[:, None] * [1, 0.7, 0.8], np.asarray(ball.faces)
