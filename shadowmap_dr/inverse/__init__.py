"""Inverse problems: what is optimised (parametrisations), how (loops that survive being killed), and sweeps over many runs."""

from .art.collection import Collection
from .art.remeshing import RemeshingSculptor
from .art.sculpt import Sculptor
from .art.shadow_views import ShadowView, shadow_view
from .art.start_meshes import even_sphere
from .faces.blend_shapes import blend
from .faces.morph_fit import MorphFit
from .faces.morphable import MorphableModel, load_model, save_model
from .lights.batch import LightBatch, LightHistory, Stage
from .lights.pixels import StillScene
from .loop import History, Method, optimize
from .pose import PoseFit, apply_pose
from .problems import LossProblem, MethodProblem, Problem
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
