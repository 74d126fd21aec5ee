"""Light records, read from Mitsuba's emitters."""

from .area import AreaLight
from .environment import Environment
from .projected import Beam, Projector
from .punctual import DirectionalLight, PointLight, SpotLight
from .read import Light

__all__ = [
    "AreaLight",
    "Beam",
    "DirectionalLight",
    "Environment",
    "Light",
    "PointLight",
    "Projector",
    "SpotLight",
]
