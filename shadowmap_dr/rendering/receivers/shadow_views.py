"""Views of shadow art: a light, a receiver, and a camera that sees the receiver but not the object.

Light, receiver and camera never move. A view therefore holds the point of the receiver that each pixel sees, and no camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError, did_you_mean
from .checks import is_real, is_whole, real_array

RECEIVERS = ("plane", "wavy")
CAMERAS = ("orthographic", "perspective")

#: From the receiver's middle to the origin, where objects are, against the light; and half of the receiver's side.
DISTANCE, HALF = 4.0, 2.0
#: A wavy receiver: how far it reaches out of its plane, and how many waves cross it.
WAVE_HEIGHT, WAVES = 0.35, 1.5
#: A perspective camera: its place and the point it looks at (right, up, towards the object, from the receiver's middle), and its
#: horizontal angle. Rays from there to the receiver pass below the object.
BESIDE, LOOKS_AT, FOV_DEG = (3.0, 0.0, 3.0), (0.5, 0.0, 0.0), 54.0

Array = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ShadowView:
    """One light, its receiver, and the camera whose image of it is compared with a target. World space.

    Attributes:
        right, up, forward: (3,) orthonormal; light travels along ``forward``, perpendicular to the receiver's plane.
        origin: (3,) middle of the receiver.
        half: half of the receiver's side.
        points: (H, W, 3) the point of the receiver that each pixel sees; anything where ``seen`` is False.
        seen: (H, W) True for pixels that see the receiver.
        receiver, camera: their names, for records.
    """

    right: Array
    up: Array
    forward: Array
    origin: Array
    half: float
    points: Array
    seen: npt.NDArray[np.bool_]
    receiver: str = "plane"
    camera: str = "orthographic"

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the image."""
        height, width = self.seen.shape
        return height, width

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {"direction": self.forward.tolist(), "size": list(self.shape), "receiver": self.receiver, "camera": self.camera}


def shadow_view(
    direction: npt.ArrayLike = (0, 0, -1),
    up: npt.ArrayLike = (0, 1, 0),
    *,
    size: int = 256,
    receiver: str = "plane",
    camera: str = "orthographic",
    half: float = HALF,
) -> ShadowView:
    """A receiver behind the origin, as seen along a light's direction, and a camera that looks at it.

    Args:
        direction: (3,) in which light travels, any length.
        up: (3,) what is up in the image, any direction but the light's.
        size: pixels along each side of the image.
        receiver: ``plane``, or ``wavy``: a sine wave across the image.
        camera: ``orthographic``, between object and receiver: the image is the receiver, edge to edge. ``perspective``: from the
            side, on the right of the image; rays of light and of sight are far from parallel.
        half: half of the receiver's side; objects of size [-1, 1]^3 should cast shadows that leave some room.

    Raises ShadowmapError for names that do not exist, and numbers that make no sense.
    """
    if not isinstance(receiver, str) or receiver not in RECEIVERS:
        raise ShadowmapError(f"no receiver {receiver!r}: choose from {', '.join(RECEIVERS)}.{did_you_mean(receiver, RECEIVERS)}")
    if not isinstance(camera, str) or camera not in CAMERAS:
        raise ShadowmapError(f"no camera {camera!r}: choose from {', '.join(CAMERAS)}.{did_you_mean(camera, CAMERAS)}")
    if not is_whole(size) or not 16 <= size <= 2048:
        raise ShadowmapError(f"images of {size} x {size} pixels: choose from 16 to 2048.")
    if not is_real(half) or not half > 0:
        raise ShadowmapError(f"a receiver of half-side {half}: give a positive number.")
    axes = _axes(direction, up)
    local, seen = (_orthographic if camera == "orthographic" else _perspective)(receiver, size, half)
    forward = axes[2]
    origin = forward * (DISTANCE * half / HALF)
    # Local coordinates: right, up, and towards the object, which is against the light.
    points = origin + local @ np.stack([axes[0], axes[1], -forward])
    single = [a.astype(np.float32) for a in (*axes, origin)]
    return ShadowView(single[0], single[1], single[2], single[3], half, points.astype(np.float32), seen, receiver, camera)


def height(receiver: str, x: npt.NDArray[np.float64], half: float) -> npt.NDArray[np.float64]:
    """Distance of the receiver out of its plane, towards the object, at a distance x to the right of its middle."""
    if receiver == "plane":
        return np.zeros_like(x)
    return WAVE_HEIGHT * half / HALF * np.sin(WAVES * np.pi / half * x)


def _axes(direction: npt.ArrayLike, up: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], ...]:
    forward, upward = (real_array(name, v, np.float64).reshape(-1) for name, v in (("direction", direction), ("up", up)))
    right = np.cross(forward, upward) if forward.shape == upward.shape == (3,) else np.zeros(3)
    length = float(np.linalg.norm(right))
    if not (np.isfinite(length) and length > 1e-6 * np.linalg.norm(forward) * np.linalg.norm(upward)):
        raise ShadowmapError(f"light along {forward.tolist()} with {upward.tolist()} up: give two different directions.")
    right, forward = right / length, forward / np.linalg.norm(forward)
    return right, np.cross(right, forward), forward


def _grid(size: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """(x, y) in -1..1 of the pixels' centres, y up, row 0 at the top."""
    line = (2 * np.arange(size) + 1) / size - 1
    x, y = np.meshgrid(line, -line)
    return x, y


def _orthographic(receiver: str, size: int, half: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    x, y = (half * v for v in _grid(size))
    return np.stack([x, y, height(receiver, x, half)], -1), np.ones((size, size), np.bool_)


def _perspective(receiver: str, size: int, half: float) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """First points of the receiver along the rays of a camera beside it."""
    place, target = (np.array(point) * (half / HALF) for point in (BESIDE, LOOKS_AT))
    ahead = (target - place) / np.linalg.norm(target - place)
    # The image's up is the receiver's, as far as it can be.
    across = np.cross(ahead, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    x, y = (np.tan(np.radians(FOV_DEG / 2)) * v for v in _grid(size))
    ray = ahead + x[..., None] * across + y[..., None] * np.cross(across, ahead)
    t, hit = _first_hit(receiver, place, ray, half)
    points = place + t[..., None] * ray
    return np.where(hit[..., None], points, 0.0), hit & (np.abs(points[..., :2]) <= half).all(-1)


def _first_hit(
    receiver: str, place: npt.NDArray[np.float64], ray: npt.NDArray[np.float64], half: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.bool_]]:
    """Distance along rays (H, W, 3) from a place above the receiver, and whether there is one: steps, then bisection."""
    relief = WAVE_HEIGHT * half / HALF if receiver == "wavy" else 0.0
    down = ray[..., 2] < -1e-6
    slope = np.where(down, ray[..., 2], -1.0)
    near, far = (relief - place[2]) / slope, (-relief - 1e-9 - place[2]) / slope

    def above(t: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
        return place[2] + t * ray[..., 2] > height(receiver, place[0] + t * ray[..., 0], half)

    low, high = near, far
    if relief > 0:
        found = np.zeros(near.shape, np.bool_)
        for share in np.linspace(0, 1, 129)[1:]:
            t = near + share * (far - near)
            crossed = ~found & ~above(t)
            high, found = np.where(crossed, t, high), found | crossed
            low = np.where(found, low, t)
    for _ in range(40):
        middle = 0.5 * (low + high)
        is_above = above(middle)
        low, high = np.where(is_above, middle, low), np.where(is_above, high, middle)
    return 0.5 * (low + high), down
