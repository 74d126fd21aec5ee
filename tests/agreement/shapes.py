"""Meshes, cameras and textures of the scenes that are compared with Mitsuba. All are made of numbers: no file is read."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

#: Pixels along each side of the images.
SIZE = 64


def camera(size: int = SIZE, **film: Any) -> dict[str, Any]:
    """A camera four units above the origin that looks down the z axis; its film has a narrow Gaussian filter."""
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    whole = {
        "type": "hdrfilm",
        "width": size,
        "height": size,
        "rfilter": {"type": "gaussian", "stddev": 0.5},
        "sample_border": True,
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    return {
        "type": "perspective",
        "fov": 39.0,
        "to_world": to_world,
        "film": {**whole, **film},
        "sampler": {"type": "multijitter"},
    }


def gray(value: float) -> dict[str, Any]:
    """A diffuse material."""
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


def lamp(radiance: Any) -> dict[str, Any]:
    """An area emitter."""
    return {"type": "area", "radiance": {"type": "rgb", "value": radiance}}


def rough_picture(size: int = 48, low: float = 0.05, high: float = 0.95) -> dict[str, Any]:
    """A coloured bitmap with detail of about the size of a pixel, the same every time."""
    pixels = np.random.default_rng(7).uniform(low, high, (size, size, 3)).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}


def square(name: str, place: Any = None, *, smooth: bool = False, **parts: Any) -> Any:
    """A square of two triangles, from -1 to 1 in x and y, facing +z; ``smooth`` gives it vertex normals."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float64)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)
    normals = np.tile([0.0, 0.0, 1.0], (4, 1)) if smooth else None
    return _mesh(name, corners, [[0, 1, 2], [0, 2, 3]], uv, normals, place, **parts)


def ball(name: str, place: Any = None, rows: int = 24, **parts: Any) -> Any:
    """A smooth unit sphere of 4 * rows * (rows - 1) triangles."""
    columns = 2 * rows
    theta, phi = np.meshgrid(np.arange(rows + 1) * np.pi / rows, np.arange(columns) * np.pi / rows, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    # One vertex at each pole.
    points = np.concatenate([[[0, 0, 1]], points[1:-1].reshape(-1, 3), [[0, 0, -1]]])
    last, faces = len(points) - 1, []
    for k in range(columns):
        other = (k + 1) % columns
        faces += [[0, 1 + k, 1 + other], [last, last - columns + other, last - columns + k]]
        for row in range(rows - 2):
            a, b = 1 + row * columns + k, 1 + row * columns + other
            faces += [[a, a + columns, b], [b, a + columns, b + columns]]
    return _mesh(name, points, faces, None, points, place, **parts)


def _mesh(
    name: str, points: np.ndarray, faces: Any, uv: Any, normals: Any, place: Any, bsdf: Any = None, emitter: Any = None
) -> Any:
    """A ``mi.Mesh``, ``place`` being its transformation (no shear)."""
    props = mi.Properties()
    if emitter is not None:
        props["emitter"] = mi.load_dict(emitter)
    props["face_normals"] = normals is None
    made = mi.Mesh(
        name, len(points), len(faces), props, has_vertex_normals=normals is not None, has_vertex_texcoords=uv is not None
    )
    matrix = np.eye(4) if place is None else np.asarray(place.matrix, np.float64)
    values = {"vertex_positions": points @ matrix[:3, :3].T + matrix[:3, 3]}
    if uv is not None:
        values["vertex_texcoords"] = uv
    params = mi.traverse(made)
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    for key, value in values.items():
        params[key] = mi.Float(value.astype(np.float32).ravel())
    params.update()
    if normals is not None:
        # Those of the sphere itself, not of its faces.
        turned = normals @ np.linalg.inv(matrix[:3, :3])
        turned /= np.linalg.norm(turned, axis=-1, keepdims=True)
        params["vertex_normals"] = mi.Float(turned.astype(np.float32).ravel())
        params.update()
    made.set_bsdf(mi.load_dict(bsdf or gray(0.5)))
    return made
