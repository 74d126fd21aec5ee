"""Records of a Mitsuba scene: geometry, lights, sensors, and what has changed in it."""

from .load import SceneData

__all__ = [
    "SceneData",
]
