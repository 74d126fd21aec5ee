"""Pictures of distorted lenses, resampled as pinhole cameras with square pixels would have taken them. Needs OpenCV."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .camera import Camera
from .distortion import distorted, opencv


def undistort(
    picture: npt.ArrayLike, camera: Camera, mask: npt.ArrayLike | None = None
) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """The picture that ``camera.undistorted()`` would have taken, and a mask of its pixels that the given picture shows.

    Bilinear, so linear colours are mixed rightly and sRGB ones almost. No gradients flow.

    Args:
        picture: (H, W) or (H, W, C), of any type of numbers that OpenCV knows; H and W are the camera's.
        camera: of the picture.
        mask: (H, W) bool, true for pixels that count.

    Returns:
        picture: (H', W) or (H', W, C), of the same type; zero outside the mask.
        mask: (H', W) bool.

    Raises:
        ShadowmapError: A picture of another size than the camera's; OpenCV is missing.
    """
    values = np.asarray(picture)
    if values.ndim not in (2, 3) or values.shape[:2] != (camera.height, camera.width):
        raise ShadowmapError(
            f"The picture has the shape {values.shape}, but camera {camera.name!r} has {camera.height} rows and {camera.width} "
            "columns: give the picture as it was taken, or camera.resized(width)."
        )
    counts = np.ones(values.shape[:2], bool) if mask is None else np.asarray(mask, bool)
    if counts.shape != values.shape[:2]:
        raise ShadowmapError(
            f"The mask has the shape {counts.shape}, the picture {values.shape}: give one of the picture's size."
        )
    if camera.is_square:
        return values.copy(), counts.copy()
    cv2 = opencv()
    target = camera.undistorted()
    row, column = np.mgrid[: target.height, : target.width].reshape(2, -1)
    flat = np.stack([(column + 0.5 - target.cx) / target.fx, (row + 0.5 - target.cy) / target.fy], -1)
    places = (
        distorted(flat, camera.K, camera.distortion, camera.fisheye).astype(np.float32).reshape(target.height, target.width, 2)
    )
    small = values.astype(np.float32) if values.dtype.kind in "bf" or values.dtype.itemsize > 2 else values
    moved = cv2.remap(small, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = np.logical_and(places >= -0.5, places <= np.array([camera.width, camera.height]) - 0.5).all(-1)
    # A pixel that a masked one has a share in does not count.
    shown = inside & (
        cv2.remap(counts.astype(np.float32), places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > 0.999
    )
    moved = moved.reshape(*moved.shape[:2], *values.shape[2:]).astype(values.dtype)
    moved[~shown] = 0
    return moved, shown
