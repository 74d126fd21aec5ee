"""Fit of a pose by Levenberg and Marquardt's method: in small images first, then in averages of fine ones."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...fitting.levenberg_marquardt import Damping, Limits, after_step, minimise
from ...fitting.motion_parameters import ShapeMotion
from ...fitting.targets import make_target
from ...fitting.vary import Vary
from ...fitting.views import Quality
from ...rendering.receivers.checks import real_array
from ...rendering.renderer import Renderer
from .least_squares import Differences, Linear, mean_square
from .search import AWAY, EXPLAINED, TURN_DEG

Array = npt.NDArray[np.float64]

# Pixels, texels, and samples along a side of the coarse images. With fewer samples, images miss parts of thin objects, and
# descents end elsewhere; with fewer pixels, other poses look alike.
_COARSE, _COARSE_TEXELS, _COARSE_SAMPLES = 16, 64, 128
# Pixels along a side, at most, at which fine images are compared, and samples along a side of their derivatives. Samples matter:
# derivatives at few of them hold noise, by which steps become too short.
_COMPARED, _SLOPE_SAMPLES = 64, 256
# Most steps in coarse and in fine images. Coarse steps shorter than _COARSE_SHORTEST (radians, or scene units) are not worth it;
# one shorter than _NEAR is the last if the image is explained, and nobody looks where it leads: fine images are better at that. A
# fine step longer than _FAR calls for other derivatives, one shorter than _SHORTEST is the last, and one after which the loss is
# larger by _NOISE is taken back.
_COARSE_STEPS, _COARSE_SHORTEST, _NEAR = 12, 0.01, 0.06
_FINE_STEPS, _FAR, _SHORTEST, _NOISE = 4, 0.015, 5e-4, 1.1
# Longest change of a number in a step: radians, or scene units. Least share of the loss that a coarse step has to promise. After
# several descents have failed, the least share, and full steps that may be worse.
_LONGEST, _WORTH, _PATIENT_WORTH, _PATIENT_DARES = 0.3, 0.1, 0.01, 2
# Passes are long, and their number is what counts: steps that fail are soon much shorter, or given up.
_DAMPING = Damping(worse=8.0, failed=0.03, least=1e-6, most=1.0)
# Rotations of the search for another basin, in multiples of TURN_DEG.
_TURNS, _FARTHER = (1, -1, 2, -2), (3, -3, 4, -4)


class GaussNewtonPose:
    """Fit of a rotation about y (radians) and an offset in x and y: a `Method` of the optimisation loop, as `PoseFit`.

    A descent in coarse images comes first. While it leaves more of the differences than `EXPLAINED` allows, others follow from
    rotations whose coarse images fit best. Then a few steps follow in averages of fine images, with derivatives that are computed
    once. After these, steps change nothing.

    Args:
        renderer: of the scene with the object in its target pose.
        shape: name of the object.
        reference: (H, W, 3) linear image.
        spp: samples per pixel of the fine images.
        shift_z: offset in z that the object has in the scene; the axis of rotation has it, too.
        settings: further entries for `describe`.
    """

    def __init__(
        self,
        renderer: Renderer,
        shape: str,
        reference: npt.ArrayLike,
        *,
        spp: int = 1,
        shift_z: float = 0.0,
        settings: Mapping[str, Any] | None = None,
    ) -> None:
        image = real_array("reference", reference)
        if image.ndim != 3 or not np.isfinite(image).all():
            raise ShadowmapError(f"a reference of shape {image.shape}: give finite values in the shape (H, W, C).")
        motion = ShapeMotion(Vary(shape, "pose"), 1.0, ("ry", "tx", "ty"), (shape,), np.array([0, 0, shift_z]))
        target, side, texels = make_target(np.maximum(image, 0)), max(image.shape[:2]), renderer.settings.shadow.resolution
        block = _block(image.shape[0], image.shape[1])
        fine = _quality(side, spp, texels)
        coarse = _quality(min(side, _COARSE), _spp(_COARSE_SAMPLES, min(side, _COARSE)), min(texels, _COARSE_TEXELS))
        slope_texels = max(min(texels, _COARSE_TEXELS), texels // block)
        slopes = _quality(side // block, _spp(_SLOPE_SAMPLES, side // block), slope_texels)
        self._coarse = Differences(renderer, motion, target, coarse)
        self._fine = Differences(renderer, motion, target, fine, block)
        self._slopes = Differences(renderer, motion, target, slopes)
        self._without = self._coarse.at(AWAY).cost
        self._settings = dict(settings or {})
        self._qualities = [f"{one.side} px, {one.spp} spp, {one.texels} texels" for one in (coarse, fine, slopes)]
        self._x = self._start = np.zeros(3)
        self._stage, self._loss = 0, 0.0
        self._course: Iterator[float] = iter(())
        self._record()
        self.reset(np.zeros(3))

    def reset(self, start: npt.ArrayLike) -> None:
        """Start from (rotation in radians, x, y)."""
        self.load_state({"parameters": real_array("start", start), "stage": np.zeros(1), "loss": np.zeros(1)})

    def step(self) -> float:
        """Take one step. Returns the mean squared difference of linear colours before it, in the images of its stage."""
        self._loss = next(self._course, self._loss)
        return self._loss

    def parameters(self) -> Array:
        """Current parameters (3,): rotation in radians, x, y."""
        return self._x.copy()

    def render(self, parameters: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Linear image (H, W, 3) at the given parameters."""
        return self._fine.image(real_array("parameters", parameters).astype(np.float64)).copy()

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Parameters (3,), the stage (1,): 0 coarse, 1 fine, 2 finished, and the last loss (1,)."""
        return {"parameters": self._x, "stage": np.array([self._stage]), "loss": np.array([self._loss])}

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`: from the beginning of its stage."""
        self._x = np.array(state["parameters"], np.float64).ravel()
        if self._x.shape != (3,):
            raise ShadowmapError(f"a pose of {self._x.size} numbers: give rotation (radians), x and y.")
        self._start, self._stage, self._loss = self._x, int(state["stage"][0]), float(state["loss"][0])
        self._course = self._steps()

    def describe(self) -> dict[str, Any]:
        """Settings for the record."""
        return {**self._settings, "optimizer": "Levenberg-Marquardt", "images": self._qualities}

    def _record(self) -> None:
        """Record all passes, so that no run waits for it. The first calls of some are recorded twice."""
        for x in np.array([[0.0, 0.0, 0.0], [0.01, 0.01, 0.01]]):
            self._coarse.at(x)
            self._coarse.difference(x)
            self._fine.difference(x)
            self._slopes.columns(x)

    def _steps(self) -> Iterator[float]:
        """All steps from the current stage on. Each sets the pose and yields the loss before it."""
        if self._stage == 0:
            loss = yield from self._descend()
            if not self._explained(loss):
                yield from self._descend_elsewhere(loss)
            self._stage = 1
        if self._stage == 1:
            yield from self._refine()
            self._stage = 2

    def _descend(self, *, patient: bool = False) -> Generator[float, None, float]:
        """Steps in coarse images. Returns the loss before the last one."""
        point = self._coarse.at(self._x)
        for shortest in (_NEAR, _COARSE_SHORTEST):
            for better in minimise(self._coarse.at, point, _limits(shortest, patient=patient)):
                self._x = better.x
                yield point.cost
                point = better
            if self._explained(point.cost):
                self._x = after_step(*point.system(), 0.0, point.x, _limits())
                yield point.cost
                break
        return point.cost

    def _descend_elsewhere(self, loss: float) -> Iterator[float]:
        """Descents from other rotations until one is good enough. Ends at the best pose.

        The first ones begin at offsets of the current pose, which is the end of the first descent with the loss ``loss``. Others
        follow from the start, whose offset is fitted alone before, with more patience.
        """
        best, found = self._x, loss
        for slid, turns in ((False, _TURNS), (True, (0, *_TURNS)), (True, _FARTHER)):
            middle = self._slid() if slid else best
            starts = [middle + np.array([math.radians(TURN_DEG * turn), 0, 0]) for turn in turns]
            losses = [self._coarse.loss(start) for start in starts]
            for k in np.argsort(losses):
                self._x = starts[k]
                end = yield from self._descend(patient=slid)
                if end < found:
                    best, found = self._x, end
                if self._explained(found):
                    self._x = best
                    return
        self._x = best

    def _explained(self, loss: float) -> bool:
        """True if so little of the differences is left in coarse images that the pose is near."""
        return loss <= EXPLAINED * self._without

    def _slid(self) -> Array:
        """The start with the best offset at its rotation, in coarse images."""
        limits, start = _limits(patient=True), self._start
        low, high = (np.concatenate([start[:1], bounds[1:]]) for bounds in (limits.low, limits.high))
        point = self._coarse.at(start)
        ends = list(minimise(self._coarse.at, point, replace(limits, low=low, high=high)))
        return (ends or [point])[-1].x

    def _refine(self) -> Iterator[float]:
        """Steps in fine images. The derivatives are those of the first pose, scaled to the changes that images show."""
        slopes: Linear | None = None
        last: tuple[Array, Array, Array] | None = None  # pose, differences and step before
        for _ in range(_FINE_STEPS):
            difference = self._fine.difference(self._x)
            loss = mean_square(difference)
            if last is not None:
                pose, before, step = last
                if loss > mean_square(before):
                    # Most often noise of images is all that is left, and the later pose is the better one.
                    self._x = pose if loss > _NOISE * mean_square(before) else self._x
                    return
                slopes = slopes and slopes.times(slopes.factor(step, difference - before))
            if slopes is None:
                slopes = Linear(self._slopes.columns(self._x))
            step = after_step(*slopes.system(difference), 0.0, self._x, _limits()) - self._x
            last, self._x = (self._x, difference, step), self._x + step
            yield loss
            length = np.abs(step).max()
            if length < _SHORTEST:
                return
            if length > _FAR:
                slopes = None


def _limits(shortest: float = _COARSE_SHORTEST, *, patient: bool = False) -> Limits:
    """Limits of steps in coarse images. ``patient``: also with steps that promise little, and with full ones over jumps."""
    free = np.full(3, np.inf)
    return Limits(
        -free,
        free,
        longest=_LONGEST,
        steps=_COARSE_STEPS,
        improvement=0.0,
        shortest=shortest,
        worth=_PATIENT_WORTH if patient else _WORTH,
        dares=_PATIENT_DARES if patient else 0,
        damping=_DAMPING,
    )


def _block(height: int, width: int) -> int:
    """Side in pixels of the blocks over which fine images of a size are averaged; 1 if no side fits well."""
    side = max(height, width)
    least = math.ceil(side / _COMPARED)
    return next((k for k in range(least, 2 * least) if height % k == width % k == 0), 1)


def _spp(samples: int, side: int) -> int:
    """Samples per pixel, a square number, of an image with about so many samples along a side."""
    return math.ceil(samples / side) ** 2


def _quality(side: int, spp: int, texels: int) -> Quality:
    return Quality(side, spp, texels, 16, 64)
