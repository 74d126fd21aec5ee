"""A fit of a scene to pictures: starts, stages from coarse to fine, and the result."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..rendering.renderer import Renderer
from .changes import Changes
from .gains import Gain
from .judgement import judge
from .levenberg_marquardt import Limits, minimise
from .losses import Loss
from .motions import host_matrix
from .objective import Point
from .options import FitOptions
from .parameters import Parameter, SceneChange
from .resolve import Resolver
from .result import Estimate, FitResult, Picture, Step
from .stages import Stage, make_stages, qualities
from .starts import chosen, draw, going_on, half_ranges, with_gains
from .targets import Target
from .uncertainty import Uncertainty, uncertainty

Array = npt.NDArray[np.float64]

# Most steps of each start in a stage, and the longest step, in the fit's own numbers.
_STEPS, _LONGEST = 10, 0.3
_LAST_STEPS = 20
# Units of logarithms of gains: stops.
_STOP = math.log(2)


@dataclass
class _Run:
    """One start on its way: its number, current numbers x, cost and error, and the x of all steps by stage."""

    number: int
    x: Array
    cost: float = math.inf
    error: float = math.inf
    trail: list[tuple[int, Array, float]] | None = None


class Fit:
    """A fit of a scene to pictures.

    Iterate over :meth:`steps` to watch it, then ask for the :meth:`result`; or call :meth:`run` for both.

    Args:
        renderer: the renderer of the scene as it was given. It is not changed.
        targets: pictures, one or several, of one or several sensors.
        options: what varies, and settings of the search.
        known: known exposures of the pictures, factors; 1 where not given.

    Raises:
        ShadowmapError: names that the scene does not have; pictures that do not fit to their sensors; nothing varies.
    """

    def __init__(
        self, renderer: Renderer, targets: Sequence[Target], options: FitOptions, known: Sequence[float] | None = None
    ) -> None:
        self.renderer, self.targets, self.options = renderer, tuple(targets), options
        if not targets:
            raise ShadowmapError("there is no picture to fit to: give one by --target.")
        resolver = Resolver(renderer)
        self.parameters: list[Parameter] = [resolver.parameter(vary) for vary in options.vary]
        colours = 3 if options.white_balance else 1 if options.exposure else 0
        exposures = known or [1.0] * len(targets)
        self.gains = [Gain(colours, options.vignetting, exposure) for exposure in exposures]
        if not self.parameters and not any(gain.count for gain in self.gains):
            raise ShadowmapError("nothing varies: name something by --vary; --list lists all that can vary.")
        _check_sizes(renderer, self.targets)
        self._low, self._high, prior = self._bounds()
        side = min(options.resolution, max(max(target.width, target.height) for target in targets))
        levels = qualities(side, options.spp, renderer.settings.shadow.resolution)
        loss = Loss(options.loss, options.delta)
        self.stages: list[Stage] = make_stages(renderer, self.parameters, targets, self.gains, prior, loss, levels)
        self._runs: list[_Run] = []
        self._began = time.perf_counter()
        self.history: list[Step] = []

    @property
    def count(self) -> int:
        """Number of all fitted numbers."""
        return self.stages[0].objective.count

    def run(self) -> FitResult:
        """Take all steps, and return the result."""
        for _ in self.steps():
            pass
        return self.result()

    def steps(self) -> Iterator[Step]:
        """Take the steps, one after the other, and yield the error after each."""
        scene = self.stages[0].objective.views[0].count
        ranges = half_ranges(self.parameters)
        drawn = draw(ranges, self._low[:scene], self._high[:scene], self.options.starts, self.options.seed)
        starts = chosen(drawn, self.stages[0].objective, self.options.starts)
        self._runs = [_Run(k, x, trail=[]) for k, x in enumerate(starts)]
        going = list(self._runs)
        for number, stage in enumerate(self.stages):
            for run in going:
                yield from self._descend(run, number, stage)
            if number < len(self.stages) - 1:
                going = [going[k] for k in going_on([run.cost for run in going], len(self.stages) - 2 - number)]
        self._runs = sorted(going, key=lambda run: run.cost)

    def _descend(self, run: _Run, number: int, stage: Stage) -> Iterator[Step]:
        """Steps of a start in a stage."""
        found: list[Point] = []
        last = number == len(self.stages) - 1
        limits = Limits(self._low, self._high, _LONGEST, _LAST_STEPS if last else _STEPS)
        point = stage.objective.at(run.x)
        best, _ = minimise(stage.objective.at, point, limits, found.append)
        run.x, run.cost, run.error = best.x, best.cost, best.error
        for count, each in enumerate([point, *found]):
            assert run.trail is not None, "made with the run"
            run.trail.append((number, each.x, each.error))
            step: Step = {
                "start": run.number,
                "stage": stage.name,
                "step": count,
                "error": each.error,
                "seconds": time.perf_counter() - self._began,
            }
            self.history.append(step)
            yield step

    # ------------------------------------------------------------------------------------------------------ results

    @property
    def best(self) -> Array:
        """The numbers (n,) with the smallest loss."""
        if not self._runs:
            raise ShadowmapError("the fit has taken no steps yet: call run(), or iterate over steps().")
        return self._runs[0].x

    def change(self, x: Array) -> SceneChange:
        """The change of the scene at the numbers x."""
        return self.stages[-1].objective.views[0].change(x)

    def changes(self, x: Array) -> Changes:
        """The change of the scene for files, by the names of the scene's parameters."""
        change = self.change(x)
        values: dict[str, npt.NDArray[np.float64]] = {}
        for key, parts in change.values.items():
            values[key] = np.array([float(dr.detach(part)[0]) for part in parts])
        for name, light in change.lights.items():
            values |= _light_values(name, self.renderer.light(name), light)
        for number, camera in change.cameras.items():
            old = self.renderer.data.cameras(number)[0]
            if camera.to_world is not old.to_world:
                values[f"{old.name}.to_world"] = host_matrix(camera.to_world)
            if camera.x_fov is not old.x_fov:
                values[f"{old.name}.x_fov"] = np.array(dr.detach(camera.x_fov), np.float64)
        transforms = {name: host_matrix(matrix) for name, matrix in change.placements.items()}
        return Changes(values=values, transforms=transforms, vertices={})

    def result(self, command: str = "") -> FitResult:
        """The result of the steps taken so far."""
        stage, x = self.stages[-1], self.best
        point = stage.objective.at(x)
        spread = uncertainty(point, stage.objective)
        estimates, names = self._estimates(x, spread)
        found, words = judge(point, stage.objective, spread, names, [run.x for run in self._runs], [run.cost for run in self._runs])
        first = stage.objective.at(with_gains(np.zeros(stage.objective.views[0].count), stage.objective))
        pictures = [
            Picture(
                target=seen.image,
                start=first.recorded[k],
                fit=point.recorded[k],
                weight=seen.weight,
                frames=self._frames(k),
                name=self.targets[k].name,
                exposure=float(np.mean(seen.gain.colour_factors(x[stage.objective.gains[k]]))),
            )
            for k, seen in enumerate(stage.objective.observations)
        ]
        settings = {"vary": [vary.plain() for vary in self.options.vary], "starts": self.options.starts, "seed": self.options.seed}
        return FitResult(
            found=found,
            words=words,
            estimates=estimates,
            correlations=spread.correlations,
            names=names,
            pictures=pictures,
            history=self.history,
            seconds=time.perf_counter() - self._began,
            command=command,
            settings=settings,
        )

    def _frames(self, number: int) -> list[tuple[str, npt.NDArray[np.float32]]]:
        """Images of the best start's steps."""
        frames = []
        for stage, x, error in self._runs[0].trail or []:
            objective = self.stages[stage].objective
            image = objective.recorded(number, objective.views[number].image(x).copy(), x)
            frames.append((f"{self.stages[stage].name}, off by {100 * error:.1f} % of the brightness", image))
        return frames

    def _estimates(self, x: Array, spread: Uncertainty) -> tuple[list[Estimate], list[str]]:
        """(estimates of all parameters and gains, names of all numbers)."""
        estimates: list[Estimate] = []
        names: list[str] = []
        half, at, change = spread.half_widths, 0, self.change(x)
        for parameter in self.parameters:
            count, scale = len(parameter.labels), parameter.scale
            own = slice(at, at + count)
            at += count
            with np.errstate(invalid="ignore"):
                widths = scale.widths(x[own], half[own])
            label = parameter.vary.label
            estimates.append(
                Estimate(
                    name=label,
                    kind=parameter.kind,
                    labels=parameter.labels,
                    units=parameter.units,
                    values=scale.shown(x[own]),
                    start=scale.shown(np.zeros(count)),
                    half_width=np.where(np.isfinite(half[own]), widths, np.inf),
                    arrays=parameter.arrays(self.renderer, change),
                )
            )
            names += [label if count == 1 else f"{label} {one}" for one in parameter.labels]
        for target, gain, own in zip(self.targets, self.gains, self.stages[-1].objective.gains, strict=True):
            shown = target.name or "the picture"
            if gain.colours:
                one = slice(own.start, own.start + gain.colours)
                kind = "exposure" if gain.colours == 1 else "white balance"
                labels = ("exposure",) if gain.colours == 1 else ("red", "green", "blue")
                stops, widths = x[one] / _STOP, half[one] / _STOP
                zero = np.zeros(gain.colours)
                estimates.append(Estimate(f"{kind} of {shown}", kind, labels, ("stops",) * gain.colours, stops, zero, widths))
                names += [f"{kind} of {shown}" if gain.colours == 1 else f"{kind} of {shown}, {one}" for one in labels]
            if gain.vignetting:
                last = slice(own.stop - 1, own.stop)
                values = x[last], np.zeros(1), half[last]
                estimates.append(Estimate(f"vignetting of {shown}", "vignetting", ("in the corners",), ("",), *values))
                names.append(f"vignetting of {shown}")
        return estimates, names

    def _bounds(self) -> tuple[Array, Array, Array]:
        """(lower bounds, upper bounds, standard deviations of priors), all (n,), in the fit's own numbers."""
        low, high, prior = [], [], []
        for parameter in self.parameters:
            vary, scale, count = parameter.vary, parameter.scale, len(parameter.labels)
            least = parameter.natural[0] if vary.low is None else vary.low
            most = parameter.natural[1] if vary.high is None else vary.high
            low.append(np.broadcast_to(scale.number(least) if np.isfinite(least) else -np.inf, count))
            high.append(np.broadcast_to(scale.number(most) if np.isfinite(most) else np.inf, count))
            deviation = np.full(count, np.inf)
            if vary.prior is not None:
                unit = scale.shown(np.zeros(count)) if scale.logarithmic else scale.factor
                deviation = vary.prior / np.abs(unit)
            prior.append(deviation)
        for gain in self.gains:
            low.append(np.array([-8.0] * gain.colours + [-0.95] * gain.vignetting))
            high.append(np.array([8.0] * gain.colours + [1.0] * gain.vignetting))
            prior.append(np.full(gain.count, np.inf))
        return tuple(np.concatenate([np.zeros(0), *parts]) for parts in (low, high, prior))  # type: ignore[return-value]


