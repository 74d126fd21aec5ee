"""Directions of directional lights from images, many runs at once.

All runs of a batch share one static scene and differ in their targets and current directions. R runs with n lights each are
rendered as one batch of R images and R n shadow maps. Every run has its own loss and optimiser moments.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.frozen import freeze, recordings_of
from ...jit.types import Float, Vector3f
from ...rendering.receivers.checks import real_array
from ...shadow import Frusta
from .pixels import StillScene
from .shading import fit_maps, images, light_views, losses_and_gradients, render_lights, with_shadow

FloatArray = npt.NDArray[np.float32]

# Steps that may wait for the device. With more, an interrupt is handled late, and progress runs ahead of the device.
_AHEAD = 10

# Bytes of one shadow map and its intermediate arrays, for each texel (measured, `vsm`).
_BYTES_OF_TEXEL = 150
# Likewise for each pixel of a run's image, and for each pixel and light.
_BYTES_OF_PIXEL, _BYTES_OF_LIT_PIXEL = 60, 20


@dataclass(frozen=True)
class LightState:
    """Directions of the M lights of a batch, and the optimiser's moments. A PyTree that may cross ``dr.freeze``.

    ``to_light``, ``m``, ``v``: Vector3f (M,), unit directions and Adam's moments; ``t``: Float of width 1, number of steps;
    ``frusta``: fit of the shadow maps, None without shadows.
    """

    to_light: Vector3f
    m: Vector3f
    v: Vector3f
    t: Float
    frusta: Frusta | None


@dataclass(frozen=True)
class Stage:
    """Steps with one filter: number ``iterations``, ``filter_size`` in texels (None: the scene's own), Adam's ``step_size``."""

    iterations: int
    filter_size: int | None = None
    step_size: float = 0.01


@dataclass(frozen=True)
class LightHistory:
    """Course of N steps of R runs with n lights each.

    ``losses`` (N, R): before each step. ``directions`` (N + 1, R, n, 3): unit vectors to the lights, at the start and after each
    step.
    """

    losses: FloatArray
    directions: FloatArray


class LightBatch:
    """Gradient descent (Adam) on the mean squared difference of linear colours, for many runs in one static scene.

    A step - shadow maps with tangents, shading, losses, their derivatives, Adam, back to unit length - is recorded once with
    `dr.freeze` for each number of runs and filter, and replayed from then on, without a read-back. Vertices have no gradients.

    Args:
        scene: see :class:`StillScene`.
        betas: of Adam.
    """

    def __init__(self, scene: StillScene, *, betas: tuple[float, float] = (0.9, 0.999)) -> None:
        self.scene = scene
        self._betas = betas
        self._step = freeze(_step)

    @property
    def lights(self) -> int:
        """Number n of lights of each run."""
        return self.scene.lights

    def render(self, directions: npt.ArrayLike) -> FloatArray:
        """Linear images (R, H, W, C) for the directions (R, n, 3) to the lights, of any length. Detached."""
        vectors, runs = self._vectors(directions)
        with dr.suspend_grad():
            _, light, _ = render_lights(self.scene, vectors, None)
            planes = images(self.scene, light, runs)
            shape = (runs, self.scene.pixels.height, self.scene.pixels.width)
            return np.stack([np.array(plane).reshape(shape) for plane in planes], -1)

    def loss_and_gradient(self, directions: npt.ArrayLike, targets: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Losses (R,) and their derivatives (R, n, 3) by the directions (R, n, 3) to the lights.

        Directions are normalised first. Derivatives lie in the tangent planes of the unit sphere.
        """
        vectors, runs = self._vectors(directions)
        with dr.suspend_grad():
            views, light, _ = render_lights(self.scene, vectors, None)
            losses, gradient = losses_and_gradients(self.scene, views, light, self._targets(targets, runs), runs)
            return np.array(losses), np.array(gradient).T.reshape(runs, self.lights, 3)

    def run(
        self,
        starts: npt.ArrayLike,
        targets: npt.ArrayLike,
        stages: tuple[Stage, ...] = (Stage(200),),
        on_step: Callable[[int], None] = lambda done: None,
    ) -> LightHistory:
        """Optimise all runs.

        Args:
            starts: (R, n, 3) directions to the lights.
            targets: (R, H, W, C) linear images.
            stages: run one after the other. Adam's moments carry over.
            on_step: called with the number of started steps; at most :data:`_AHEAD` of them are not finished.

        Raises:
            ShadowmapError: arrays have other shapes, or are not finite.
        """
        vectors, runs = self._vectors(starts)
        wanted = self._targets(targets, runs)
        scenes = [self.scene if s.filter_size is None else with_shadow(self.scene, filter_size=s.filter_size) for s in stages]
        losses: list[Float] = []
        directions = [vectors]
        with dr.suspend_grad():
            state = self._first_state(vectors)
            for stage, scene in zip(stages, scenes, strict=True):
                state = self._fitted(state, scene)
                rate = dr.opaque(mi.Float, stage.step_size)
                for _ in range(stage.iterations):
                    state, loss = self._step(scene, state, wanted, rate, runs, self._betas)
                    losses.append(loss)
                    directions.append(state.to_light)
                    if len(losses) % _AHEAD == 0:
                        dr.sync_thread()
                    on_step(len(losses))
            dr.sync_thread()
        shape = (len(directions), runs, self.lights, 3)
        kept = np.stack([np.array(d).T for d in directions]).reshape(shape)
        return LightHistory(np.array([np.array(loss) for loss in losses], np.float32).reshape(-1, runs), kept)

    def stepper(self, starts: npt.ArrayLike, targets: npt.ArrayLike) -> Callable[[], Float]:
        """Make a function for measurements that takes one recorded step of all runs and returns their losses, Float (R,)."""
        vectors, runs = self._vectors(starts)
        wanted, rate = self._targets(targets, runs), dr.opaque(mi.Float, 0.01)
        with dr.suspend_grad():
            states = [self._first_state(vectors)]
            states[0] = self._fitted(states[0], self.scene)

        def step() -> Float:
            with dr.suspend_grad():
                states[0], losses = self._step(self.scene, states[0], wanted, rate, runs, self._betas)
            return losses

        return step

    def _first_state(self, vectors: Vector3f) -> LightState:
        m, v = (mi.Vector3f(*(_zeros(dr.width(vectors)) for _ in range(3))) for _ in range(2))
        return LightState(vectors, m, v, _zeros(1), None)

    def _fitted(self, state: LightState, scene: StillScene) -> LightState:
        """The state with a first fit of the maps, so that the recorded step always starts from a fit."""
        if scene.shadow.method == "none":
            return state
        return replace(state, frusta=_own_arrays(fit_maps(scene, light_views(state.to_light), None)))

    def recordings(self) -> int:
        """Number of recordings of a step so far."""
        return recordings_of(self._step)

    def _vectors(self, directions: npt.ArrayLike) -> tuple[Vector3f, int]:
        array = real_array("directions", directions, np.float64)
        if array.ndim != 3 or array.shape[1:] != (self.lights, 3) or not len(array):
            raise ShadowmapError(f"directions of shape {array.shape}: give (R, {self.lights}, 3) for R runs.")
        length = np.linalg.norm(array, axis=-1, keepdims=True)
        if not (np.isfinite(length) & (length > 0)).all():
            raise ShadowmapError("a direction has no length, or one that is not finite: give finite vectors other than zero.")
        unit = (array / length).reshape(-1, 3).astype(np.float32)
        return mi.Vector3f(*(device_array(mi.Float, unit[:, c]) for c in range(3))), len(array)

    def _targets(self, targets: npt.ArrayLike, runs: int) -> list[Float]:
        pixels, array = self.scene.pixels, real_array("targets", targets)
        shape = (runs, pixels.height, pixels.width, pixels.channels)
        if array.shape != shape or not np.isfinite(array).all():
            raise ShadowmapError(f"targets of shape {array.shape}: give finite values in the shape {shape}.")
        return [device_array(mi.Float, array[..., c]) for c in range(pixels.channels)]


def batch_bytes(lights: int, pixels: int, channels: int = 3, map_resolution: int = 0) -> int:
    """Approximate memory of each run of a batch, in bytes.

    Args:
        lights: number of lights of a run.
        pixels, channels: of an image.
        map_resolution: texels along each side of a map, times its supersampling; 0: no shadows.
    """
    return lights * _BYTES_OF_TEXEL * map_resolution**2 + pixels * (lights * _BYTES_OF_LIT_PIXEL + channels * _BYTES_OF_PIXEL)


def _zeros(count: int) -> Float:
    """A new evaluated array: recorded functions treat literals, and arrays that are passed twice, differently."""
    return dr.opaque(mi.Float, 0, count)


def _own_arrays(frusta: Frusta) -> Frusta:
    """A copy whose fields do not share arrays."""
    copy = Frusta(*(column + _zeros(dr.width(frusta.near)) for column in frusta.columns()))
    dr.eval(copy)
    return copy


def _step(
    scene: StillScene, state: LightState, targets: list[Float], rate: Float, runs: int, betas: tuple[float, float]
) -> tuple[LightState, Float]:
    views, light, frusta = render_lights(scene, state.to_light, state.frusta)
    losses, gradient = losses_and_gradients(scene, views, light, targets, runs)
    t = state.t + 1
    m = betas[0] * state.m + (1 - betas[0]) * gradient
    v = betas[1] * state.v + (1 - betas[1]) * (gradient * gradient)
    scale = rate * dr.sqrt(1 - dr.exp2(t * float(np.log2(betas[1])))) / (1 - dr.exp2(t * float(np.log2(betas[0]))))
    to_light = dr.normalize(state.to_light - scale * m / (dr.sqrt(v) + 1e-8))
    return LightState(to_light, m, v, t, frusta), losses
