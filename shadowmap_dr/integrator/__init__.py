"""The Mitsuba plug-in ``shadowmap``: its parameters, and what it keeps of scenes from one image to the next."""

from .options import Options
from .plugin import install

__all__ = [
    "Options",
    "install",
]
