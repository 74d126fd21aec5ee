"""Plants, whose leaves are single triangles."""

from __future__ import annotations

import numpy as np

from .parts import Array, Mesh, joined, tube


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
