"""Parts of machines: plates with holes and rims, threads, teeth, fins."""

from __future__ import annotations

import numpy as np

from .parts import Mesh, box, joined, plate, revolved, rod, rotation, strips, tube, turned


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
    parts = [(points, strips(4, len(outer), True)), rod((0, 0, -0.3), (0, 0, 0.2), 0.25, 40)]
    for degrees, width in ((0, 0.16), (80, 0.1), (150, 0.2), (260, 0.12)):
        a = np.radians(degrees)
        parts.append(box((0.42 * np.cos(a), 0.42 * np.sin(a), 0), (0.5, width, 0.1), rotation(2, degrees)))
    return turned(joined(parts), y=30, x=15)


def heat_sink() -> Mesh:
    """A base with thin fins of uneven heights."""
    parts = [box((0, 0, 0), (2, 0.1, 1.2))]
    parts += [box((-0.95 + 0.1 * k, 0.4 - 0.012 * k, 0), (0.02, 0.7 - 0.024 * k, 1.2)) for k in range(20)]
    return turned(joined(parts), x=25, y=-25)
