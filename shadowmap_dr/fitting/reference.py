"""Images of a scene by its own integrator, Mitsuba's, with which the images of a fit are corrected."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..io.resampling import area_average
from ..scene.load import SceneData
from ..scene.sensor import ImageSize, Sensor
from .changes import Changes
from .motions import host_matrix
from .scene_update import updated

Image = npt.NDArray[np.float32]

# Integrators of Mitsuba's that show a scene as a camera sees it. Others' scenes are rendered by `direct`.
_INTEGRATORS = (
    *("DirectIntegrator", "PathIntegrator", "VolumetricPathIntegrator", "VolpathMisIntegratorImpl"),
    *("PRBIntegrator", "PRBVolpathIntegrator", "ThreePointIntegrator", "DirectProjectiveIntegrator"),
    *("PathProjectiveIntegrator", "BasicPRBIntegrator"),
)
# Those whose light passes through translucent surfaces, and those whose light bounces. In all others such surfaces stop the light
# of points and directions: scenes with them are rendered by `volpath`.
_PASSING = ("VolumetricPathIntegrator", "VolpathMisIntegratorImpl", "PRBVolpathIntegrator")
_BOUNCING = ("PathIntegrator", "PRBIntegrator", "BasicPRBIntegrator", "PathProjectiveIntegrator")
# The usual `max_depth`: one bounce.
_DIRECT = 2
# Samples of a pass, and of a pixel in it at most; passes at most; noise, a share of the brightness, below which a pass is the
# last; pixels of an image.
_PASS, _MOST, _PASSES, _NOISE, _PIXELS = 1 << 22, 1024, 4, 0.02, 1 << 20

# First seed of the noise: others than those that pictures of Mitsuba's usually have.
_SEED = 0x5EED0000


class Reference:
    """Images of a scene by Mitsuba.

    Args:
        data: the scene.
        sizes: (W, H) of the pictures' windows on the films, one for each image: images are rendered with as many pixels.

    Attributes:
        rendered: the images of the last call as they were rendered.
        passes: those of the last call, of independent samples, in the sizes asked for: (P, H, W, 3) for each image.
    """

    def __init__(self, data: SceneData, sizes: Sequence[tuple[int, int]]) -> None:
        self._data, self._sizes, self.rendered = data, tuple(sizes), list[Image]()
        self.passes = list[Image]()
        self._integrator = reference_integrator(data)

    def images(
        self, changes: Changes, cameras: Sequence[Sensor], sizes: Sequence[ImageSize], most_passes: int | None = None
    ) -> list[Image]:
        """Linear images (H, W, 3), detached.

        Args:
            changes: of the scene.
            cameras: one for each image, whose window is all of the film.
            sizes: of the images.
            most_passes: passes of each image at most; None for four. Images of the same pass have the same random numbers.

        Raises:
            ShadowmapError: Mitsuba's objects cannot be changed so.
        """
        with dr.suspend_grad(), updated(self._data, changes) as scene:
            each, most = zip(cameras, self._sizes, sizes, strict=True), most_passes or _PASSES
            found = [self._passes(scene, camera, own, size, k, most) for k, (camera, own, size) in enumerate(each)]
        self.rendered = [np.asarray(np.mean(own, axis=0, dtype=np.float64), np.float32) for own in found]
        pairs = list(zip(found, sizes, strict=True))
        self.passes = [np.array([reduced(image, size) for image in passes]) for passes, size in pairs]
        return [reduced(image, size) for image, size in zip(self.rendered, sizes, strict=True)]

    def _passes(
        self, scene: mi.Scene, camera: Sensor, own: tuple[int, int], size: ImageSize, number: int, most: int
    ) -> list[Image]:
        """Passes of an image, until their mean has little noise."""
        width, height = _film_size(own, size)
        sensor = _sensor(camera, width, height)
        spp = int(np.clip(_PASS // (width * height), 1, _MOST))
        passes: list[Image] = []
        while len(passes) < most and _noise(passes) > _NOISE:
            rendered = mi.render(
                scene, sensor=sensor, integrator=self._integrator, spp=spp, seed=_SEED + number * 256 + len(passes)
            )
            passes.append(np.array(rendered, np.float32).reshape(height, width, -1))
        return passes


def reference_integrator(data: SceneData) -> mi.Integrator:
    """The integrator of a scene's images: its own, ``direct``, or ``volpath`` for scenes with translucent surfaces."""
    own = data.scene.integrator()
    name = own.class_name() if own is not None else ""
    if name == "SamplingIntegrator":  # of those that are written in Python
        name = type(own).__name__
    translucent = any(info.see_through for info in data.geometry.shapes)
    if not translucent or name in _PASSING:
        return own if name in _INTEGRATORS else mi.load_dict({"type": "direct"})
    hidden = name in _INTEGRATORS and own.hide_emitters
    depth = _max_depth(own) if name in _BOUNCING else _DIRECT
    return mi.load_dict({"type": "volpath", "max_depth": depth, "hide_emitters": bool(hidden)})


def _max_depth(integrator: mi.Integrator) -> int:
    """The largest number of a path's segments, -1 for no limit."""
    found = re.search(r"max_depth = (-?\d+)", str(integrator))
    depth = int(found[1]) if found else -1
    return depth if depth < 1 << 31 else -1


def reduced(image: Image, size: ImageSize) -> Image:
    """An image (H, W, C) with fewer pixels."""
    return area_average(lambda rows: image[rows], (image.shape[0], image.shape[1]), (size.height, size.width))


def _noise(passes: Sequence[Image]) -> float:
    """Standard error of the mean of some images, as a share of its brightness."""
    if len(passes) < 2:
        return np.inf
    mean = np.mean(passes, axis=0, dtype=np.float64)
    variance = np.square(np.array(passes) - mean).sum() / mean.size / (len(passes) - 1)
    return float(np.sqrt(variance / len(passes) / max(np.square(mean).mean(), 1e-30)))


def _film_size(window: tuple[int, int], size: ImageSize) -> tuple[int, int]:
    """(width, height) in square pixels of the film on which an image is rendered."""
    share = max(1.0, np.sqrt(window[0] * window[1] / _PIXELS))
    return max(size.width, round(window[0] / share)), max(size.height, round(window[1] / share))


def _sensor(camera: Sensor, width: int, height: int) -> mi.Sensor:
    """A sensor of Mitsuba's, with a film of its own."""
    film = {
        "type": "hdrfilm",
        "width": width,
        "height": height,
        "pixel_format": "luminance" if camera.channels == 1 else "rgb",
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    matrix = host_matrix(camera.to_world)
    near, far = (float(dr.detach(one)[0]) for one in (camera.near, camera.far))
    description: dict[str, Any] = {  # Any: a dictionary of Mitsuba's
        "type": camera.kind,
        "to_world": mi.ScalarTransform4f(matrix),
        "near_clip": near,
        "far_clip": far,
        "film": film,
        "sampler": {"type": "independent"},
    }
    if camera.kind == "perspective":
        x, y = (float(dr.detach(one)[0]) for one in camera.principal_point)
        fov = float(dr.detach(camera.x_fov)[0])
        description |= {"fov": fov, "fov_axis": "x", "principal_point_offset_x": x, "principal_point_offset_y": y}
    return mi.load_dict(description)
