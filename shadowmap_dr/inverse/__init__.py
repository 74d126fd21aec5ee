"""Inverse problems: what is optimised (parametrisations), how (loops that survive being killed), and sweeps over many runs."""

from .light_pixels import StillScene
from .lights import LightBatch, LightHistory, Stage
from .loop import History, Method, optimize
from .pose import PoseFit, apply_pose
from .problems import LossProblem, MethodProblem, Problem
from .sweep import run_sweep

__all__ = [
    "History",
    "LightBatch",
    "LightHistory",
    "LossProblem",
    "Method",
    "MethodProblem",
    "PoseFit",
    "Problem",
    "Stage",
    "StillScene",
    "apply_pose",
    "optimize",
    "run_sweep",
]
