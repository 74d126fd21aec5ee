"""Inverse problems: what is optimised (parametrisations) and how (a loop that survives being killed)."""

from .collection import Collection
from .loop import History, Method, optimize
from .pose import PoseFit, apply_pose
from .remeshing import RemeshingSculptor
from .sculpt import Sculptor
from .shadow_views import ShadowView, shadow_view
from .start_meshes import even_sphere

__all__ = [
    "Collection",
    "History",
    "Method",
    "PoseFit",
    "RemeshingSculptor",
    "Sculptor",
    "ShadowView",
    "apply_pose",
    "even_sphere",
    "optimize",
    "shadow_view",
]
