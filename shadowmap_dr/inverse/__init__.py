"""Inverse problems: what is optimised (parametrisations), how (loops that survive being killed), and sweeps over many runs."""

from .blend_shapes import blend
from .collection import Collection
from .light_pixels import StillScene
from .lights import LightBatch, LightHistory, Stage
from .loop import History, Method, optimize
from .morph_fit import MorphFit
from .morphable import MorphableModel, load_model, save_model
from .pose import PoseFit, apply_pose
from .problems import LossProblem, MethodProblem, Problem
from .remeshing import RemeshingSculptor
from .sculpt import Sculptor
from .shadow_views import ShadowView, shadow_view
from .start_meshes import even_sphere
from .sweep import run_sweep

__all__ = [
    "Collection",
    "History",
    "LightBatch",
    "LightHistory",
    "LossProblem",
    "Method",
    "MethodProblem",
    "MorphFit",
    "MorphableModel",
    "PoseFit",
    "Problem",
    "RemeshingSculptor",
    "Sculptor",
    "ShadowView",
    "Stage",
    "StillScene",
    "apply_pose",
    "blend",
    "even_sphere",
    "load_model",
    "optimize",
    "run_sweep",
    "save_model",
    "shadow_view",
]
