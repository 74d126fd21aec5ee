"""A problem for the fit: the true scene, what varies, and the photographs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .photographs import Photograph
from .scenes import Body, Scene
from .variations import Variation, start_scene, value, with_value

#: Start values of light from everywhere that stands for light which bounces.
AMBIENT = (0.04, 0.12)


@dataclass(frozen=True, eq=False)
class FitProblem:
    """A problem for ``shadowmap-dr fit``.

    Attributes:
        name: of its folder; says nothing of true values.
        truth: the true scene.
        varied: all that the fit varies.
        photographs: one for each camera.
        seed: of the start values and of noise.
        integrator: Mitsuba's that makes the pictures: `direct`, or `path` with light that bounces.
        spp: samples of each pixel of the pictures.
        ambient: names that stand for light which the fit does not model. They are varied, but have no true value.
        intruder: a thing in the pictures that the scene does not have; a mask leaves it out.
    """

    name: str
    truth: Scene
    varied: tuple[Variation, ...]
    photographs: tuple[Photograph, ...]
    seed: int
    integrator: str = "direct"
    spp: int = 256
    ambient: tuple[str, ...] = ()
    intruder: Body | None = None

    def start(self, number: int) -> Scene:
        """The scene with the start values of a run, the first is 0."""
        scene = start_scene(self.truth, self.varied, 1000 * self.seed + number)
        random = np.random.default_rng(1000 * self.seed + number + 500)
        for one in self.varied:
            if one.name in self.ambient:
                scene = with_value(scene, one, np.full(3, random.uniform(*AMBIENT)))
        return scene

    @property
    def scored(self) -> tuple[Variation, ...]:
        """All that has a true value. Pictures with light that bounces say too little of colours and intensities."""
        return tuple(
            one for one in self.varied if one.name not in self.ambient and (self.integrator == "direct" or one.kind != "value")
        )

    @property
    def common_factor(self) -> tuple[str, ...]:
        """Names of values that the exposures scale as well: those of all lights, or the colours of all materials.

        Their products with the exposures can be found, themselves they cannot.
        """
        lights = {lamp.id for lamp in self.truth.lamps} | {b.id for b in self.truth.bodies if b.radiance is not None}
        matte = {body.id for body in self.truth.bodies if body.radiance is None}
        varied = {kind: {one.part for one in self.varied if one.name in names} for kind, names in self._scalable().items()}
        names = self._scalable()
        if varied["lights"] >= lights:
            return names["lights"]
        return names["colours"] if varied["colours"] >= matte else ()

    def _scalable(self) -> dict[str, tuple[str, ...]]:
        return {
            "lights": tuple(one.name for one in self.varied if one.is_radiometric),
            "colours": tuple(one.name for one in self.varied if one.is_colour or one.kind == "texture"),
        }

    def targets(self) -> list[str]:
        """File names of the photographs."""
        count = len(self.photographs)
        return [f"photo{'' if count == 1 else f'-{k}'}{photo.suffix}" for k, photo in enumerate(self.photographs)]

    def masks(self) -> list[str]:
        """File names of the masks."""
        count = len(self.photographs)
        return [] if self.intruder is None else [f"mask{'' if count == 1 else f'-{k}'}.png" for k in range(count)]

    def options(self) -> list[str]:
        """Arguments of the command in the problem's folder, without its settings."""
        result = ["scene.xml"]
        for flag, files in (("--target", self.targets()), ("--mask", self.masks())):
            for k, file in enumerate(files):
                result += [flag, file if len(files) == 1 else f"{k}={file}"]
        for one in self.varied:
            result += ["--vary", one.name]
        # White balance has an exposure of each colour.
        result.append("--white-balance" if any(photo.white != (1, 1) for photo in self.photographs) else "--exposure")
        if any(photo.vignetting for photo in self.photographs):
            result.append("--vignetting")
        return result

    def described(self) -> Mapping[str, Any]:
        """The truth, for developers. The command never sees it."""
        scene = self.truth
        parts = {part.id: part.place.tolist() for part in scene.parts()}
        values = {one.name: value(scene, one).tolist() for one in self.varied if one.kind == "value"}
        return {
            "name": self.name,
            "diameter": scene.diameter(),
            "places": parts,
            "values": values,
            "fov": {camera.id: camera.fov for camera in scene.cameras},
            "photographs": [vars(photo) for photo in self.photographs],
            "integrator": self.integrator,
            "scored": [one.name for one in self.scored],
            "common factor": list(self.common_factor),
        }
