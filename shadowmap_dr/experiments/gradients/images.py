"""Derivative images of a shadow by a motion of its occluder, and sharp derivative images with the blur of a shadow map."""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterable, Mapping
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError, did_you_mean
from ...jit.arrays import device_array
from ...jit.types import Float
from ...rendering.renderer import Renderer
from ...shadow import ShadowSettings, directional_view
from ...shadow.filters import filter_kernel
from ..common.meshes import Mesh
from .scenes import RECEIVER_HALF, Motion

Image = npt.NDArray[np.float32]

SHAPE = "occluder"

#: Kinds of shadow map to compare: label -> options of the `Renderer`.
CANDIDATES: dict[str, dict[str, Any]] = {
    "default": {},
    "no anti-aliasing": {"shadow_antialias": False},
    "2 x 2 texels": {"shadow_supersampling": 2},
    "4 x 4 texels": {"shadow_supersampling": 4},
    "4 x 4 look-ups": {"shadow_samples": 4},
    "plain vsm": {"shadow_method": "vsm", "shadow_receiver_range": False},
    "plain vsm, 2 x 2": {"shadow_method": "vsm", "shadow_receiver_range": False, "shadow_supersampling": 2},
    "msm": {"shadow_method": "msm"},
}


def check_chosen(chosen: Mapping[str, tuple[Collection[Any], Collection[str] | None]]) -> None:
    """ShadowmapError for an option without values, or with an unknown value.

    Args:
        chosen: kind of option (a word for the message) -> its values, and the known names (None: any value).
    """
    for kind, (values, known) in chosen.items():
        if not values:
            raise ShadowmapError(f"no {kind} given: name at least one.")
        for value in values:
            if known is not None and value not in known:
                raise ShadowmapError(
                    f"no {kind} {value!r}: choose from {', '.join(map(repr, known))}.{did_you_mean(value, known)}"
                )


def check_maps(resolutions: Iterable[int], filter_sizes: Iterable[int]) -> None:
    """ShadowmapError for combinations of map and filter sizes (1 for none) that are not possible."""
    for taps in filter_sizes:
        for resolution in resolutions:
            try:
                ShadowSettings(resolution=resolution, filter_size=taps)
            except ValueError as error:
                raise ShadowmapError(str(error)) from None


def image_of(renderer: Renderer, mesh: Mesh) -> Image:
    """The renderer's image (H, W, C) with a mesh's vertices as the occluder's. The renderer is not changed. No gradients."""
    with dr.suspend_grad():
        return np.array(copy.copy(renderer).render({SHAPE: device_array(mi.Float, mesh.vertices)}))


def forward_derivative(renderer: Renderer, rate: npt.NDArray[np.float64]) -> tuple[Image, Image]:
    """Image and derivative image (H, W, C), by forward mode, for vertices that move at a rate (V, 3)."""
    offset = dr.opaque(mi.Float, 0.0)  # opaque: a literal zero would take the size of its first product
    dr.enable_grad(offset)
    rest = cast("Float", dr.detach(dr.ravel(renderer.data.geometry.shape_positions(SHAPE))))
    image = copy.copy(renderer).render({SHAPE: rest + mi.Float(rate.astype(np.float32).ravel()) * offset})
    dr.forward(offset)
    return np.array(dr.detach(image)), np.array(dr.grad(image))


def central_derivative(renderer: Renderer, mesh: Mesh, motion: Motion, step: float) -> Image:
    """Derivative image (H, W, C) by central differences of the renderer's own images."""
    high, low = (image_of(renderer, motion.moved(mesh, sign * step)) for sign in (1, -1))
    return (high - low) / np.float32(2 * step)


def reverse_error(renderer: Renderer, rate: npt.NDArray[np.float64], derivative: Image, seed: int = 0) -> float:
    """Deviation of <w, derivative> by reverse mode from its value for a forward-mode derivative image, for random weights w.

    Relative to the sum of the products' magnitudes, since the products nearly cancel.
    """
    weights = np.random.default_rng(seed).normal(size=derivative.shape).astype(np.float32)
    moved = mi.Float(dr.detach(dr.ravel(renderer.data.geometry.shape_positions(SHAPE))))
    dr.enable_grad(moved)
    image = copy.copy(renderer).render({SHAPE: moved})
    dr.backward(dr.sum(image.array * device_array(mi.Float, weights)))
    reverse = float(np.array(dr.grad(moved), np.float64) @ rate.ravel())
    terms = weights.astype(np.float64) * derivative
    return abs(reverse - float(terms.sum())) / max(float(np.abs(terms).sum()), 1e-300)


def texel_in_pixels(renderer: Renderer, resolution: int) -> tuple[float, float]:
    """Width and height of a texel in pixels, for the camera that looks along the light (-z, with image axes x and y) at the
    receiver."""
    frusta = renderer.frusta
    if frusta is None:
        raise ShadowmapError("the renderer has no shadow map: choose a shadow_method that has one.")
    pixel = 2 * RECEIVER_HALF / resolution
    size = renderer.settings.shadow.resolution
    x, y = (2 * float(half[0]) / size / pixel for half in (frusta.half_x, frusta.half_y))
    # The light's x axis may be the image's y axis.
    right = np.abs(np.array(dr.detach(directional_view(mi.Vector3f(0, 0, -1)).right)).ravel())
    return (x, y) if right[0] > right[1] else (y, x)


def blurred_by_map(image: Image, renderer: Renderer) -> Image:
    """A sharp derivative image (H, W, C), blurred as by an exact filtered shadow map.

    The kernel is that of the mean over a texel (coverage), the filter's taps, and the bilinear look-up, in this order. The image
    counts as zero beyond its borders. Texels are parallel to the pixels.
    """
    shadow = renderer.settings.shadow
    height, width, _ = image.shape
    texel_x, texel_y = texel_in_pixels(renderer, width)
    taps = np.sqrt(np.diag(filter_kernel(shadow.filter, shadow.filter_size)))
    taps = taps / taps.sum()
    shape = (2 * height, 2 * width)
    response = _response(np.fft.fftfreq(shape[0]), texel_y, taps)[:, None] * _response(np.fft.rfftfreq(shape[1]), texel_x, taps)
    transformed = np.fft.rfft2(image, s=shape, axes=(0, 1)) * response[..., None]
    return np.fft.irfft2(transformed, s=shape, axes=(0, 1))[:height, :width].astype(np.float32)


def _response(frequency: npt.NDArray[np.floating[Any]], texel: float, taps: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Fourier transform of coverage (a box), bilinear look-up (a tent, two boxes) and taps, at cycles per pixel."""
    offsets = np.arange(len(taps)) - len(taps) // 2
    filtered = (taps * np.cos(2 * np.pi * np.outer(frequency * texel, offsets))).sum(1)
    return np.sinc(frequency * texel) ** 3 * filtered
