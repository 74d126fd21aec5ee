"""The passes of an image: shadow maps, G-buffer, light, film."""

from .renderer import Renderer
from .settings import RenderSettings

__all__ = [
    "RenderSettings",
    "Renderer",
]
