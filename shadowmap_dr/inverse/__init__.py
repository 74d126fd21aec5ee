"""Inverse problems: parametrisations, optimisation loops that resume from checkpoints, and sweeps over many runs."""

from ..rendering.receivers.shadow_views import ShadowView, shadow_view
from .faces.blend_shapes import blend
from .faces.morph_fit import MorphFit
from .faces.morphable import MorphableModel, load_model, save_model
from .light_directions.batch import LightBatch, LightHistory, Stage
from .light_directions.pixels import StillScene
from .pose import PoseFit, apply_pose
from .runs.loop import History, Method, optimize
from .runs.problems import LossProblem, MethodProblem, Problem
from .runs.sweep import run_sweep
from .shadow_art.collection import Collection
from .shadow_art.remeshing import RemeshingSculptor
from .shadow_art.sculpt import Sculptor
from .shadow_art.stained import StainedSheet
from .shadow_art.start_meshes import even_sphere

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
    "StainedSheet",
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
