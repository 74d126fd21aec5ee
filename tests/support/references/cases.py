"""Stored references: images of the scenes of the package, and derivative images of cases of the gradient suite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
from gradients import cases, scenes
from gradients.model import Parameter

FOLDER = Path(__file__).parent
RESOLUTION = scenes.SIZE
SCENES = ("pose", "gallery", "still_life", "meadow", "pavilion")
#: Scenes whose light passes through leaves, panes and cloth, and pixels along each side of their references.
TRANSLUCENT, TRANSLUCENT_RESOLUTION = ("leafy_tree", "stained_window", "curtain"), 96


@dataclass(frozen=True)
class Traced:
    """A path-traced derivative image: that of a parameter of a case of the gradient suite, by central differences."""

    case: str
    parameter: str

    @property
    def name(self) -> str:
        return f"{self.case}_{self.parameter}"

    @property
    def path(self) -> Path:
        return FOLDER / f"derivative_{self.name}.exr"

    @property
    def changed(self) -> Parameter:
        return cases.CASES_BY_NAME[self.case].parameters[self.parameter]

    def build(self, t: float) -> mi.Scene:
        """The scene with the parameter changed."""
        return cases.CASES_BY_NAME[self.case].scene_at(self.parameter, t)


TRACED = tuple(Traced(case, parameter) for case, parameters in cases.TRACED.items() for parameter in parameters)
