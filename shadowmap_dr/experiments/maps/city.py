"""A city that a script makes: some 1.5 km across, with streets, courtyards, pitched roofs, a church, thin and small things.

The same seed and scale give the same city. All shapes are triangle meshes with names; lengths are metres, z is up.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...scene.mitsuba_meshes import make_mesh
from . import city_plan
from .solids import Points, Solid

#: Side of the built area in metres, at scale 1.
SIDE = 1440.0
# Ground beyond the built area, and side of the ground's cells.
_BEYOND, _CELL = 30.0, 36.0
# A square, a church and a park for so many blocks.
_BLOCKS_OF_A_QUARTER = 160


@dataclass(frozen=True)
class Body:
    """A shape of the city.

    Attributes:
        name: its id, such as ``house_012``.
        solid: the mesh, in its place.
        height: of the eaves above the ground, metres; 0 where the height cannot change.
    """

    name: str
    solid: Solid
    height: float = 0.0


@dataclass(frozen=True)
class City:
    """All shapes of a city; ``bodies[0]`` is the ground."""

    bodies: tuple[Body, ...]

    @property
    def buildings(self) -> tuple[Body, ...]:
        """Shapes whose height can change."""
        return tuple(body for body in self.bodies if body.height > 0)

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return sum(len(body.solid.faces) for body in self.bodies)

    def body(self, name: str) -> Body:
        """The shape of that name."""
        return next(body for body in self.bodies if body.name == name)

    def building_points(self, building: int, height: float) -> npt.NDArray[np.float32]:
        """Vertices (V, 3), metres, of a building whose eaves lie ``height`` metres above the ground; faces stay as they are."""
        body = self.buildings[building]
        points = body.solid.points.copy()
        points[:, 2] += (height - body.height) * body.solid.rise
        return points.astype(np.float32)

    def meshes(self) -> dict[str, mi.Mesh]:
        """Mitsuba's meshes by name, flat shaded, of one grey material on both sides."""
        material = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse"}})
        return {body.name: make_mesh(body.name, body.solid.points, body.solid.faces, material) for body in self.bodies}


def make_city(seed: int = 3, scale: float = 1.0) -> City:
    """Make a city.

    Args:
        seed: of the random generator.
        scale: area relative to 1440 x 1440 m, and roughly the number of shapes and triangles relative to those at 1.
    """
    rng = np.random.default_rng(seed)
    half = 0.5 * SIDE * np.sqrt(scale)
    shape = _Terrain(rng)
    counts: dict[str, int] = {}
    bodies = [Body("ground", shape.ground(half + _BEYOND))]
    for kind, solid, height in _contents(rng, half):
        number = counts[kind] = counts.get(kind, -1) + 1
        bodies.append(Body(f"{kind}_{number:03d}", shape.placed(solid), height))
    return City(tuple(bodies))


def _contents(rng: np.random.Generator, half: float) -> Iterator[tuple[str, Solid, float]]:
    """Everything on the ground before it is bent: (kind, solid, changeable height or 0)."""
    found = list(city_plan.blocks(rng, (-half, -half, half, half)))
    found.sort(key=lambda b: float(np.hypot(b[0] + b[2], b[1] + b[3])))
    for index, block in enumerate(found):
        place = index % _BLOCKS_OF_A_QUARTER
        if place == 0:
            yield from ((kind, solid, 0.0) for kind, solid in city_plan.square(block))
        elif place == 1:
            yield from city_plan.church(block)
        elif place == 4:
            yield from ((kind, solid, 0.0) for kind, solid in city_plan.park(rng, block))
        else:
            yield from city_plan.housing(rng, block)


class _Terrain:
    """Uneven ground and bent streets: sums of long waves."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.phases = rng.uniform(0, 2 * np.pi, (3, 3))

    def bent(self, points: Points) -> Points:
        """Points (..., 2) of the plan in their places: straight streets become bends."""
        x, y = points[..., 0], points[..., 1]
        p = self.phases
        dx = 12 * np.sin(2 * np.pi * y / 710 + p[0, 0]) + 9 * np.sin(2 * np.pi * (x + 2 * y) / 900 + p[0, 1])
        dy = 11 * np.sin(2 * np.pi * x / 630 + p[1, 0]) + 9 * np.sin(2 * np.pi * (2 * x - y) / 980 + p[1, 1])
        return np.stack([x + dx, y + dy], -1)

    def height(self, points: Points) -> Points:
        """Height of the ground, metres, at places (..., 2) of the plan: waves, and a hollow in the middle."""
        x, y = points[..., 0], points[..., 1]
        p = self.phases[2]
        waves = 1.2 * np.sin(2 * np.pi * x / 470 + p[0]) + 1.2 * np.sin(2 * np.pi * (x - 1.4 * y) / 690 + p[1])
        return waves + 0.5 * np.sin(2 * np.pi * (x + y) / 210 + p[2]) - 3.0 * np.exp(-(x**2 + y**2) / 2 / 220**2)

    def ground(self, half: float) -> Solid:
        """The ground as a grid of triangles."""
        n = int(np.ceil(2 * half / _CELL)) + 1
        line = np.linspace(-half, half, n)
        plan = np.stack(np.meshgrid(line, line, indexing="ij"), -1).reshape(-1, 2)
        points = np.column_stack([self.bent(plan), self.height(plan)])
        a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
        faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
        return Solid(points, faces.astype(np.uint32), np.zeros(len(points)))

    def placed(self, solid: Solid) -> Solid:
        """A solid of the plan on the ground below its middle."""
        low, high = solid.points[:, :2].min(0), solid.points[:, :2].max(0)
        base = float(self.height(0.5 * (low + high)))
        points = np.column_stack([self.bent(solid.points[:, :2]), solid.points[:, 2] + base])
        return replace(solid, points=points)
