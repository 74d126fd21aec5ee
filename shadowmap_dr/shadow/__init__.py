"""Shadow maps for directional, spot and point lights: cameras, moments, filters, visibility. No Mitsuba."""

from .caster_bounds import Boxes, casting_shapes, receiving_shapes, shape_boxes
from .filters import FILTERS, filter_kernel, filter_map
from .frustum_fit import Bounds, fit_frusta, shape_bounds
from .light_camera import (
    Frusta,
    LightView,
    Views,
    cube_face,
    cube_views,
    directional_view,
    project,
    spot_view,
    stack_views,
    to_light_space,
    vertices_in_maps,
    with_depths_from_planes,
)
from .lookup import tiled_transmittance, tiled_visibility, transmittance, visibility
from .methods.comparison import standard_visibility
from .methods.registry import METHODS, PREFILTERED
from .methods.variance import chebyshev_visibility, variance_moments
from .settings import MAX_TILES, ShadowSettings
from .shadow_map import ShadowMaps, filter_maps, render_maps, vertices_of_maps
from .steady_axes import steady_axes
from .tile_fit import fit_tiles
from .tiles import Group, Tiles
from .transmittance_maps import TranslucentCasters, TransmittanceMaps

__all__ = [
    "FILTERS",
    "MAX_TILES",
    "METHODS",
    "PREFILTERED",
    "Bounds",
    "Boxes",
    "Frusta",
    "Group",
    "LightView",
    "ShadowMaps",
    "ShadowSettings",
    "Tiles",
    "TranslucentCasters",
    "TransmittanceMaps",
    "Views",
    "casting_shapes",
    "chebyshev_visibility",
    "cube_face",
    "cube_views",
    "directional_view",
    "filter_kernel",
    "filter_map",
    "filter_maps",
    "fit_frusta",
    "fit_tiles",
    "project",
    "receiving_shapes",
    "render_maps",
    "shape_bounds",
    "shape_boxes",
    "spot_view",
    "stack_views",
    "standard_visibility",
    "steady_axes",
    "tiled_transmittance",
    "tiled_visibility",
    "to_light_space",
    "transmittance",
    "variance_moments",
    "vertices_in_maps",
    "vertices_of_maps",
    "visibility",
    "with_depths_from_planes",
]
