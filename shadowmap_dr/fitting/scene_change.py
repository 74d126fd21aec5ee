"""Changes to a scene that numbers of a fit make, before an image is rendered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ..jit.types import Float, Matrix4f
from ..rendering.renderer import Renderer
from ..scene.lights.read import Light
from ..scene.sensor import Sensor


@dataclass
class SceneChange:
    """The changes that the numbers of a fit make to a scene, before an image is rendered.

    Attributes:
        renderer: the renderer of the scene as it was given.
        placements: affine maps of shapes, in the order of their application.
        lights: changed records of lights.
        cameras: changed records of sensors, by number.
        values: numbers of Mitsuba's parameters by their names in ``mi.traverse``.
        factors: common factors of the values of Mitsuba's arrays by their names.
        arrays: (values, shape) of Mitsuba's arrays by their names.
        vertices: world-space vertices of meshes, before they are moved.
    """

    renderer: Renderer
    placements: dict[str, Matrix4f] = field(default_factory=dict)
    lights: dict[str, Light] = field(default_factory=dict)
    cameras: dict[int, Sensor] = field(default_factory=dict)
    values: dict[str, list[Float]] = field(default_factory=dict)
    factors: dict[str, Float] = field(default_factory=dict)
    arrays: dict[str, tuple[Float, tuple[int, ...]]] = field(default_factory=dict)
    vertices: dict[str, Float] = field(default_factory=dict)

    def light(self, name: str) -> Any:  # Any: one of several records
        """The current record of a light."""
        return self.lights.get(name, self.renderer.light(name))

    def camera(self, number: int) -> Sensor:
        """The current record of a sensor."""
        return self.cameras.get(number, self.renderer.data.cameras(number)[0])

    def move(self, shapes: Sequence[str], matrix: Matrix4f) -> None:
        """Move shapes by an affine map, after the maps that they have."""
        for name in shapes:
            self.placements[name] = matrix @ self.placements[name] if name in self.placements else matrix
