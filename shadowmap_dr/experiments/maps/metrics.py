"""Deviations of a visibility image from the reference: errors, light bleeding, acne, and shift of the contour in texels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...shadow import Frusta, LightView

# Reference visibility below counts as dark, above as lit.
_DARK, _LIT = 0.002, 0.998
# Length of a contour from its crossings with lines along rows, columns and both diagonals (Cauchy and Crofton): exact on average
# over all directions, within 6 % for each direction.
_LENGTH = np.pi / 8
# Sample points along each side of a pixel that tell the two sides of a contour apart.
_FINER = 16

Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Texel:
    """Size of a shadow map's texel on the visible surfaces, in image pixels; medians over the image.

    Attributes:
        size: side of a square of the texel's area.
        longest: longer side of the texel.
    """

    size: float
    longest: float


def texel_in_pixels(
    p_world: npt.NDArray[np.floating], view: LightView, frusta: Frusta, resolution: int, mask: npt.NDArray[np.bool_]
) -> Texel:
    """Size of a texel in an image.

    Args:
        p_world: (H, W, 3) positions of the visible surfaces, world space.
        view: view of a directional light.
        frusta: frustum of its single map.
        resolution: texels along each side of the map.
        mask: (H, W), pixels that show a surface.
    """
    columns = []
    for axis, half in ((view.right, frusta.half_x), (view.up, frusta.half_y)):
        direction = np.array([float(axis[k][0]) for k in range(3)])
        rows, across = np.gradient(p_world.astype(np.float64) @ direction * (0.5 * resolution / float(half[0])))
        columns.append(np.stack([across, rows], -1))
    texels_by_pixel = np.stack(columns, -2)[mask]
    area = np.abs(np.linalg.det(texels_by_pixel))
    # Texels on surfaces at grazing angles are unbounded: leave them out.
    struck = area > 1e-6 * np.median(area)
    sides = np.linalg.norm(np.linalg.inv(texels_by_pixel[struck]), axis=-2)
    return Texel(float(np.median(area)) ** -0.5, float(np.median(sides.max(-1))))


def metrics(image: Image, reference: Image, mask: npt.NDArray[np.bool_], texel: Texel, filter_size: int) -> dict[str, float]:
    """Errors of a visibility image (H, W): root mean squares, light bleeding, acne, shift of the contour in texels."""
    error = np.where(mask, image - reference, 0)

    def root_mean_square(where: npt.NDArray[np.bool_]) -> float:
        return float(np.sqrt(np.mean(np.square(error[where])))) if where.any() else float("nan")

    # Keep a filter's footprint away from edges: their blur is neither bleeding nor acne.
    distance = int(np.ceil((filter_size + 1) * texel.longest))
    dark, lit = (_eroded(mask & where, distance) for where in (reference < _DARK, reference > _LIT))
    return {
        "rmse": root_mean_square(mask),
        "rmse_shadowed": root_mean_square(mask & (reference < 0.5)),
        "bleeding": float(image[dark].mean()) if dark.any() else float("nan"),
        "acne": float(1 - image[lit].mean()) if lit.any() else float("nan"),
        "contour_shift_texels": contour_shift(image, reference, mask) / texel.size,
    }


def contour_shift(image: Image, reference: Image, mask: npt.NDArray[np.bool_]) -> float:
    """Mean distance in pixels between the contours at one half: area between them, divided by the reference's length."""
    mask = _eroded(mask, 1)  # the mask then holds all pixels of the averages below
    want = reference > 0.5
    low, high, all_ = slice(None, -1), slice(1, None), slice(None)

    def crossings(a: tuple[slice, slice], b: tuple[slice, slice]) -> float:
        return float(((want[a] != want[b]) & mask[a] & mask[b]).sum())

    straight = crossings((low, all_), (high, all_)) + crossings((all_, low), (all_, high))
    diagonal = crossings((low, low), (high, high)) + crossings((low, high), (high, low))
    return _area_between(image, reference, mask) / max(_LENGTH * (straight + diagonal / np.sqrt(2)), 1.0)


def _area_between(image: Image, reference: Image, mask: npt.NDArray[np.bool_]) -> float:
    """Area in pixels where one image, interpolated between pixel centres, is above one half and the other is not.

    Counting whole pixels, an edge along pixel rows would be off by a full pixel or not at all. Both images are averaged over
    3 x 3 pixels first, so that interpolation locates sharp edges, too.
    """
    image, reference = _averaged(image), _averaged(reference)
    corners = [(slice(i, i - 1 or None), slice(j, j - 1 or None)) for i in (0, 1) for j in (0, 1)]
    inside = np.ones_like(mask[1:, 1:])
    above = []
    for corner in corners:
        inside &= mask[corner]
    # Cells whose four corners lie on one side in each image count whole.
    for values in (image, reference):
        above.append(sum((values[corner] > 0.5).astype(np.int64) for corner in corners))
    crossed = inside & (((above[0] > 0) & (above[0] < 4)) | ((above[1] > 0) & (above[1] < 4)))
    area = float((inside & ~crossed & (above[0] != above[1])).sum())
    t = (np.arange(_FINER) + 0.5) / _FINER
    sides = []
    for values in (image, reference):
        a, b, c, d = (values[corner][crossed][:, None, None] for corner in corners)
        down, across = t[:, None], t
        sides.append((a * (1 - down) + c * down) * (1 - across) + (b * (1 - down) + d * down) * across > 0.5)
    return area + float((sides[0] != sides[1]).sum()) / _FINER**2


def _averaged(image: Image) -> npt.NDArray[np.floating]:
    """Means over 3 x 3 pixels; the border is replicated."""
    padded = np.pad(image.astype(np.float64), 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9


def _eroded(mask: npt.NDArray[np.bool_], distance: int) -> npt.NDArray[np.bool_]:
    """Pixels whose square neighbourhood (``distance`` pixels to each side, within the image) lies in the mask."""
    result = mask
    for axis in (0, 1):
        counts = np.cumsum(np.pad(~result, [(1, 0) if k == axis else (0, 0) for k in (0, 1)]), axis=axis)
        n = result.shape[axis]
        high, low = np.minimum(np.arange(n) + distance + 1, n), np.maximum(np.arange(n) - distance, 0)
        result = np.take(counts, high, axis) == np.take(counts, low, axis)
    return result
