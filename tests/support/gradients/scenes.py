"""The scenes of the gradient suite. Mitsuba's path tracer renders them, too, for the stored differences."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from shadowmap_dr.io import assets

SIZE = 128

DIRECTION = np.array([-0.55, -1.0, -0.30])
SPOT_ORIGIN, SPOT_TARGET = (1.6, 3.2, 1.2), (-0.3, 0.0, -0.2)


def scene(size: int = SIZE, **parts: Any) -> Any:
    """A floor, y = 0, and what else is given, seen from above at an angle unless a camera is given."""
    known = {"type": "scene", "camera": camera(size), "floor": floor(), **parts}
    return mi.load_dict({name: part for name, part in known.items() if part is not None}, optimize=False)


def camera(size: int = SIZE, kind: str = "perspective", at: Any = (0, 4.2, 3.2), to: Any = (-0.2, 0.2, -0.1), **more: Any) -> Any:
    """A camera; an orthographic one shows a square of half-size 1.5."""
    to_world = mi.ScalarTransform4f().look_at(list(at), list(to), [0, 1, 0])
    if kind == "orthographic":
        to_world = to_world @ mi.ScalarTransform4f().scale([1.5, 1.5, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32", "sample_border": True}  # fmt: skip
    sampler = {"type": "multijitter", "sample_count": 64}
    fov = {"fov": more.pop("fov", 32)} if kind == "perspective" else {}
    return {"type": kind, "to_world": to_world, "sampler": sampler, "film": film, **fov, **more}


def floor(bsdf: Any = None) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(4)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf or diffuse(0.5)}


def diffuse(*reflectance: float) -> dict[str, Any]:
    value: Any = reflectance[0] if len(reflectance) == 1 else {"type": "rgb", "value": list(reflectance)}
    return {"type": "diffuse", "reflectance": value}


def checker(seed: int = 0, size: int = 8) -> Any:
    """A coloured texture, smooth between its texels."""
    pixels = np.random.default_rng(seed).uniform(0.2, 0.9, (size, size, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def sun() -> dict[str, Any]:
    return {"type": "directional", "direction": DIRECTION.tolist(), "irradiance": 3.0}


def spot() -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at(list(SPOT_ORIGIN), list(SPOT_TARGET), [0, 1, 0])
    return {"type": "spot", "to_world": to_world, "intensity": 30.0, "cutoff_angle": 28.0, "beam_width": 22.0}


def bulb() -> dict[str, Any]:
    return {"type": "point", "position": [0.7, 2.6, 0.6], "intensity": 12.0}


def box(bsdf: Any = None, place: Any = None) -> dict[str, Any]:
    """A tilted cube above the floor."""
    T = mi.ScalarTransform4f
    pose = T().translate([0, 0.85, 0]) @ T().rotate([0, 1, 0], 25) @ T().rotate([1, 0, 0], 35) @ T().scale(0.38)
    return {"type": "cube", "to_world": place or pose, "bsdf": bsdf or diffuse(0.6)}


def cow(bsdf: Any = None, face_normals: bool = True) -> dict[str, Any]:
    """Spot, a cow of 5,856 faces, above the floor."""
    pose = mi.ScalarTransform4f().translate([0, 0.85, 0]) @ mi.ScalarTransform4f().rotate([0, 1, 0], 60)
    pose = pose @ mi.ScalarTransform4f().scale(0.65)
    return {"type": "ply", "filename": str(assets.mesh("spot")), "face_normals": face_normals, "to_world": pose,
            "bsdf": bsdf or diffuse(0.6)}  # fmt: skip


def mesh(name: str, vertices: np.ndarray, faces: np.ndarray, bsdf: Any = None, normals: bool = False, emitter: Any = None) -> Any:
    """A ``mi.Mesh``, smooth if ``normals``, which Mitsuba then works out from its faces."""
    props = mi.Properties()
    if emitter is not None:
        props["emitter"] = mi.load_dict(emitter)
    props["face_normals"] = not normals
    made = mi.Mesh(name, len(vertices), len(faces), props, has_vertex_normals=normals)
    params = mi.traverse(made)
    params["vertex_positions"] = mi.Float(np.asarray(vertices, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    params.update()
    made.set_bsdf(mi.load_dict(bsdf or diffuse(0.6)))
    return made


def shaded_lamp(at: Any = (0, 0, 0), radiance: float = 2.0) -> Any:
    """A mesh of two boxes that shine: a small one, vertices 0 to 7, and a plate, which hides it from the right."""
    boxes = [trimesh.creation.box((0.2, 0.2, 0.2)), trimesh.creation.box((0.04, 0.7, 0.7))]
    boxes[1].apply_translation([0.35, 0, 0])
    joined = trimesh.util.concatenate(boxes)
    emitter = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return mesh("lamp", np.asarray(joined.vertices) + np.asarray(at), joined.faces, emitter=emitter)


def curve(kind: str, name: str, points: Any, bsdf: Any = None) -> Any:
    """A ``bsplinecurve`` or ``linearcurve`` with control points (x, y, z, radius), which Mitsuba reads from a file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curve.txt"
        path.write_text("\n".join(" ".join(map(str, point)) for point in points))
        return mi.load_dict({"type": kind, "id": name, "filename": str(path), "bsdf": bsdf or diffuse(0.6)})


def block(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the tilted cube, each face split into 4 ** subdivisions."""
    solid = trimesh.creation.box((2, 2, 2))
    for _ in range(subdivisions):
        solid = solid.subdivide()
    place = box()["to_world"].matrix
    return np.asarray(solid.vertices) @ np.asarray(place)[:3, :3].T + np.asarray(place)[:3, 3], np.asarray(solid.faces)


def ball(subdivisions: int, radius: float = 0.5, centre: Any = (0, 0.85, 0)) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a sphere of 20 * 4 ** subdivisions faces."""
    solid = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(solid.vertices) + np.asarray(centre), np.asarray(solid.faces)
