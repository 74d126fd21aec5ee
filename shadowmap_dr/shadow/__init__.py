"""Shadow maps for directional, spot and point lights: cameras, moments, filters, visibility. No Mitsuba."""

from .camera import (
    Frusta,
    LightView,
    Views,
    cube_face,
    cube_views,
    directional_view,
    spot_view,
    stack_views,
    to_light_space,
    vertices_in_maps,
)
from .casters import Boxes, casting_shapes, shape_boxes
from .filters import FILTERS, filter_kernel, filter_map
from .fit import fit_frusta, shape_bounds
from .lookup import visibility
from .methods import METHODS, PREFILTERED
from .moments import chebyshev_visibility, standard_visibility, variance_moments
from .shadow_map import ShadowMaps, ShadowSettings, filter_maps, render_maps

__all__ = [
    "FILTERS",
    "METHODS",
    "PREFILTERED",
    "Boxes",
    "Frusta",
    "LightView",
    "ShadowMaps",
    "ShadowSettings",
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
    "render_maps",
    "shape_bounds",
    "shape_boxes",
    "spot_view",
    "stack_views",
    "standard_visibility",
    "to_light_space",
    "variance_moments",
    "vertices_in_maps",
    "visibility",
]
