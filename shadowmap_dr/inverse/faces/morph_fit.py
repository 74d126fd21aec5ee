"""Fit of a morphable model's weights, and of its position, to a shadow image on a planar receiver."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.frozen import freeze, recordings_of
from ...jit.types import Float
from ...rendering.receivers.checks import is_real, real_array
from ...rendering.receivers.planar_receiver import ReceiverShadows
from .blend_shapes import blend

BETAS = (0.9, 0.999)


class MorphFit:
    """Fit of weights (and a translation) to a shadow image by gradient descent (Adam).

    The loss is the mean squared difference of visibility plus ``prior`` times the mean square of the weights. For images with
    normally distributed errors of variance s^2, prior = s^2 * weights / pixels gives the most probable weights.

    A `Method` of the optimisation loop. A step - vertices, shadow maps, image, backward pass, Adam - is recorded once with
    `dr.freeze` and replayed from then on, without a read-back. Parameters are the weights, followed by the translation (x, y) in
    world units if ``translate`` is set.

    Args:
        shadows: shadow images of the model's faces.
        rest: (V, 3) vertices where all weights are zero, world space.
        basis: (N, V, 3) change of the vertices by each weight, N >= 1.
        reference: (H, W) visibility to fit, the shape of ``shadows.shape``.
        translate: fit an offset of the model parallel to the receiver, too.
        prior: strength of the prior that weights are normally distributed, 0 or more.
        step_size, translation_step: of Adam, for weights and translation.
        settings: further entries for `describe`.

    Raises ShadowmapError if shapes do not match, the reference is not finite, or the prior is negative.
    """

    def __init__(
        self,
        shadows: ReceiverShadows,
        rest: npt.ArrayLike,
        basis: npt.ArrayLike,
        reference: npt.ArrayLike,
        *,
        translate: bool = False,
        prior: float = 0.0,
        step_size: float = 0.2,
        translation_step: float = 0.01,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        given = {"rest": rest, "basis": basis, "reference": reference}
        positions, directions, image = (real_array(name, values) for name, values in given.items())
        if directions.ndim != 3 or directions.shape[1:] != positions.shape or not len(directions):
            raise ShadowmapError(f"a basis of shape {directions.shape} for vertices of shape {positions.shape}: give (N, V, 3).")
        if image.shape != shadows.shape or not np.isfinite(image).all():
            raise ShadowmapError(f"a reference of shape {image.shape}: give finite values in the shape {shadows.shape}.")
        if not is_real(prior) or prior < 0:
            raise ShadowmapError(f"a prior of {prior}: give a finite number, 0 or more.")
        self.count, self.translate = len(directions), translate
        if translate:  # vertices depend linearly on the translation, too: two more columns of the basis
            moves = np.zeros((2, *positions.shape), np.float32)
            moves[0, :, 0] = moves[1, :, 1] = 1
            directions = np.concatenate([directions, moves])
        self._shadows = shadows
        self._rest, self._basis = device_array(mi.Float, positions), device_array(mi.Float, directions)
        self.reference = image
        self._reference = device_array(mi.Float, image)
        self._prior = dr.opaque(mi.Float, prior)
        self._rates = {"weights": step_size} | ({"translation": translation_step} if translate else {})
        self._settings = {**(settings or {}), "prior": float(prior), "translate": translate}
        self._step = freeze(_step)
        self.reset(np.zeros(len(directions)))

    def reset(self, start: npt.ArrayLike) -> None:
        """Start from (N,) weights, followed by (x, y) if ``translate`` is set, with empty moments."""
        size = len(self._sizes())
        zero = np.zeros(self.count + (2 if self.translate else 0))
        self.load_state({"parameters": np.asarray(start), "m": zero, "v": zero, "t": np.zeros(size)})

    def step(self) -> Float:
        """Take one step. Returns the loss before the step, Float (1,), without waiting for the device."""
        return self._step(self._shadows, self._optimizer, self._rest, self._basis, self._reference, self._prior)

    def parameters(self) -> Float:
        """Current parameters, Float (N,) or (N + 2,): weights, and the translation. Detached, on the device."""
        return dr.detach(_all_parameters(self._optimizer))

    def vertices(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """(V, 3) vertices for the given parameters."""
        with dr.suspend_grad():
            return np.array(blend(self._rest, self._basis, self._checked(parameters))).reshape(-1, 3)

    def image(self, values: Float) -> Float:
        """Visibility, Float (H * W,), for parameters on the device, Float (N,) or (N + 2,). Attached."""
        return self._shadows.render(blend(self._rest, self._basis, values))

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Visibility (H, W, 1) for the given parameters. No gradients."""
        with dr.suspend_grad():
            return np.array(self.image(self._checked(parameters))).reshape(*self._shadows.shape, 1)

    def gradient(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Derivative of the loss by each parameter. The state of the fit stays as it is."""
        values = self._checked(parameters)
        dr.enable_grad(values)
        dr.backward(self._loss(values))
        return np.array(dr.grad(values))

    def _loss(self, values: Float) -> Float:
        weights = dr.gather(mi.Float, values, dr.arange(mi.UInt32, self.count))
        return _loss(self._shadows, self._rest, self._basis, self._reference, self._prior, values, weights)

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Parameters, Adam's moments m and v, and its step counts t."""
        states = [self._optimizer.state[name] for name in self._rates]
        joined = {"parameters": [dr.detach(value) for value, *_ in states]}
        for k, name in ((0, "t"), (1, "m"), (2, "v")):
            joined[name] = [moments[k] for *_, moments in states]
        return {name: np.concatenate([np.array(part).reshape(-1) for part in parts]) for name, parts in joined.items()}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`. Raises ShadowmapError if it holds another number of parameters."""
        sizes = self._sizes()
        split = {name: np.asarray(state[name]).reshape(-1) for name in ("parameters", "m", "v", "t")}
        total = sum(sizes.values())
        for name in ("parameters", "m", "v"):
            if split[name].shape != (total,):
                raise ShadowmapError(f"{name} of shape {split[name].shape}: give {total} numbers.")
        self._optimizer = mi.ad.Adam(lr=self._rates["weights"], beta_1=BETAS[0], beta_2=BETAS[1])
        begin = 0
        for k, (name, size) in enumerate(sizes.items()):
            part = slice(begin, begin + size)
            self._optimizer[name] = device_array(mi.Float, split["parameters"][part])
            value, promoted, rate, (t, m, v, v_max) = self._optimizer.state[name]
            t = device_array(type(t), split["t"][k : k + 1])
            m, v = (device_array(type(m), split[key][part]) for key in ("m", "v"))
            self._optimizer.state[name] = value, promoted, rate, (t, m, v, v_max)
            begin += size
        self._optimizer.set_learning_rate(self._rates)

    def recordings(self) -> int:
        """Number of recordings of the step so far. It stays the same once the fit is warm."""
        return recordings_of(self._step)

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        rates = {f"{name}_step": rate for name, rate in self._rates.items()}
        return {**self._settings, "optimizer": "Adam", **rates, "betas": list(BETAS)}

    def _sizes(self) -> dict[str, int]:
        return {"weights": self.count} | ({"translation": 2} if self.translate else {})

    def _checked(self, parameters: npt.ArrayLike) -> Float:
        values = real_array("parameters", parameters).reshape(-1)
        total = sum(self._sizes().values())
        if len(values) != total:
            raise ShadowmapError(f"{len(values)} parameters: give {total}.")
        return device_array(mi.Float, values)


def _all_parameters(optimizer: mi.ad.Optimizer) -> Float:
    weights = optimizer["weights"]
    return dr.concat([weights, optimizer["translation"]]) if "translation" in optimizer else weights


def _loss(
    shadows: ReceiverShadows, rest: Float, basis: Float, reference: Float, prior: Float, values: Float, weights: Float
) -> Float:
    """Mean squared difference, plus the prior. Attached to the parameters."""
    image = shadows.render(blend(rest, basis, values))
    return dr.mean(dr.square(image - reference)) + prior * dr.mean(dr.square(weights))


def _step(
    shadows: ReceiverShadows, optimizer: mi.ad.Optimizer, rest: Float, basis: Float, reference: Float, prior: Float
) -> Float:
    loss = _loss(shadows, rest, basis, reference, prior, _all_parameters(optimizer), optimizer["weights"])
    dr.backward(loss)
    optimizer.step()
    return dr.detach(loss)
