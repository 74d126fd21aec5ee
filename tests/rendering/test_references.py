"""Our images against the stored references (`references/make.py`): shading, shadows, and how the error falls with the maps' size.

The references are box filtered, so ours are supersampled: 8 x 8 samples per pixel, or 4 x 4 where the errors of shadows are
larger than what that leaves. Their own noise (`relative_standard_error` in the headers) is below 0.06 % of the image's mean for
every scene and is not taken off any error.
"""

from __future__ import annotations

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from references import cases
from scipy import ndimage

from mitsuba_baselines import reference
from shadowmap_dr.io import assets
from shadowmap_dr.rendering.renderer import Renderer

SPP = 64
# Of images with shadows: half the time, and errors larger by 0.01 to 0.07 % of the mean, as large as those of `pose` alone.
SPP_OF_SHADOWS = {"pose": SPP}
FEWER_SPP = 16
SIDE = 8
"""Samples along each side of a pixel."""
RESOLUTIONS = (256, 512, 1024, 2048)
# Of translucent leaves: 2048 texels took 12 GB, and 40 seconds to get them. The error has to fall as far with 1024.
FEWER_RESOLUTIONS = {"meadow": RESOLUTIONS[:-1]}
DEPTH_GAP = 2e-3
"""A jump in depth by this fraction of the distance, beyond what the surface's slope explains, is a silhouette: a third to half a
pixel's width in these scenes."""


def load(name: str, resolution: int = cases.RESOLUTION) -> mi.Scene:
    return mi.load_file(str(assets.scene(name)), optimize=False, resolution=resolution)


def stored(name: str, kind: str) -> np.ndarray:
    return reference.load(cases.FOLDER / f"{name}_{kind}.exr").image


@cache
def shadow_error(variant: str, name: str, resolution: int) -> float:
    """Mean absolute error of the whole image, relative to its mean."""
    del variant  # part of the key only
    made = Renderer.from_scene(load(name), shadow_map_resolution=resolution)  # one map for each light, without tiles
    image, target = np.array(made.render(spp=SPP_OF_SHADOWS.get(name, FEWER_SPP))), stored(name, "direct")
    return float(np.abs(image - target).mean() / target.mean())


def silhouettes(name: str) -> np.ndarray:
    """Pixels in which neighbouring samples see different shapes or depths that no slope explains, (H, W) bool."""
    scene = load(name, SIDE * cases.RESOLUTION)
    aovs = ("shape_index", "position", "normal", "depth")
    image = np.array(Renderer.from_scene(scene, shadow_method="none", antialias=False, aovs=aovs).render())[..., 3:]
    shape, position, normal, depth = image[..., 0], image[..., 1:4], image[..., 4:7], image[..., 7]
    jumps = np.zeros(shape.shape, bool)
    for axis in (0, 1):
        here, there = (slice(None),) * axis + (slice(None, -1),), (slice(None),) * axis + (slice(1, None),)
        step = position[there] - position[here]
        off_plane = np.minimum(*(np.abs((step * normal[side]).sum(-1)) for side in (here, there)))
        jump = (shape[here] != shape[there]) | (off_plane > DEPTH_GAP * depth[here])
        jumps[here] |= jump
        jumps[there] |= jump
    return jumps.reshape(cases.RESOLUTION, SIDE, cases.RESOLUTION, SIDE).any((1, 3))


@pytest.mark.parametrize("name", cases.SCENES)
def test_shading_without_shadows(variant: str, name: str) -> None:
    image = np.array(Renderer.from_scene(load(name), shadow_method="none").render(spp=SPP))
    target = stored(name, "unshadowed")
    away = ~ndimage.binary_dilation(silhouettes(name), np.ones((3, 3)))  # two pixels or more from any silhouette
    assert away.mean() > 0.75, "too few pixels are left to compare"
    error = np.sqrt(np.mean((image - target)[away] ** 2) / np.mean(target[away] ** 2))
    assert error <= 0.005, f"relative RMSE {error:.2%}"


@pytest.mark.parametrize("name", cases.SCENES)
def test_shadows_of_1024_texels(variant: str, name: str) -> None:
    error = shadow_error(variant, name, 1024)
    assert error <= 0.015, f"mean absolute error {error:.2%} of the mean"


@pytest.mark.parametrize("name", cases.SCENES)
def test_error_falls_with_resolution(variant: str, name: str) -> None:
    errors = [shadow_error(variant, name, resolution) for resolution in FEWER_RESOLUTIONS.get(name, RESOLUTIONS)]
    listed = ", ".join(f"{error:.3%}" for error in errors)
    assert all(fine <= 1.02 * coarse for coarse, fine in zip(errors, errors[1:], strict=False)), listed
    assert errors[-1] <= 0.7 * errors[0], listed
