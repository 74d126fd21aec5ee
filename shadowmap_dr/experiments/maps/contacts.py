"""Shadows that touch their casters: a card just above a table, a box, a ledge, cloth, a statue, and a fence far away.

Each scene has a camera and a sun that show the contact. Metres, z is up.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import mitsuba as mi
import numpy as np

from ..common.objects import occluder
from .city_plan import fence as bars
from .solids import Solid, joined, post, prism, rectangle, turned
from .view import Motion, View

#: Width of the table that the camera sees, and the texel of a map of 256 texels over it, metres.
TABLE = 2.5
TEXEL = TABLE / 256
#: Gaps between card and table, in texels.
GAPS = (0.1, 1.0, 10.0)


def _meshes(solids: Mapping[str, Solid]) -> dict[str, mi.Mesh]:
    return {name: occluder(name, solid.points.astype(np.float32), solid.faces) for name, solid in solids.items()}


def _slab(size: float, thickness: float = 0.05) -> Solid:
    """A square plate whose upper side lies at z = 0."""
    return prism(rectangle(-size, -size, size, size), -thickness, 0.0)


def _corners() -> Solid:
    """Small dice near the corners of what the camera sees of the table: maps have to cover all of it."""
    return joined([post(x, y, 0.04, 0.0, 0.04) for x, y in ((-0.55, -0.45), (0.55, -0.45), (-0.75, 0.6), (0.75, 0.6))])


def _table(name: str, caster: str, solid: Solid) -> View:
    """A view of a table from the front, with the sun from the left: shadows leave to the right."""
    half_pixel, height = 0.0018, float(solid.points[:, 2].max())
    motions = {"sun": Motion(min(half_pixel / height, 0.2)), "place": Motion(half_pixel, caster, np.array([[1.0, 0.0, 0.0]]))}
    meshes = _meshes({"table": _slab(1.5), "corners": _corners(), caster: solid})
    origin, target = (0.0, -1.2, 1.9), (0.0, 0.0, 0.0)
    return View(name, meshes, origin, target, 190, 45, fov=45, near=0.05, far=100, motions=motions, caster=caster, along=(1, 0))


def _card(gap: float) -> View:
    """A card of 3 mm above the table, by a gap in texels."""
    low = gap * TEXEL
    return _table(f"card {gap:g}", "card", prism(rectangle(-0.35, -0.25, 0.2, 0.25), low, low + 0.003))


def _box() -> View:
    """A box that stands on the table."""
    return _table("box", "box", prism(rectangle(-0.3, -0.2, 0.1, 0.2), 0.0, 0.25))


def _cloth() -> View:
    """A cloth in folds, which shadow themselves and each other."""
    n = 181
    line = np.linspace(-1.0, 1.0, n)
    x, y = np.meshgrid(line, line, indexing="ij")
    bent = x + 0.10 * np.sin(2.1 * y + 0.7) + 0.05 * np.sin(5.3 * y)
    height = (
        0.10 * np.abs(np.sin(7.0 * bent)) ** 0.7 + 0.05 * np.abs(np.sin(11.0 * bent + 2.0 * y)) + 0.03 * np.sin(3.0 * y + 1.0)
    )
    points = np.stack([x, y, height], -1).reshape(-1, 3)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)]).astype(np.uint32)
    meshes = _meshes({"table": _slab(1.5).moved(0, 0, -0.1), "cloth": Solid(points, faces, np.zeros(len(points)))})
    motions = {"sun": Motion(0.02)}
    return View("cloth", meshes, (0.0, -1.6, 1.5), (0.0, 0.0, 0.0), 160, 35, fov=45, near=0.05, far=100, motions=motions)


def _far_fence() -> View:
    """A fence of thin bars 1 km from the camera, through a long lens."""
    solids = {"ground": _slab(2500.0, 1.0), "fence": bars((-8.0, 0.0), (8.0, 0.0), 0.5)}
    motions = {"sun": Motion(0.02), "place": Motion(0.02, "fence", np.array([[1.0, 0.0, 0.0]]))}
    return View(
        "far fence",
        _meshes(solids),
        (0.0, -1000.0, 250.0),
        (0.0, -0.5, 0.5),
        60,
        40,
        fov=1.0,
        motions=motions,
        caster="fence",
        along=(0, 1),
    )


def _statue() -> View:
    """A statue with the sun behind the camera, whose shadow on itself is slivers."""
    profile = [(0.44, 0.0), (0.40, 0.3), (0.30, 0.8), (0.24, 1.0), (0.31, 1.25), (0.30, 1.42), (0.16, 1.52), (0.09, 1.58)]
    body = turned([*profile, (0.11, 1.64), (0.15, 1.74), (0.14, 1.86), (0.08, 1.95), (0.01, 1.98)], 40)
    folds = 1 + 0.10 * np.sin(9 * np.arctan2(body.points[:, 1], body.points[:, 0])) * np.clip(1.1 - body.points[:, 2], 0, 1)
    points = body.points.copy()
    points[:, :2] *= folds[:, None]
    arms = [prism(rectangle(s * 0.32 - 0.07, -0.16, s * 0.32 + 0.07, -0.02), 0.85, 1.42) for s in (-1, 1)]
    shield = prism(rectangle(-0.12, -0.42, 0.30, -0.36), 0.6, 1.15)
    figure = joined([Solid(points, body.faces, body.rise), *arms, shield, post(-0.5, -0.1, 0.04, 0.0, 2.2)]).moved(0, 0, 0.6)
    base = joined([post(0, 0, 1.5, -0.05, 0.3), post(0, 0, 1.15, 0.3, 0.6)])
    motions = {"sun": Motion(0.006), "place": Motion(0.004, "statue", np.array([[1.0, 0.0, 0.0]]))}
    solids = {"ground": _slab(8.0), "base": base, "statue": figure}
    return View("statue", _meshes(solids), (0.0, -6.0, 2.6), (0.0, 0.0, 1.3), 262, 30, fov=30, near=0.1, far=100, motions=motions)


def _ledge() -> View:
    """Ledges of a house's wall under a high sun."""
    wall = prism(rectangle(-6.0, 0.0, 6.0, 1.0), -1.0, 9.0)
    ledges = joined([prism(rectangle(-6.2, -0.12, 6.2, 0.5), z, z + 0.15) for z in (2.0, 4.0, 6.0)])
    frames = joined([prism(rectangle(x - 0.5, -0.05, x + 0.5, 0.5), 2.9, 3.6) for x in (-3.5, -1.2, 1.2, 3.5)])
    motions = {"sun": Motion(0.03), "place": Motion(0.008, "ledges", np.array([[0.0, -1.0, 0.0]]))}
    meshes = _meshes({"ground": _slab(30.0), "wall": wall, "frames": frames, "ledges": ledges})
    origin, target = (2.0, -9.0, 2.2), (0.0, 0.0, 3.4)
    return View(
        "ledge", meshes, origin, target, 250, 55, fov=50, near=0.1, far=200, motions=motions, caster="ledges", along=(0, 1)
    )


#: Scenes by name. Cards are named by their gaps in texels.
CONTACTS: Mapping[str, Callable[[], View]] = {
    "card-0.1": lambda: _card(GAPS[0]),
    "card-1": lambda: _card(GAPS[1]),
    "card-10": lambda: _card(GAPS[2]),
    "box": _box,
    "cloth": _cloth,
    "far-fence": _far_fence,
    "statue": _statue,
    "ledge": _ledge,
}
