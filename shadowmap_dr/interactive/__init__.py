"""Interactive modelling: the user paints on the shadow of a mesh, and the mesh follows."""

from .canvas import Canvas
from .modeller import Modeller
from .session import Session, Snapshot, Status

__all__ = ["Canvas", "Modeller", "Session", "Snapshot", "Status"]
