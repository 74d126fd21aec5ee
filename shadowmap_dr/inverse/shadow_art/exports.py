"""Mesh files of shadow art: in colour with the receivers of the shadows, and for 3D printing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...io import files
from ...io import images as io_images
from ...io.meshes import Array, Faces
from ...rendering.receivers.shadow_views import ShadowView, height
from .smoothness import inverted_share

if TYPE_CHECKING:
    import trimesh

#: Largest side of a mesh for printing, in millimetres.
PRINT_SIZE_MM = 80.0
# sRGB colours from the bottom to the top of an object: dusk, coral, sand.
_PALETTE = np.array([[0.22, 0.24, 0.45], [0.84, 0.38, 0.36], [0.96, 0.80, 0.56]])
# Cells along each side of a receiver in the coloured file: enough for its waves.
_WALL_CELLS = 64


def vertex_colours(vertices: Array) -> npt.NDArray[np.uint8]:
    """(V, 4) uint8, sRGB and opacity, by height."""
    y = vertices[:, 1].astype(np.float64)
    t = (y - y.min()) / max(float(np.ptp(y)), 1e-9) * (len(_PALETTE) - 1)
    columns = [np.interp(t, np.arange(len(_PALETTE)), _PALETTE[:, c]) for c in range(3)]
    return np.round(255 * np.stack([*columns, np.ones_like(t)], 1)).astype(np.uint8)


def write_meshes(folder: Path, vertices: Array, faces: Faces, views: Sequence[ShadowView], images: Sequence[Array]) -> None:
    """Write `mesh.ply`, `mesh.obj` and, with colours and with the shadows (H, W) on their receivers, `mesh.glb`."""
    import trimesh

    plain = trimesh.Trimesh(vertices, faces, process=False)
    coloured = trimesh.Trimesh(vertices, faces, process=False, vertex_colors=vertex_colours(vertices))
    scene = trimesh.Scene()
    scene.add_geometry(coloured, geom_name="object")
    for k, (view, image) in enumerate(zip(views, images, strict=True)):
        if view.camera == "orthographic":  # the image shows exactly the receiver
            scene.add_geometry(_wall(view, image), geom_name=f"receiver {k + 1}")
    for name, content in (("mesh.ply", plain), ("mesh.obj", plain), ("mesh.glb", scene)):
        with files.atomic(folder / name) as temporary:
            content.export(temporary, file_type=name.rsplit(".")[-1])


def write_printable(path: Path, vertices: Array, faces: Faces) -> None:
    """Write a binary STL in millimetres: z up, standing on z = 0, faces outward."""
    import trimesh

    scale = PRINT_SIZE_MM / float(np.ptp(vertices, axis=0).max())
    upright = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], 1) * scale
    mesh = trimesh.Trimesh(upright - [0, 0, upright[:, 2].min()], faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    with files.atomic(path) as temporary:
        mesh.export(temporary, file_type="stl")


def mesh_report(vertices: Array, faces: Faces) -> dict[str, Any]:
    """Printability of a mesh: closed, oriented, volume (cubic scene units), share of inverted triangles. JSON values."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return {
        "vertices": len(vertices),
        "faces": len(faces),
        "watertight": bool(mesh.is_watertight),
        "consistently_wound": bool(mesh.is_winding_consistent),
        "volume": float(mesh.volume),
        "inverted_triangles": inverted_share(vertices, faces),
    }


def error_picture(image: Array, target: Array) -> npt.NDArray[np.float32]:
    """(H, W, 3), linear: grey where image and target are dark, red where shadow is missing, blue where it is superfluous."""
    missing, superfluous = np.clip(image - target, 0, 1), np.clip(target - image, 0, 1)
    both = np.clip(1 - np.maximum(image, target), 0, 1)
    ground = 1 - 0.6 * both
    return np.stack([ground - superfluous, ground - missing - 0.6 * superfluous, ground - missing], -1).clip(0, 1)


def _wall(view: ShadowView, image: Array) -> trimesh.Trimesh:
    """A view's receiver with the image as its texture."""
    import trimesh
    from PIL import Image

    line = np.linspace(-1, 1, _WALL_CELLS + 1)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    z = height(view.receiver, view.half * x, view.half)
    points = view.origin + np.stack([view.half * x, view.half * y, z], 1) @ np.stack([view.right, view.up, -view.forward])
    corner = (np.arange(_WALL_CELLS)[:, None] * (_WALL_CELLS + 1) + np.arange(_WALL_CELLS)).ravel()
    right, above = corner + 1, corner + _WALL_CELLS + 1
    faces = np.concatenate([np.stack([corner, right, above + 1], 1), np.stack([corner, above + 1, above], 1)])
    pixels = np.round(255 * io_images.to_srgb(0.08 + 0.85 * image)).astype(np.uint8)
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(pixels).convert("RGB"), roughnessFactor=1.0, metallicFactor=0.0, doubleSided=True
    )
    visual = trimesh.visual.TextureVisuals(uv=np.stack([0.5 * (x + 1), 0.5 * (y + 1)], 1), material=material)
    return trimesh.Trimesh(points, faces, visual=visual, process=False)
