"""The Mitsuba plug-in ``shadowmap``: its parameters, and the state of scenes that it keeps from one image to the next."""

from .options import Options
from .plugin import install

__all__ = [
    "Options",
    "install",
]
