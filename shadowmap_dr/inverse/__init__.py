"""Inverse problems: what is optimised (parametrisations) and how (a loop that survives being killed)."""

from .loop import History, Method, optimize
from .pose import PoseFit, apply_pose

__all__ = ["History", "Method", "PoseFit", "apply_pose", "optimize"]
