"""A rigid pose with three parameters: a rotation about the vertical axis, then an offset in x and y."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.arrays import device_array
from ..jit.frozen import freeze, recordings_of
from ..jit.types import Float, TensorXf
from ..rendering.receivers.checks import real_array
from .image_blur import blurred


def apply_pose(p_rest: Float, pose: Float, shift_z: float = 0.0) -> Float:
    """Vertex positions of an object in a pose.

    Args:
        p_rest: Float (3V,), flat positions x0, y0, z0, x1, ... in the object's own space.
        pose: Float (3,): rotation about the y axis through the origin in radians, offset in x, offset in y.
        shift_z: constant offset in z.

    Returns Float (3V,): R_y(rotation) p + (x, y, shift_z). Gradients flow to `p_rest` and `pose`.
    """
    count = dr.width(p_rest) // 3
    # Each vertex gathers the pose: the backward pass then adds up all three derivatives in one kernel.
    rotation, x, y = dr.gather(mi.Vector3f, pose, dr.zeros(mi.UInt32, count))
    p = dr.gather(mi.Point3f, p_rest, dr.arange(mi.UInt32, count))
    s, c = dr.sincos(rotation)
    return cast(Float, dr.ravel(mi.Point3f(c * p.x + s * p.z + x, p.y + y, c * p.z - s * p.x + shift_z)))


class PoseFit:
    """Fit of a pose to a reference image by gradient descent (Adam) on the mean squared difference of linear colours.

    With ``blur``, gradients are those of blurred differences at first, whose width shrinks evenly to zero: shadows of thin parts
    then attract each other from farther away than they are wide. The loss is that of unblurred images at all steps.

    A `Method` of the optimisation loop. A step - vertices, rendering, loss, backward pass, Adam - is recorded once with
    `dr.freeze` and replayed from then on, without a read-back. Mitsuba's meshes stay as they are, and no rays are traced.

    Args:
        renderer: a `shadowmap_dr.Renderer`, or another object that can cross `dr.freeze` and has a method
            `render(vertex_positions={name: Float (3V,)})` -> tensor (H, W, C).
        shape: name of the shape that moves.
        p_rest: (V, 3) or (3V,) positions of its vertices in the object's own space.
        reference: (H, W, C) linear image.
        step_size, betas: parameters of Adam.
        shift_z: see `apply_pose`.
        spp: samples per pixel that the renderer is asked for.
        blur: standard deviation of the first step's blur, in pixels.
        blur_steps: number of steps after which no blur is left.
        settings: further entries for `describe`.

    Raises ShadowmapError for a reference that is no image or not finite.
    """

    def __init__(
        self,
        renderer: Any,  # Any: a Renderer, or another object with `render`
        shape: str,
        p_rest: npt.ArrayLike,
        reference: npt.ArrayLike,
        *,
        step_size: float = 0.01,
        betas: tuple[float, float] = (0.9, 0.999),
        shift_z: float = 0.0,
        spp: int = 1,
        blur: float = 0.0,
        blur_steps: int = 0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        image = real_array("reference", reference)
        if image.ndim != 3 or not np.isfinite(image).all():
            raise ShadowmapError(f"a reference of shape {image.shape}: give finite values in the shape (H, W, C).")
        self._initial_renderer = renderer
        self._shape = shape
        self._p_rest = device_array(mi.Float, real_array("p_rest", p_rest))
        self._reference = mi.TensorXf(device_array(mi.Float, image), image.shape)
        self._step_size, self._betas, self._shift_z = step_size, betas, shift_z
        self._spp = {} if spp == 1 else {"spp": spp}  # left out by default: a renderer need not have this option
        self._blur = (blur, blur_steps) if blur_steps else (0.0, 0)
        self._settings = dict(settings or {})
        self._step = freeze(_pose_step)
        self.reset(np.zeros(3))

    def reset(self, start: npt.ArrayLike) -> None:
        """Start from (rotation in radians, x, y) with empty moments."""
        self.load_state({"parameters": real_array("start", start), "m": np.zeros(3), "v": np.zeros(3), "t": np.zeros(1)})

    def step(self) -> Float:
        """Take one step. Returns the loss before the step, Float (1,), without waiting for the device."""
        constants: dict[str, Any] = {"shape": self._shape, "shift_z": self._shift_z, "spp": self._spp, "blur": self._blur}
        return self._step(self._renderer, self._optimizer, self._p_rest, self._reference, **constants)

    def parameters(self) -> Float:
        """Current parameters, Float (3,): rotation in radians, x, y. Detached, on the device."""
        return dr.detach(self._optimizer["pose"])

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Linear image (H, W, C) at the given parameters. No gradients."""
        pose = device_array(mi.Float, parameters)
        positions = apply_pose(self._p_rest, pose, self._shift_z)
        with dr.suspend_grad():
            # On a copy: a renderer keeps the fit of its shadow maps from one image to the next.
            return np.array(copy.copy(self._renderer).render(vertex_positions={self._shape: positions}, **self._spp))

    def gradient(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """(3,) derivative of the loss by the parameters. The state of the fit stays as it is."""
        pose = device_array(mi.Float, parameters)
        dr.enable_grad(pose)
        _gradient(copy.copy(self._renderer), pose, self._p_rest, self._reference, self._shape, self._shift_z, self._spp)
        return np.array(dr.grad(pose))

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Parameters (3,), Adam's moments m and v (3,), step count t (1,), and the fit of the renderer's shadow maps, if any."""
        pose, _, _, (t, m, v, _) = self._optimizer.state["pose"]
        state = {"parameters": np.array(dr.detach(pose)), "m": np.array(m), "v": np.array(v), "t": np.array(t)}
        frusta = getattr(self._renderer, "frusta", None)
        if frusta is not None:
            state |= {f"frusta.{name}": value for name, value in frusta.arrays().items()}
        return state

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`. Raises ShadowmapError if it does not hold three parameters."""
        pose = device_array(mi.Float, state["parameters"])
        if dr.width(pose) != 3:
            raise ShadowmapError(f"a pose of {dr.width(pose)} numbers: give rotation (radians), x and y.")
        self._optimizer = mi.ad.Adam(lr=self._step_size, beta_1=self._betas[0], beta_2=self._betas[1], params={"pose": pose})
        value, promoted, rate, (t, m, v, v_max) = self._optimizer.state["pose"]
        t = device_array(type(t), state["t"])
        m, v = (device_array(type(m), state[name]) for name in ("m", "v"))
        self._optimizer.state["pose"] = value, promoted, rate, (t, m, v, v_max)
        # The fit of the shadow maps depends on earlier images: a new run starts from the first fit, a resumed run from its own.
        self._renderer = copy.copy(self._initial_renderer)
        fit = {name.removeprefix("frusta."): value for name, value in state.items() if name.startswith("frusta.")}
        if fit:
            self._renderer.frusta = self._renderer.frusta.with_arrays(fit)

    def recordings(self) -> int:
        """Number of recordings of the step so far. It stays the same once the fit is warm."""
        return recordings_of(self._step)

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {**self._settings, "optimizer": "Adam", "step_size": self._step_size, "betas": list(self._betas)}


def _gradient(
    renderer: Any,  # Any: see `PoseFit`
    pose: Float,
    p_rest: Float,
    reference: TensorXf,
    shape: str,
    shift_z: float,
    spp: dict[str, int],
    blur: float = 0.0,
    width: Float | None = None,
) -> Float:
    """Add the derivative of the loss to the gradient of ``pose``. Returns the loss (mean squared difference), Float (1,).

    ``width``: Float (1,), standard deviation of the blur of differences, at most ``blur``.
    """
    image = renderer.render(vertex_positions={shape: apply_pose(p_rest, pose, shift_z)}, **spp)
    # Derived by hand: one kernel then reads the image for both the loss and its derivative.
    difference = dr.detach(image.array) - reference.array
    square, slope = dr.square(difference), difference * (2 / dr.width(difference))
    dr.eval(square, slope)
    if width is not None:
        slope = blurred(slope, image.shape, width, blur)
    dr.set_grad(image, type(image)(slope, shape=image.shape))
    dr.enqueue(dr.ADMode.Backward, image)
    dr.traverse(dr.ADMode.Backward)
    return dr.mean(square)


def _pose_step(
    renderer: Any,  # Any: see `PoseFit`
    optimizer: mi.ad.Optimizer,
    p_rest: Float,
    reference: TensorXf,
    *,
    shape: str,
    shift_z: float,
    spp: dict[str, int],
    blur: tuple[float, int] = (0.0, 0),
) -> Float:
    (most, steps), width = blur, None
    if most:
        # From Adam's count of steps, an array: the recording holds for all of them.
        width = most * dr.maximum(1 - mi.Float(optimizer.state["pose"][3][0]) / steps, 0)
        dr.eval(width)
    loss = _gradient(renderer, optimizer["pose"], p_rest, reference, shape, shift_z, spp, most, width)
    optimizer.step()
    return loss
