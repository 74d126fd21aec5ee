"""Screen-space primitives on Dr.Jit arrays: rasterize, interpolate, antialias. No lights, no scenes."""

from ._types import MAX_RESOLUTION, NO_TRIANGLE, RasterOutput
from .antialias import antialias
from .closed import drawing_order, outward_faces
from .creases import Folds
from .crossings import DEPTH_GAP, Crossings, find_crossings
from .interpolate import interpolate
from .rasterize import rasterize, visible_triangles
from .seams import parted
from .topology import NO_VERTEX, Topology, build_topology

__all__ = [
    "DEPTH_GAP",
    "MAX_RESOLUTION",
    "NO_TRIANGLE",
    "NO_VERTEX",
    "Crossings",
    "Folds",
    "RasterOutput",
    "Topology",
    "antialias",
    "build_topology",
    "drawing_order",
    "find_crossings",
    "interpolate",
    "outward_faces",
    "parted",
    "rasterize",
    "visible_triangles",
]
