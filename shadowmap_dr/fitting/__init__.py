"""Fits of scenes to photographs: poses, lights, materials, cameras, textures and vertices."""

from .api import fit, prepared
from .options import FitOptions
from .own import Own
from .report import write_report
from .result import Estimate, FitResult, read_fit
from .scene_change import SceneChange
from .search import Fit
from .targets import Target, make_target, read_target
from .vary import Vary
from .writing import write_fit

__all__ = [
    "Estimate",
    "Fit",
    "FitOptions",
    "FitResult",
    "Own",
    "SceneChange",
    "Target",
    "Vary",
    "fit",
    "make_target",
    "prepared",
    "read_fit",
    "read_target",
    "write_fit",
    "write_report",
]
