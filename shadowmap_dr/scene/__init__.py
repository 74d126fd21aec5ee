"""Records of a Mitsuba scene (geometry, lights, sensors) and watches over its changes."""

from .load import SceneData

__all__ = [
    "SceneData",
]