def _light_values(name: str, old: object, new: object) -> dict[str, npt.NDArray[np.float64]]:
    """Values of a changed light by the names of Mitsuba's parameters."""
    values: dict[str, npt.NDArray[np.float64]] = {}
    for field, key in (("irradiance", "irradiance.value"), ("intensity", "intensity.value"), ("position", "position")):
        if getattr(new, field, None) is not getattr(old, field, None) and not (field == "position" and hasattr(new, "to_world")):
            values[f"{name}.{key}"] = np.array(dr.detach(getattr(new, field)), np.float64).ravel()
    for field in ("cutoff_angle", "beam_width"):
        if getattr(new, field, None) is not getattr(old, field, None):
            values[f"{name}.{field}"] = np.array(dr.detach(getattr(new, field)), np.float64).ravel()
    if getattr(new, "to_world", None) is not getattr(old, "to_world", None):
        values[f"{name}.to_world"] = host_matrix(new.to_world)  # type: ignore[attr-defined]
    elif not hasattr(new, "to_world") and getattr(new, "direction", None) is not getattr(old, "direction", None):
        direction = np.array(dr.detach(new.direction), np.float64).ravel()  # type: ignore[attr-defined]
        values[f"{name}.to_world"] = _frame(direction)
    return values


def _frame(direction: Array) -> Array:
    """A rotation (4, 4) that takes the z axis to a direction."""
    forward = direction / np.linalg.norm(direction)
    side = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    side /= np.linalg.norm(side)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([side, np.cross(forward, side), forward], axis=1)
    return matrix


def _check_sizes(renderer: Renderer, targets: Sequence[Target]) -> None:
    """ShadowmapError for a picture of a sensor that does not exist, or of another shape than the sensor's."""
    for target in targets:
        name = f"picture {target.name or 'of the target'}"
        count = len(renderer.data.sensors)
        if not 0 <= target.sensor < count:
            raise ShadowmapError(f"{name} is of sensor {target.sensor}, but the scene has {count}, counted from 0.")
        cameras = renderer.data.cameras(target.sensor)
        if len(cameras) != 1:
            raise ShadowmapError(f"{name}: sensor {target.sensor} is a batch of cameras: use one of a single camera.")
        width, height = cameras[0].width, cameras[0].height
        if abs(width / height * target.height / target.width - 1) > 0.01 + 1 / min(target.width, target.height):
            raise ShadowmapError(
                f"{name} has {target.width} x {target.height} pixels, sensor {target.sensor} has {width} x {height}: these are of "
                "different shapes; crop the picture, or change the film's width and height in the scene."
            )
