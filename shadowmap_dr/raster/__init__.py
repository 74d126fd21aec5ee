"""Screen-space primitives on Dr.Jit arrays: rasterize, interpolate, antialias. No lights, no scenes."""

from ._types import NO_TRIANGLE, RasterOutput
from .rasterize import rasterize

__all__ = ["NO_TRIANGLE", "RasterOutput", "rasterize"]
