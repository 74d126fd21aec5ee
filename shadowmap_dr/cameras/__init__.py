"""Cameras of photographs: from OpenCV, COLMAP and NeRF's files, as sensors of Mitsuba and records of the Renderer."""

from .camera import Camera, from_opencv, from_sensor, look_at
from .colmap import from_colmap
from .nerf import from_nerf
from .undistortion import undistort

__all__ = ["Camera", "from_colmap", "from_nerf", "from_opencv", "from_sensor", "look_at", "undistort"]
