"""What one camera sees: which triangles its samples hit, and the records of its pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ...raster import Crossings, RasterOutput, Topology
from ...scene.sensor import Sensor
from .surface import Surface


@dataclass(frozen=True)
class CameraView:
    """One camera's visibility: clip-space vertices and what each sample sees, ``factor`` x ``factor`` samples a pixel.

    ``topology``: edges of the shapes that it sees, where they are now.
    """

    sensor: Sensor
    factor: int
    clip: Any
    raster: RasterOutput
    topology: Topology

    @property
    def columns(self) -> int:
        """Samples across the camera's whole picture, whatever part of it is rendered."""
        return self.sensor.film_size[0] * self.factor


@dataclass(frozen=True)
class GBuffer:
    """What a camera sees, H * W pixels, row-major.

    Attributes:
        sensor: the camera.
        surface: what each pixel sees.
        points: where visibility is looked up, all over the pixel (list of Point3f, H * W each); a pixel's is their mean.
        crossings: how pixels mix, None without anti-aliasing.
        seen: points all over what is seen (Point3f, world space) and a mask of those that there are.
    """

    sensor: Sensor
    surface: Surface
    points: list[Any]
    crossings: Crossings | None
    seen: tuple[Any, Any]
