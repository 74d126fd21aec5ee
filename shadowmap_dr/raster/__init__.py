"""Screen-space primitives on Dr.Jit arrays: rasterize, interpolate, antialias. No lights, no scenes."""

from .antialiasing.antialias import antialias
from .antialiasing.creases import CoplanarCreases
from .antialiasing.edge_crossings import DEPTH_GAP, Crossings, find_crossings
from .antialiasing.front_surfaces import FrontSurfaces
from .closed_parts import drawing_order, outward_faces
from .interpolate import interpolate
from .peeling import LEAST_LOSS, deepest, peeled_layers, stacked
from .rasterize import check_resolution, locate, rasterize, visible_triangles, with_triangles
from .shape_seams import detach_moved_seams
from .topology import NO_VERTEX, Topology, build_topology
from .types import MAX_RESOLUTION, NO_TRIANGLE, RasterOutput

__all__ = [
    "DEPTH_GAP",
    "LEAST_LOSS",
    "MAX_RESOLUTION",
    "NO_TRIANGLE",
    "NO_VERTEX",
    "Crossings",
    "CoplanarCreases",
    "FrontSurfaces",
    "RasterOutput",
    "Topology",
    "antialias",
    "build_topology",
    "check_resolution",
    "drawing_order",
    "find_crossings",
    "interpolate",
    "locate",
    "outward_faces",
    "deepest",
    "detach_moved_seams",
    "peeled_layers",
    "rasterize",
    "stacked",
    "visible_triangles",
    "with_triangles",
]
