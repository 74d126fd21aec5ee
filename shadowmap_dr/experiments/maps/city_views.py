"""Views of cities: from streets and from the air, with the sun in four directions.

The same for a city of a file: its meshes, whose materials are left out, are read from a scene file of Mitsuba.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...scene.mitsuba_meshes import make_mesh, mesh_buffers
from .city import City, make_city
from .view import USUAL, Motion, Seen, View, points_of, seen_by

#: Azimuths of the sun, degrees.
AZIMUTHS = (20, 110, 200, 290)
# Views that are less dark are left out, as a share of the image.
_LEAST_DARK = 0.01
#: Height of cameras in streets above the ground, metres.
EYE = 5.0
# Places for streets: a grid of so many lines to each side of the middle, a thirtieth of the city apart.
_LINES = 6
# Shapes smaller than this, metres, are small; pixels that its shadow must have for derivatives by its place or height.
_SMALL, _LEAST = 25.0, 5


@dataclass(frozen=True)
class Place:
    """A camera: its name, its position and what it looks at, metres."""

    name: str
    origin: tuple[float, float, float]
    target: tuple[float, float, float]


def city_views(city: City | None = None) -> Iterator[View]:
    """Views of a city of :func:`~shadowmap_dr.experiments.maps.city.make_city`, among them one of its square."""
    city = city or make_city()
    meshes = city.meshes()
    rises = {body.name: body.solid.rise for body in city.buildings}
    column = city.body("column_000").solid.points
    x, y, z = column[:, 0].mean(), column[:, 1].mean(), column[:, 2].min()
    places = [*protocol_places(meshes), Place("square", (x - 34.0, y - 22.0, z + EYE), (x, y, z + 4.0))]
    yield from _views("city", meshes, places, rises)


def file_views(path: Path) -> Iterator[View]:
    """Views of the city of a scene file; its name is that of the file.

    Raises:
        ShadowmapError: the file or one of its meshes cannot be read.
    """
    meshes = file_meshes(path)
    rises = {}
    for name, mesh in meshes.items():
        heights = points_of(mesh)[:, 2]
        # Vertices of walls are at their foot, those of roofs are not.
        rises[name] = (heights > heights.min() + 1.0).astype(np.float64)
    yield from _views(path.stem, meshes, protocol_places(meshes), rises)


def file_meshes(path: Path) -> dict[str, mi.Mesh]:
    """The meshes of a scene file with one grey material.

    Scene files of Sionna have a mesh for each material of a building, such as walls and roof. These become one mesh: their edges
    coincide, and a building's height is that of both.

    Raises:
        ShadowmapError: the file or one of its meshes cannot be read.
    """
    material = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse"}})
    parts: dict[str, list[mi.Mesh]] = {}
    try:
        for index, shape in enumerate(ElementTree.parse(path).getroot().findall("shape")):
            file = shape.find("string[@name='filename']")
            if file is None:
                continue
            source = {"type": shape.get("type"), "filename": str(path.parent / file.get("value", "")), "face_normals": True}
            name = shape.get("id") or f"shape_{index}"
            mesh = mi.load_dict({"type": "scene", name: {**source, "bsdf": material}}, optimize=False).shapes()[0]
            parts.setdefault(re.sub("-itu_[a-z_]+$", "", name), []).append(mesh)
    except (OSError, ElementTree.ParseError, RuntimeError) as error:
        raise ShadowmapError(f"cannot read the city {path}: {' '.join(str(error).split())}") from error
    if not parts:
        raise ShadowmapError(f"the city {path} has no meshes: give a scene file with shapes that name files.")
    return {name: own[0] if len(own) == 1 else _joined(name, own, material) for name, own in parts.items()}


def _joined(name: str, parts: list[mi.Mesh], material: mi.BSDF) -> mi.Mesh:
    """One mesh with the triangles of all parts."""
    buffers = [mesh_buffers(part) for part in parts]
    points = [np.array(buffer.positions).reshape(-1, 3) for buffer in buffers]
    starts = np.cumsum([0, *(len(own) for own in points[:-1])])
    faces = [np.array(buffer.faces).reshape(-1, 3) + start for buffer, start in zip(buffers, starts, strict=True)]
    return make_mesh(name, np.concatenate(points), np.concatenate(faces), material)


def protocol_places(meshes: Mapping[str, mi.Mesh]) -> list[Place]:
    """Two streets, which are the lowest places of a grid about the middle, and the air."""
    whole = mi.load_dict({"type": "scene", **meshes}, optimize=False)
    box = whole.bbox()
    (x, y, _), (w, d, _) = (np.array(v, np.float64).ravel() for v in (box.center(), box.extents()))
    steps = range(-_LINES, _LINES + 1)
    spots = np.array([(x + i * w / 30, y + j * d / 30) for i in steps for j in steps])
    heights = _ground(whole, spots)
    order = np.argsort(heights, kind="stable")
    streets = []
    for number, spot in enumerate((order[0], order[len(order) // 8])):
        px, py, pz = float(spots[spot, 0]), float(spots[spot, 1]), float(heights[spot]) + EYE
        streets.append(Place(f"street {number}", (px, py, pz), (px + 100, py + 60, pz)))
    return [*streets, Place("air", (x - 0.45 * w, y - 0.45 * d, 0.35 * w), (x, y, 0.0))]


def _views(
    city: str,
    meshes: Mapping[str, mi.Mesh],
    places: list[Place],
    rises: Mapping[str, npt.NDArray[np.float64]],
) -> Iterator[View]:
    """All cameras and suns. Parts move with the sun that shows most of both light and shadow."""
    for place in places:
        views, shown = [], []
        for azimuth in AZIMUTHS:
            name = f"{city}, {place.name}, sun {azimuth}"
            view = View(name, meshes, place.origin, place.target, azimuth, least_dark=_LEAST_DARK)
            seen = seen_by(view, view.scene(USUAL), USUAL)
            views.append(view)
            shown.append(seen)
        both = [min(int((seen.caster >= 0).sum()), int(seen.lit.sum())) for seen in shown]
        best = int(np.argmax(both))
        views[best] = replace(views[best], motions=_motions(views[best], shown[best], rises))
        yield from views


def _motions(view: View, seen: Seen, rises: Mapping[str, npt.NDArray[np.float64]]) -> dict[str, Motion]:
    """Motions of the sun, and of the building and the small shape whose shadows have the longest edges."""
    names, dark = list(view.meshes), seen.caster >= 0
    if dark.sum() < _LEAST:
        return {}
    half_pixel = np.linalg.norm(seen.p_world - np.array(view.origin), axis=-1) * np.tan(np.radians(0.5 * view.fov)) / USUAL
    across = np.linalg.norm((seen.p_caster - seen.p_world)[..., :2], axis=-1)
    # A pixel for the longer shadows, less for the shorter ones.
    motions = {"sun": Motion(float(np.percentile(half_pixel[dark] / across[dark], 25)))}
    edge = dark & _beside(seen.lit)
    boxes = {name: points_of(mesh) for name, mesh in view.meshes.items()}
    low, high = (np.array([end(boxes[name][:, 2]) for name in names]) for end in (np.min, np.max))
    # Only the upper parts of a building move with its height.
    upper = edge & (seen.p_caster[..., 2] > 0.4 * low[seen.caster] + 0.6 * high[seen.caster])
    small = [name for name in names if np.ptp(boxes[name], axis=0).max() < _SMALL and name not in rises]
    for motion, allowed, where in (("height", list(rises), upper), ("place", small, edge)):
        counts = np.bincount(seen.caster[where], minlength=len(names))
        chosen = max(((int(counts[names.index(name)]), name) for name in allowed), default=(0, ""))[1]
        if chosen and counts[names.index(chosen)] >= _LEAST:
            step = float(np.median(half_pixel[where & (seen.caster == names.index(chosen))]))
            motions[motion] = Motion(step, chosen, _rate(motion, rises.get(chosen)))
    return motions


def _beside(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Pixels (H, W) with a neighbour in a mask."""
    padded = np.pad(mask, 1)
    return padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]


def _rate(motion: str, rise: npt.NDArray[np.float64] | None) -> npt.NDArray[np.float64]:
    """Motion of vertices: by their rise upwards, or all along x."""
    if motion == "place" or rise is None:
        return np.array([[1.0, 0.0, 0.0]])
    return np.column_stack([0 * rise, 0 * rise, rise])


def _ground(scene: mi.Scene, places: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Heights (N,) of whatever is below places (N, 2), metres."""
    x, y = (mi.Float(places[:, k].astype(np.float32)) for k in (0, 1))
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, 1e4), mi.Vector3f(0, 0, -1)))
    return np.array(hit.p.z, np.float64)
