"""Fit of an occluder to its shadow image; the vertices depend linearly on a few parameters."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.frozen import freeze
from ...jit.types import Float, TensorXf
from ...rendering.renderer import Renderer
from .images import SHAPE


class ShadowFit:
    """Fit of p_rest + sum_k parameter_k basis_k to a shadow image, by Adam on the mean squared difference.

    A `Method` of the optimisation loop. A step is recorded once with `dr.freeze` and replayed from then on.

    Args:
        renderer: a renderer of one channel, the visibility.
        p_rest: (V, 3) positions of the occluder's vertices for parameters of zero.
        basis: (P, V, 3) derivative of the vertices by each parameter.
        reference: (H, W, 1) visibility to fit.
        step_size: of Adam.
        decay: factor of the step size at the end, reached exponentially, and number of steps until then; None: constant steps.
        settings: further entries for `describe`.

    Raises ShadowmapError if shapes do not match, or if the reference is not finite.
    """

    def __init__(
        self,
        renderer: Renderer,
        p_rest: npt.ArrayLike,
        basis: npt.ArrayLike,
        reference: npt.ArrayLike,
        *,
        step_size: float,
        decay: tuple[float, int] | None = None,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        rest, directions, image = (np.asarray(a, np.float32) for a in (p_rest, basis, reference))
        if directions.ndim != 3 or directions.shape[1:] != rest.shape:
            raise ShadowmapError(f"a basis of shape {directions.shape} for vertices of shape {rest.shape}: give (P, V, 3).")
        if image.ndim != 3 or not np.isfinite(image).all():
            raise ShadowmapError(f"a reference of shape {image.shape}: give finite values in the shape (H, W, C).")
        self._initial, self._renderer = renderer, renderer
        self._rest = device_array(mi.Float, rest)
        self._basis = [device_array(mi.Float, direction) for direction in directions]
        self._reference = mi.TensorXf(device_array(mi.Float, image), image.shape)
        self._step_size, self._decay, self._settings = step_size, decay, dict(settings or {})
        self._step = freeze(_step)
        self._values: list[Float]
        self._m: list[Float]
        self._v: list[Float]
        self._t: int
        self.reset(np.zeros(len(directions)))

    def reset(self, start: npt.ArrayLike) -> None:
        """Start anew from (P,) parameters, with empty moments."""
        zero = np.zeros(len(self._basis))
        self.load_state({"parameters": np.asarray(start, np.float64), "m": zero, "v": zero, "t": np.zeros(1, np.int64)})

    def step(self) -> Float:
        """Take a step. Returns the loss before it, Float (1,), without waiting for the device."""
        self._t += 1
        size = self._step_size
        if self._decay is not None:
            factor, steps = self._decay
            size *= factor ** min(1.0, (self._t - 1) / max(1, steps - 1))
        # Adam's bias correction is part of the step size, which is an array: a changed Python number would be recorded again.
        size *= np.sqrt(1 - _BETAS[1] ** self._t) / (1 - _BETAS[0] ** self._t)
        loss, self._values, self._m, self._v = self._step(
            self._renderer, self._values, self._m, self._v, dr.opaque(mi.Float, size), self._rest, self._basis, self._reference
        )
        return loss

    def parameters(self) -> Float:
        """Current parameters, Float (P,), on the device."""
        return dr.concat(self._values)

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Visibility (H, W, 1) for (P,) parameters. No gradients."""
        values = [mi.Float(float(x)) for x in np.asarray(parameters, np.float32)]
        with dr.suspend_grad():
            return np.array(copy.copy(self._renderer).render({SHAPE: _vertices(self._rest, self._basis, values)}))

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Parameters and moments (P,), step count t (1,), and the frustum of the shadow map."""
        arrays = {"parameters": self._values, "m": self._m, "v": self._v}
        state = {name: np.array(dr.concat(array)) for name, array in arrays.items()}
        frusta = self._renderer.frusta
        if frusta is not None:
            state |= {f"frusta.{name}": value for name, value in frusta.arrays().items()}
        return state | {"t": np.array([self._t])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from the result of `state`."""
        count = len(self._basis)
        for name in ("parameters", "m", "v"):
            if np.shape(state[name]) != (count,):
                raise ShadowmapError(f"{name} of shape {np.shape(state[name])}: give {count} numbers.")
        self._values, self._m, self._v = (
            [dr.opaque(mi.Float, float(x)) for x in state[name]] for name in ("parameters", "m", "v")
        )
        self._t = int(np.asarray(state["t"]).reshape(-1)[0])
        # The map's frustum follows the occluder with inertia: a run starts from the initial frustum, or from its stored one.
        self._renderer = copy.copy(self._initial)
        fit = {name.removeprefix("frusta."): value for name, value in state.items() if name.startswith("frusta.")}
        if fit and self._renderer.frusta is not None:
            self._renderer.frusta = self._renderer.frusta.with_arrays(fit)

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {**self._settings, "optimizer": "Adam", "step_size": self._step_size, "betas": list(_BETAS), "decay": self._decay}


_BETAS, _EPSILON = (0.9, 0.999), 1e-8


def _vertices(rest: Float, basis: list[Float], values: list[Float]) -> Float:
    result = rest
    for direction, value in zip(basis, values, strict=True):
        result = dr.fma(direction, value, result)
    return result


def _step(
    renderer: Renderer,
    values: list[Float],
    m: list[Float],
    v: list[Float],
    size: Float,
    rest: Float,
    basis: list[Float],
    reference: TensorXf,
) -> tuple[Float, list[Float], list[Float], list[Float]]:
    """A step of Adam: the loss before it, new values, new moments."""
    values = [dr.detach(value) for value in values]
    dr.enable_grad(values)
    image = renderer.render({SHAPE: _vertices(rest, basis, values)})
    loss = dr.mean(dr.square(image.array - reference.array))
    new_values, new_m, new_v = [], [], []
    if dr.grad_enabled(loss):  # without an anti-aliased map the loss may not depend on the vertices
        dr.backward(loss)
    for value, mean, square in zip(values, m, v, strict=True):
        gradient = dr.grad(value)
        mean = dr.fma(_BETAS[0], mean, (1 - _BETAS[0]) * gradient)
        square = dr.fma(_BETAS[1], square, (1 - _BETAS[1]) * gradient * gradient)
        new_m.append(mean)
        new_v.append(square)
        new_values.append(dr.detach(value) - size * mean / (dr.sqrt(square) + _EPSILON))
    return dr.detach(loss), new_values, new_m, new_v
