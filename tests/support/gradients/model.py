"""A scene and its parameters, each changed by a number of its own: images, derivative images, gradients and differences."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

import shadowmap_dr  # noqa: F401  (registers the integrator)

from .changes import Change


@dataclass(frozen=True)
class Parameter:
    """A parameter that moves.

    Attributes:
        key: of ``mi.traverse(scene)``.
        change: its value for a number t, which is 0 at rest.
        step: half the distance in t of the two images of a central difference: boundaries move by 0.5 to 1 pixel in between.
    """

    key: str
    change: Change
    step: float


@dataclass(frozen=True)
class Case:
    """A scene and what moves in it.

    Attributes:
        build: makes the scene, all parameters at rest.
        parameters: by name.
        options: parameters of the integrator ``shadowmap``.
        spp: samples per pixel of our images.
    """

    name: str
    build: Callable[[], Any]
    parameters: Mapping[str, Parameter]
    options: Mapping[str, Any] = field(default_factory=dict)
    spp: int = 16

    def scene_at(self, parameter: str, t: float) -> Any:
        """The scene with one parameter changed; another one each time."""
        scene, chosen = self.build(), self.parameters[parameter]
        params = mi.traverse(scene)
        params[chosen.key] = chosen.change(type(params[chosen.key])(params[chosen.key]), mi.Float(t))
        params.update()
        return scene


class Model:
    """Renders a case through ``mi.render``. Images are (H, W, 3) arrays, sums over the samples of a pixel's area."""

    def __init__(self, case: Case, **options: Any) -> None:
        self.case = case
        self.scene = case.build()
        self.params = mi.traverse(self.scene)
        keys = {p.key for p in case.parameters.values()}
        self.rest = {key: type(self.params[key])(self.params[key]) for key in keys}
        self.integrator = mi.load_dict({"type": "shadowmap", **case.options, **options})

    def image_at(self, name: str, t: float) -> np.ndarray:
        """The image with one parameter changed."""
        # All numbers are opaque, so that all images of a case come from the same kernels.
        values = {key: dr.opaque(mi.Float, t if key == name else 0) for key in self.case.parameters}
        return np.array(self._render(values))

    def difference(self, name: str, step: float | None = None) -> np.ndarray:
        """Central difference of two images."""
        step = step or self.case.parameters[name].step
        return (self.image_at(name, step) - self.image_at(name, -step)) / (2 * step)

    def derivative(self, tangents: Mapping[str, float]) -> np.ndarray:
        """Forward mode: the change of the image with the parameters' numbers."""
        values = self._attached()
        for name, value in values.items():
            dr.set_grad(value, dr.opaque(mi.Float, tangents.get(name, 0.0)))
        image = self._render(values)
        dr.forward_to(image)
        self._rest()
        return np.array(dr.grad(image))

    def gradients(self, adjoint: np.ndarray) -> dict[str, float]:
        """Reverse mode: the change of <adjoint, image> with each parameter's number."""
        values = self._attached()
        dr.backward(dr.sum(self._render(values) * mi.TensorXf(adjoint), axis=None))
        self._rest()
        return {name: float(dr.grad(value)[0]) for name, value in values.items()}

    def _attached(self) -> dict[str, Any]:
        values = {name: dr.opaque(mi.Float, 0) for name in self.case.parameters}
        dr.enable_grad(values)
        return values

    def _render(self, values: Mapping[str, Any]) -> Any:
        current = dict(self.rest)
        for name, parameter in self.case.parameters.items():  # several may change the same value
            current[parameter.key] = parameter.change(current[parameter.key], values[name])
        self._write(current)
        return mi.render(self.scene, self.params, integrator=self.integrator, spp=self.case.spp)

    def _rest(self) -> None:
        """Leave nothing attached: Dr.Jit's calls of BSDFs also look at those of other scenes."""
        self._write(self.rest)

    def _write(self, values: Mapping[str, Any]) -> None:
        for key, value in values.items():
            self.params[key] = type(value)(value)
        self.params.update()
