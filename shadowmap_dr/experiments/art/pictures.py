"""Pictures of shadow art: the object in front of its receivers, a turntable, and the steps of the optimisation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...io import files
from ...io import images as io_images
from ...io.animations import Pixels
from ...jit.arrays import device_array
from ...rendering.receivers.shadow_views import DISTANCE, HALF, ShadowView, height
from ...rendering.renderer import Renderer
from ..common.objects import occluder
from .run import Frame

#: Duration of the last frame of a history, in milliseconds.
LAST_MS = 1500

# Linear colours.
_OBJECT, _WALLS, _AMBIENT = (0.72, 0.36, 0.26), ((0.8, 0.78, 0.74), (0.55, 0.62, 0.68)), 0.22
# Origin, target and horizontal field of view (degrees) of the camera, for one receiver and for two.
_PLACES = {1: ((-7.4, 1.9, 5.0), (-0.3, -0.2, -1.9), 40.0), 2: ((8.0, 3.6, 8.0), (-1.1, -0.1, -1.1), 34.0)}
# Extent of walls, beyond the picture, in multiples of the receiver's half-side. Two walls end at each other.
_WALL_REACH = 9.0
_MAP_RESOLUTION = 1024


class Stage:
    """A scene with an object, its receivers and their lights, seen from the side.

    Args:
        vertices, faces: (V, 3) and (F, 3).
        views: one or two.
        size: width and height of pictures.
    """

    def __init__(self, vertices: npt.ArrayLike, faces: npt.ArrayLike, views: Sequence[ShadowView], size: int = 320) -> None:
        points = np.asarray(vertices, np.float32)
        origin, target, fov = _PLACES[min(len(views), 2)]
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        place = mi.ScalarTransform4f().look_at(list(origin), list(target), [0, 1, 0])
        scene: dict[str, Any] = {
            "type": "scene",
            "camera": {"type": "perspective", "fov": fov, "to_world": place, "film": film},
            "object": occluder("object", points, np.asarray(faces, np.uint32), _OBJECT),
        }
        for k, view in enumerate(views):
            scene[f"light{k}"] = {
                "type": "directional", "direction": view.forward.tolist(),
                "irradiance": {"type": "rgb", "value": float(np.pi) * 0.85},
            }  # fmt: skip
            scene[f"receiver{k}"] = occluder(f"receiver{k}", *_wall(view, len(views) > 1), _WALLS[k])
        self._renderer = Renderer.from_scene(
            mi.load_dict(scene, optimize=False), shadow_map_resolution=_MAP_RESOLUTION, shadow_filter_size=5, ambient=_AMBIENT
        )
        self._points = points

    def picture(self, vertices: npt.ArrayLike | None = None) -> Pixels:
        """Picture (H, W, 3), sRGB, of the object with the given vertices (V, 3), or with its first vertices."""
        points = self._points if vertices is None else np.asarray(vertices, np.float32)
        with dr.suspend_grad():
            image = self._renderer.render({"object": device_array(mi.Float, points)}, spp=4)
        return np.round(255 * io_images.to_srgb(np.array(image)[..., :3])).astype(np.uint8)


def turntable(frame: Frame, views: Sequence[ShadowView], size: int, count: int = 40,
              on_frame: Callable[[], None] = lambda: None) -> list[Pixels]:  # fmt: skip
    """A full turn of the object about the vertical axis. The shadows match their targets in the first frame only."""
    stage = Stage(frame.vertices, frame.faces, views, size)
    pictures: list[Pixels] = []
    for angle in 2 * np.pi * np.arange(count) / count:
        s, c = np.sin(angle), np.cos(angle)
        pictures.append(stage.picture(frame.vertices @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]], np.float32)))
        on_frame()
    return pictures


def history(frames: Sequence[Frame], views: Sequence[ShadowView], size: int,
            on_frame: Callable[[], None] = lambda: None) -> list[Pixels]:  # fmt: skip
    """A picture for each frame."""
    stage: Stage | None = None
    previous: npt.NDArray[np.uint32] | None = None
    pictures = []
    for frame in frames:
        if stage is None or previous is None or not np.array_equal(frame.faces, previous):
            stage, previous = Stage(frame.vertices, frame.faces, views, size), frame.faces
        pictures.append(stage.picture(frame.vertices))
        on_frame()
    return pictures


def write_picture(path: Path, picture: Pixels) -> None:
    """Write an 8-bit sRGB image."""
    from PIL import Image

    with files.atomic(path) as temporary:
        Image.fromarray(picture).save(temporary)


def _wall(view: ShadowView, corner: bool, cells: int = 256) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Mesh of a receiver, extended beyond the picture; at a corner it ends at the other receiver's plane."""
    reach, end = _WALL_REACH * view.half, DISTANCE * view.half / HALF
    # The other wall is on the left of the first view, and on the right of the second.
    first = view.right[0] > 0.5
    left, right = (-end if corner and first else -reach), (end if corner and not first else reach)
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(left, right, cells + 1), np.linspace(-reach, reach, cells + 1)))
    local = np.stack([x, y, height(view.receiver, x, view.half)], 1)
    points = view.origin + local @ np.stack([view.right, view.up, -view.forward])
    lowest = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    above = lowest + cells + 1
    faces = np.concatenate([np.stack([lowest, lowest + 1, above + 1], 1), np.stack([lowest, above + 1, above], 1)])
    return points.astype(np.float32), faces.astype(np.uint32)
