"""The plan of a city: blocks between streets, and what stands on them. All from a random generator; metres, z is up."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .solids import Points, Solid, joined, post, prism, rectangle, roof, turned, widened

#: (x0, y0, x1, y1) in metres.
Rectangle = tuple[float, float, float, float]

# Depth of the houses around a courtyard, and height of a storey.
_DEPTH, _STOREY = 14.0, 3.6
# Walls begin so far below the ground, which is uneven.
_SUNK = -2.5
# Blocks are cut until no side is longer.
_LONGEST = 185.0


def blocks(rng: np.random.Generator, area: Rectangle, street: float = 30.0) -> Iterator[Rectangle]:
    """Cut an area into blocks by streets, which are narrower the later they are cut."""
    x0, y0, x1, y1 = area
    if max(x1 - x0, y1 - y0) < _LONGEST:
        yield area
        return
    share, half, narrower = rng.uniform(0.4, 0.6), 0.5 * street, max(13.0, 0.8 * street)
    if x1 - x0 > y1 - y0:
        cut = x0 + share * (x1 - x0)
        parts = (x0, y0, cut - half, y1), (cut + half, y0, x1, y1)
    else:
        cut = y0 + share * (y1 - y0)
        parts = (x0, y0, x1, cut - half), (x0, cut + half, x1, y1)
    for part in parts:
        yield from blocks(rng, part, narrower)


def house(rng: np.random.Generator, quad: Points, height: float) -> Solid:
    """A house: walls, a cornice, eaves, often a ledge above the ground floor, a pitched, broken or flat roof, and chimneys."""
    (x0, y0), (x1, y1) = quad[0], quad[2]
    along_x = x1 - x0 >= y1 - y0
    across = y1 - y0 if along_x else x1 - x0
    parts = [
        prism(quad, _SUNK, height, (0.0, 1.0)),
        prism(rectangle(x0, y0, x1, y1, 0.55), height - 0.5, height, (1.0, 1.0)),
    ]
    if rng.random() < 0.45:
        parts.append(prism(rectangle(x0, y0, x1, y1, 0.25), 1.25 * _STOREY, 1.25 * _STOREY + 0.3))
    kind = rng.choice(["gable", "gable", "gable", "hip", "broken", "flat"])
    eaves = rectangle(x0, y0, x1, y1, 0.7)
    pitch = rng.uniform(0.38, 0.55) * across
    if kind == "flat":
        parts.append(prism(rectangle(x0, y0, x1, y1, -3.0), height, height + 2.6, (1.0, 1.0)))
        top = 2.6
    elif kind == "broken":
        inner = rectangle(x0, y0, x1, y1, -1.4)
        parts += [prism(eaves, height, height + 3.0, (1.0, 1.0), inner), roof(inner, height + 3.0, 0.3 * pitch, along_x, 0.1)]
        top = 3.0 + 0.3 * pitch
    else:
        parts.append(roof(eaves, height, pitch, along_x, 0.22 if kind == "hip" else 0.0))
        top = pitch
    for _ in range(rng.integers(0, 3)):
        u, v = rng.uniform(0.2, 0.8), rng.uniform(0.4, 0.6)
        x, y = (x0 + u * (x1 - x0), y0 + v * (y1 - y0)) if along_x else (x0 + v * (x1 - x0), y0 + u * (y1 - y0))
        stack = prism(rectangle(x - 0.6, y - 0.4, x + 0.6, y + 0.4), height, height + top + rng.uniform(0.8, 1.8), (1.0, 1.0))
        parts.append(stack)
    return joined(parts)


def housing(rng: np.random.Generator, block: Rectangle) -> Iterator[tuple[str, Solid, float]]:
    """Houses around a courtyard and sheds within: (kind, solid, height of the eaves)."""
    x0, y0, x1, y1 = block
    storeys = rng.integers(4, 7)
    inner = (x0 + _DEPTH, y0 + _DEPTH, x1 - _DEPTH, y1 - _DEPTH)
    rows = [
        (x0, y0, x1, inner[1]),
        (x0, inner[3], x1, y1),
        (x0, inner[1], inner[0], inner[3]),
        (inner[2], inner[1], x1, inner[3]),
    ]
    for a0, b0, a1, b1 in rows:
        along_x = a1 - a0 > b1 - b0
        length = max(a1 - a0, b1 - b0)
        count = max(1, round(length / rng.uniform(50, 80)))
        edges = np.linspace(0, 1, count + 1)
        edges[1:-1] += rng.uniform(-0.15, 0.15, count - 1) / count
        for low, high in zip(edges[:-1], edges[1:], strict=True):
            if rng.random() < 0.05:
                continue  # a gap, where a street lets light in
            height = _STOREY * max(2, storeys + rng.integers(-1, 2)) + rng.uniform(0, 1.5)
            if along_x:
                quad = rectangle(a0 + low * (a1 - a0), b0, a0 + high * (a1 - a0), b1)
            else:
                quad = rectangle(a0, b0 + low * (b1 - b0), a1, b0 + high * (b1 - b0))
            yield "house", house(rng, quad, height), height
    width, depth = inner[2] - inner[0], inner[3] - inner[1]
    if min(width, depth) > 25:
        x, y = inner[0] + rng.uniform(0.2, 0.5) * width, inner[1] + rng.uniform(0.2, 0.5) * depth
        height = rng.uniform(5, 15)
        shed = rectangle(x, y, x + 0.35 * width, y + 0.45 * depth)
        yield (
            "shed",
            joined([prism(shed, _SUNK, height, (0, 1)), prism(widened(shed, 0.3), height, height + 0.4, (1, 1))]),
            height,
        )


def square(block: Rectangle) -> Iterator[tuple[str, Solid]]:
    """A square with a high column, statues, lamps, masts for flags and a fountain."""
    x0, y0, x1, y1 = block
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    yield (
        "column",
        joined(
            [post(0, 0, 4.0, -0.5, 1.0), post(0, 0, 2.6, 1.0, 4.0), _shaft(12.0).moved(0, 0, 4.0), _figure(1.2).moved(0, 0, 17.0)]
        ).moved(x, y),
    )
    yield (
        "fountain",
        turned(
            [
                (6.5, -0.5),
                (6.5, 0.9),
                (6.0, 0.9),
                (6.0, 0.4),
                (0.8, 0.4),
                (0.8, 2.2),
                (2.4, 2.8),
                (2.4, 3.0),
                (0.3, 3.0),
                (0.2, 4.5),
            ],
            12,
        ).moved(x - 22, y - 14),
    )
    for i, j in ((-1, 1), (1, 1), (1, -1), (2, 0)):
        yield "statue", joined([post(0, 0, 2.2, -0.5, 2.4), _figure(1.6).moved(0, 0, 2.4)]).moved(x + 16 * i, y + 13 * j)
    for k in range(6):
        px = x0 + (k + 0.5) / 6 * (x1 - x0)
        yield (
            "lamp",
            joined([post(px, y0 + 4, 0.18, -0.5, 6.0), prism(rectangle(px - 0.3, y0 + 3.7, px + 0.3, y0 + 4.3), 6.0, 6.6)]),
        )
        yield "mast", turned([(0.14, -0.5), (0.10, 8.0), (0.05, 15.0)], 6).moved(px, y1 - 5)


def church(block: Rectangle) -> Iterator[tuple[str, Solid, float]]:
    """A church: nave, lower aisles, choir, buttresses and a tower with a spire: (kind, solid, height)."""
    x0, y0, x1, y1 = block
    x, y = 0.5 * (x0 + x1), 0.5 * (y0 + y1)
    length = min(70.0, 0.7 * (x1 - x0))
    a, b = x - 0.5 * length, x + 0.5 * length
    nave = rectangle(a, y - 7, b, y + 7)
    parts = [prism(nave, _SUNK, 22.0, (0, 1)), roof(rectangle(a, y - 7, b, y + 7, 0.5), 22.0, 11.0, True)]
    for low, high in ((y - 14, y - 7), (y + 7, y + 14)):
        parts.append(prism(rectangle(a, low, b, high), _SUNK, 11.0))
        lean = (
            np.array([[0, 1.0], [0, 1.0], [0, 0], [0, 0]]) * (high - low)
            if low < y - 8
            else np.array([[0, 0], [0, 0], [0, -1.0], [0, -1.0]]) * (high - low)
        )
        ridge = rectangle(a, low, b, high) + 0.97 * lean
        parts.append(prism(rectangle(a, low, b, high), 11.0, 16.0, (0, 0), ridge))
    for px in np.linspace(a + 2, b - 2, 8):
        for py in (y - 14.8, y + 14.8):
            parts.append(prism(rectangle(px - 0.5, py - 1.0, px + 0.5, py + 1.0), _SUNK, 13.0))
            parts.append(roof(rectangle(px - 0.5, py - 0.5, px + 0.5, py + 0.5), 13.0, 3.5, True, 0.5, 0.0))
    choir = np.array([[b, y - 6], [b + 7, y - 4], [b + 10, y], [b + 7, y + 4], [b, y + 6]])
    tip = np.array([[b, y - 0.2], [b + 2, y - 0.1], [b + 3, y], [b + 2, y + 0.1], [b, y + 0.2]])
    parts += [prism(choir, _SUNK, 18.0), prism(choir, 18.0, 26.0, (0, 0), tip)]
    yield "church", joined(parts), 22.0
    for sign in (-1, 1):
        yield "tower", _tower(x - 0.5 * length - 5.5, y + 8.0 * sign, 11.0, 62.0), 62.0


def park(rng: np.random.Generator, block: Rectangle) -> Iterator[tuple[str, Solid]]:
    """A park: a fence of bars around it, trees, a statue."""
    x0, y0, x1, y1 = block
    for (ax, ay), (bx, by) in (((x0, y0), (x1, y0)), ((x1, y0), (x1, y1)), ((x1, y1), (x0, y1)), ((x0, y1), (x0, y0))):
        yield "fence", fence((ax, ay), (bx, by), 1.2)
    for _ in range(14):
        x, y = rng.uniform(x0 + 10, x1 - 10), rng.uniform(y0 + 10, y1 - 10)
        size = rng.uniform(0.7, 1.3)
        crown = turned([(0.6, 3.0), (2.6, 4.2), (3.4, 6.5), (2.4, 9.0), (0.3, 10.5)], 7)
        tree = joined([turned([(0.35, -0.5), (0.25, 3.5)], 5), crown])
        yield "tree", Solid(tree.points * size, tree.faces, tree.rise).moved(x, y)
    yield "statue", joined([post(0, 0, 2.2, -0.5, 2.4), _figure(1.6).moved(0, 0, 2.4)]).moved(0.5 * (x0 + x1), 0.5 * (y0 + y1))


def fence(start: tuple[float, float], end: tuple[float, float], spacing: float) -> Solid:
    """Bars 1.9 m high and two rails between two places."""
    a, b = np.array(start), np.array(end)
    along = (b - a) / np.linalg.norm(b - a)
    across = 0.03 * np.array([-along[1], along[0]])
    bars = [post(x, y, 0.08, -0.5, 1.9) for x, y in np.linspace(a, b, int(np.linalg.norm(b - a) / spacing) + 1)]
    strip = np.array([a - across, b - across, b + across, a + across])
    return joined([*bars, *(prism(strip, z, z + 0.07) for z in (0.4, 1.6))])


def _tower(x: float, y: float, width: float, height: float) -> Solid:
    """A tower with a gallery and a spire."""
    h = 0.5 * width
    quad = rectangle(x - h, y - h, x + h, y + h)
    parts = [prism(quad, _SUNK, height, (0, 1))]
    parts += [prism(widened(quad, 0.4), z, z + 0.5, (s, s)) for z, s in ((18.0, 0.0), (36.0, 0.0), (height - 0.5, 1.0))]
    parts.append(roof(widened(quad, 0.2), height, 26.0, True, 0.5))
    for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        corner = rectangle(x + i * h - 0.7, y + j * h - 0.7, x + i * h + 0.7, y + j * h + 0.7)
        parts += [prism(corner, height, height + 3.0, (1, 1)), roof(corner, height + 3.0, 4.0, True, 0.5)]
    return joined(parts)


def _shaft(height: float) -> Solid:
    """A round column with a foot and a capital."""
    return turned([(1.2, 0), (1.2, 0.4), (0.85, 0.8), (0.7, height - 0.8), (1.2, height), (1.2, height + 1.0)], 10)


def _figure(size: float) -> Solid:
    """A standing figure with a raised arm, about 2 m high at size 1."""
    body = turned(
        [(0.42, 0.0), (0.36, 0.5), (0.24, 0.9), (0.30, 1.3), (0.28, 1.5), (0.09, 1.6), (0.14, 1.72), (0.12, 1.95), (0.03, 2.02)],
        8,
    )
    arm = prism(rectangle(0.2, -0.07, 0.34, 0.07), 1.25, 2.2, (0, 0), rectangle(0.62, -0.05, 0.72, 0.05))
    staff = post(0.68, 0.0, 0.06, 0.2, 2.9)
    whole = joined([body, arm, staff])
    return Solid(whole.points * size, whole.faces, whole.rise)
