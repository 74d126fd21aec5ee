"""Objects of boxes and prisms."""

from __future__ import annotations

import numpy as np

from .parts import Mesh, box, joined, rod, tube, turned


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


def sponge() -> Mesh:
    """Menger's sponge of two levels, with a corner cut off."""
    parts = []
    for place in np.ndindex(9, 9, 9):
        at = np.array(place)
        solid = all((level == 1).sum() < 2 for level in (at // 3, at % 3))
        if solid and at.sum() < 17:
            parts.append(box(at - 4.0, (1, 1, 1)))
    return turned(joined(parts), y=20, x=10)


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
