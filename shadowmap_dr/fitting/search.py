"""A fit of a scene to pictures: starts, stages from coarse to fine, and the result."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..io import records
from ..jit.arrays import device_array
from ..jit.types import Float
from ..rendering.renderer import Renderer
from .arrays import ArrayParameter, TextureValues, ValueDescent
from .bounds import bounds_of
from .changes import Changes, FittedScene
from .corrections import Corrections
from .estimates import array_estimates, changes_of, estimates_of, gain_estimates
from .gains import Gain
from .judgement import Unexplained, bound_sentences, largest_share, sentences, unexplained
from .levenberg_marquardt import Limits, minimise
from .losses import Loss
from .objective import Point
from .options import FitOptions
from .own_losses import OwnFunction, function_name
from .places import best_places
from .reference_steps import MOST_NUMBERS, reference_steps
from .resolve import Resolver
from .result import FitResult, Picture, Step
from .scene_change import SceneChange
from .sensor_pictures import as_seen, colourless
from .shadow_pictures import lit_share
from .stages import Stage, make_stages, qualities
from .starts import chosen, draw, groups_of, half_ranges, redraw, with_gains
from .state import Run, Sizes, State
from .targets import Target, short_names
from .texture_brightness import TextureBrightness
from .uncertainty import shares_of_intervals, uncertainty

Array = npt.NDArray[np.float64]

# Most steps of each start in a stage, and the longest step, in the fit's own numbers.
_STEPS, _LAST_STEPS, _LONGEST = 8, 15, 0.3
# Improvement of the loss, as a share, below which a step is the last of its stage.
_ENOUGH = 1e-3
# Corrections of the images at most, twice as many while steps are longer than half an interval; steps after each, and the
# improvement and the length below which steps are the last. Images that explain less than the last share are too far from the
# pictures to be worth it.
_CORRECTIONS, _CORRECTED_STEPS, _LITTLE, _SHORT, _FAR = 6, 3, 1e-4, 3e-4, 0.5
# Steps after a correction, in half-widths of intervals, below which it is the last.
_SLIGHT = 0.15
# More corrections as long as each lowers the loss by such a share, at most.
_WORTH_ANOTHER, _MOST_CORRECTIONS = 0.1, 24
# Corrections after which a start is left, if it leaves a larger share unexplained.
_FEW_CORRECTIONS, _CLOSE = 2, 0.15
# Growth of the ranges of starts from one try to the next. First stage of turned objects, and their least turn in ranges.
_GROWTH, _TURNED_STAGE, _APART = 0.5, 2, 0.7
# Textures and vertices: stages in which they are fitted, the last ones; rounds of a stage, in turns with the numbers; size of the
# last step as a share of the first one's.
_ARRAY_STAGES, _ROUNDS, _LAST_SHARE = 3, 3, 0.1


class Fit:
    """A fit of a scene to pictures.

    Iterate over :meth:`steps` to watch it, then ask for the :meth:`result`; or call :meth:`run` for both.

    Args:
        renderer: the renderer of the scene as it was given. It is not changed.
        targets: pictures, one or several, of one or several sensors.
        options: things that vary, and settings of the search.
        residuals, loss: functions of yours, see :func:`~shadowmap_dr.fitting.fit`.

    Raises:
        ShadowmapError: names that the scene does not have; pictures that do not fit to their sensors; nothing varies; functions
            that are not differentiable.
    """

    def __init__(
        self,
        renderer: Renderer,
        targets: Sequence[Target],
        options: FitOptions,
        residuals: OwnFunction | None = None,
        loss: OwnFunction | None = None,
    ) -> None:
        self.renderer, self.targets, self.options = renderer, tuple(targets), options
        if not targets:
            raise ShadowmapError("there is no picture to fit to: give one by --target.")
        resolver = Resolver(renderer)
        self.parameters, self.arrays = resolver.parameters(options.vary)
        colours = 3 if options.white_balance else 1 if options.exposure else 0
        self.gains = [Gain(colours, options.vignetting, target.exposure) for target in targets]
        if not options.vary and not any(gain.count for gain in self.gains):
            raise ShadowmapError("nothing varies: name something by --vary; --list lists all that can vary.")
        self.targets = as_seen(renderer, self.targets)
        numbers = bool(self.parameters) or any(gain.count for gain in self.gains)
        _check_functions(residuals, loss, numbers=numbers)
        # Textures make up for exposures, lights and colours.
        textures = [array for array in self.arrays if isinstance(array, TextureValues)]
        factors = [TextureBrightness(texture) for texture in textures] if numbers else []
        first = sum(len(one.labels) for one in self.parameters)
        self._brightness = list(zip(range(first, first + len(factors)), textures, strict=False))
        self.parameters += factors
        functions = {"residuals": residuals, "loss": loss}
        self._own_settings = {key: function_name(one) for key, one in functions.items() if one is not None}
        bounds = bounds_of(self.parameters, self.gains)
        self._low, self._high, self._given = bounds.low, bounds.high, bounds.given
        side = min(options.resolution, max(max(target.width, target.height) for target in targets))
        levels = qualities(side, options.spp, renderer.settings.shadow.resolution)
        pictures = self.parameters, self.arrays, self.targets, self.gains
        compared = Loss(options.loss, options.delta), levels, residuals, loss
        self.stages: list[Stage] = make_stages(renderer, *pictures, bounds.prior, *compared)
        windows = [(target.width, target.height) for target in targets]
        self._corrections = Corrections(renderer, self.stages[-1].objective, windows) if options.correct else None
        self._began = time.perf_counter()
        self._state = State([], [], 0, [array.start for array in self.arrays])

    @property
    def history(self) -> list[Step]:
        """Errors after all steps of all starts."""
        return self._state.history

    def run(self) -> FitResult:
        """Take all steps, and return the result."""
        for _ in self.steps():
            pass
        return self.result()

    def steps(self, state: Path | None = None, *, resume: bool = False) -> Iterator[Step]:
        """Take the steps, one after the other, and yield the error after each. The file is read before the first one.

        Args:
            state: file for the state after each start and stage; None for none.
            resume: go on from the file, if there is one.

        Raises:
            ShadowmapError: The file is damaged, or of another fit.
        """
        fingerprint = self._fingerprint()
        if state is not None and resume and state.exists():
            self._state = State.read(state, fingerprint, self._sizes())
            self._began = time.perf_counter() - max((step["seconds"] for step in self.history), default=0.0)
            self._set_values([device_array(mi.Float, own) for own in self._state.values])
        return self._all_steps(state, fingerprint)

    def _all_steps(self, state: Path | None, fingerprint: str) -> Iterator[Step]:
        tries = self.options.tries if self.parameters and not self.arrays else 1
        for attempt in range(tries):
            first = attempt * self.options.starts
            if attempt and self._corrections is not None and self.best_run.corrected:
                self._corrections.share([stage.objective for stage in self.stages], self.best)
            if len(self._state.runs) <= first:
                self._state.runs += self._starts(attempt)
            for number, stage in enumerate(self.stages):
                for run in self._state.going(number):
                    if not (number == len(self.stages) - 1 and self._is_to_be_corrected(run)):
                        yield from self._descend(run, number, stage, self._limits(number))
                    run.stage = number
                    if state is not None:
                        self._state.write(state, fingerprint)
                self._state.choose(number, len(self.stages) - 2 - number, first)
            best, last = self._state.best_from(first), attempt == tries - 1
            yield from self._correct(best, last=last)
            if not self.arrays and self._try_places(best):
                yield from self._descend(best, len(self.stages) - 1, self.stages[-1], self._limits(len(self.stages) - 1))
                best.corrected = False
                yield from self._correct(best, last=last)
            if attempt < tries - 1 and self._unexplained(self.best).is_small(largest_share(self.stages[-1].objective)):
                break
        yield from self._last_steps(self.best_run)
        for number in range(self._state.array_stage, len(self.stages) if self.arrays else 0):
            if number >= len(self.stages) - _ARRAY_STAGES:
                yield from self._fit_arrays(self.best_run, number, self.stages[number])
                self._state.array_stage = number + 1
                if state is not None:
                    self._state.write(state, fingerprint)
        if self._corrections is not None and self._corrections.put(self.best):
            self._corrections.keep_constant()

    def _starts(self, attempt: int) -> list[Run]:
        """The starts of a try: the best of many candidates.

        The ranges grow from try to try, and later tries have candidates that differ from the best numbers in a part only.
        """
        options, scene = self.options, self.stages[0].objective.views[0].count
        ranges = half_ranges(self.parameters, 1 + attempt * _GROWTH)
        low, high, seed = self._low[:scene], self._high[:scene], (options.seed, attempt)
        drawn, turned = draw(ranges, low, high, options.starts, seed, scene=attempt == 0), list[Array]()
        if attempt:
            wrong, best = self._unexplained(self.best).wrong(largest_share(self.stages[-1].objective)), self.best[:scene]
            every, turns = ([own for own in groups if wrong[own].any()] for groups in groups_of(self.parameters))
            # Objects in their places, but turned: coarse images do not tell turns apart.
            turned = redraw(best, turns, ranges, low, high, len(drawn), (*seed, 1), apart=_APART)
            drawn += redraw(best, every, ranges, low, high, len(drawn), (*seed, 2))
        middle = min(_TURNED_STAGE, len(self.stages) - 1)
        starts = [(x, -1) for x in chosen(drawn, self.stages[0].objective, options.starts, keep=attempt == 0)]
        if turned:
            half = options.starts // 2
            finer = chosen(turned, self.stages[middle].objective, half, keep=False)
            starts = starts[: options.starts - half] + [(x, middle - 1) for x in finer]
        return [Run(attempt * options.starts + k, x, stage=stage) for k, (x, stage) in enumerate(starts)]

    def _limits(self, number: int) -> Limits:
        """Limits of the steps in a stage."""
        steps = _LAST_STEPS if number == len(self.stages) - 1 else _STEPS
        return Limits(self._low, self._high, _LONGEST, steps, _ENOUGH)

    def _unexplained(self, x: Array) -> Unexplained:
        """Shares of the pictures' edges that the scene does not explain."""
        objective = self.stages[-1].objective
        return unexplained(objective.at(x), objective)

    def _is_to_be_corrected(self, run: Run) -> bool:
        """True if steps with corrected images follow."""
        if self._corrections is None or self.arrays or run.corrected:
            return False
        return self._unexplained(run.x).whole <= _FAR and self._corrections.put(run.x)

    def _correct(self, run: Run, *, last: bool) -> Iterator[Step]:
        """Steps of a start with corrected images. ``last``: no other try follows; else far starts are left early."""
        stage = len(self.stages) - 1
        if self._corrections is None or not self._is_to_be_corrected(run):
            return
        limits = Limits(self._low, self._high, _LONGEST, _CORRECTED_STEPS, _LITTLE, _SHORT)
        cost, share = math.inf, 0.0
        for number in range(_MOST_CORRECTIONS):
            little = run.cost > (1 - _WORTH_ANOTHER) * cost
            if number >= _CORRECTIONS * (1 if share < 1 else 2) and little:
                break
            before, cost = run.x, run.cost
            if not self._corrections.put(before):
                return
            if number == _FEW_CORRECTIONS and not last and self._unexplained(run.x).largest > _CLOSE:
                break
            yield from self._descend(run, stage, self.stages[stage], limits)
            share = self._share_of_intervals(run.x - before, run.x)
            if share < _SLIGHT:
                self._corrections.keep(run.x)
                break
        self._corrections.put(run.x)
        run.cost, run.corrected = self.stages[stage].objective.at(run.x).cost, True

    def _last_steps(self, run: Run) -> Iterator[Step]:
        """Steps of a corrected start by differences between Mitsuba's images, if few numbers vary."""
        if self._corrections is None or not run.corrected or not 0 < self.stages[-1].objective.views[0].count <= MOST_NUMBERS:
            return
        limits = Limits(self._low, self._high, _LONGEST)
        for better in reference_steps(self._corrections, self.stages[-1].objective, run.x, limits):
            run.x, run.cost = better.x, better.cost
            yield self._note(run, len(self.stages) - 1, better)

    def _try_places(self, run: Run) -> bool:
        """Set numbers that move few pixels, which the verdict does not see, to their best places. False if none is better."""
        objective, ranges = self.stages[-1].objective, half_ranges(self.parameters)
        numbers = np.flatnonzero(self._unexplained(run.x).few[: len(ranges)]).tolist()
        x, cost = best_places(lambda x: objective.at(x).cost, run.x, numbers, ranges, self._low, self._high)
        moved = bool((x != run.x).any())
        run.x, run.cost = x, cost
        return moved

    def _share_of_intervals(self, step: Array, x: Array) -> float:
        """Largest share of a number's half interval in a step (n,) to the numbers x; 0 for steps too short to matter."""
        if np.abs(step).max(initial=0) < _SHORT:
            return 0.0
        objective = self.stages[-1].objective
        return float(shares_of_intervals(step, objective.at(x), objective).max(initial=0))

    def _descend(self, run: Run, number: int, stage: Stage, limits: Limits) -> Iterator[Step]:
        """Steps of a start in a stage."""
        point = stage.objective.at(run.x)
        run.cost = point.cost
        yield self._note(run, number, point)
        for better in minimise(stage.objective.at, point, limits) if len(run.x) else ():
            run.x, run.cost = better.x, better.cost
            yield self._note(run, number, better)

    def _fit_arrays(self, run: Run, number: int, stage: Stage) -> Iterator[Step]:
        """Steps of the textures and vertices in a stage, in turns with steps of the numbers."""
        begin = len(self.stages) - min(_ARRAY_STAGES, len(self.stages))
        each = max(1, self.options.steps // (len(self.stages) - begin) // _ROUNDS)
        total = each * _ROUNDS * (len(self.stages) - begin)
        done = each * _ROUNDS * (number - begin)
        self._state.values = [
            own * self._factor_of(array, run.x) for array, own in zip(self.arrays, self._state.values, strict=True)
        ]
        run.x = self._without_brightness(run.x)
        descents = [array.descent(own) for array, own in zip(self.arrays, self._state.values, strict=True)]
        values = [device_array(type(g), own) for g, own in zip(stage.objective.views[0].values, self._state.values, strict=True)]
        for _ in range(_ROUNDS):
            if number == len(self.stages) - 1 and self._corrections is not None:
                self._corrections.remove()  # textures and vertices have changed
                self._corrections.put(run.x)
            for _ in range(each):
                share = 1 - (1 - _LAST_SHARE) * done / total
                gradients = stage.objective.gradient(run.x)
                values = [descent.step(one, share) for descent, one in zip(descents, gradients, strict=True)]
                stage.objective.set_values(values)
                done += 1
            yield from self._descend(run, number, stage, replace(self._limits(number), steps=3))
            for k, (array, descent) in enumerate(zip(self.arrays, descents, strict=True)):
                if isinstance(descent, ValueDescent):
                    values[k] = descent.scaled(self._factor_of(array, run.x))
            run.x = self._without_brightness(run.x)
            stage.objective.set_values(values)
        self._state.values = [np.array(one, np.float32) for one in values]
        self._set_values(values)

    def _factor_of(self, array: ArrayParameter, x: Array) -> float:
        """The common factor of an array's values at the numbers x."""
        return math.exp(sum(x[k] for k, texture in self._brightness if texture is array))

    def _without_brightness(self, x: Array) -> Array:
        """The numbers x after the factors of the textures have become part of their values."""
        x = x.copy()
        x[[k for k, _ in self._brightness]] = 0
        return x

    def _set_values(self, values: Sequence[Float]) -> None:
        """Set the values of textures and vertices in all stages."""
        for stage in self.stages:
            stage.objective.set_values(values)

    def _note(self, run: Run, number: int, point: Point) -> Step:
        """Write a step down."""
        stage = self.stages[number].name
        count = sum(step["start"] == run.number and step["stage"] == stage for step in self.history)
        seconds = time.perf_counter() - self._began
        step: Step = {"start": run.number, "stage": stage, "step": count, "error": point.error, "seconds": seconds}
        self.history.append(step)
        run.trail.append((number, self._without_brightness(point.x)))
        return step

    def _sizes(self) -> Sizes:
        """Sizes of the state of this fit."""
        return Sizes(len(self._low), len(self.stages), tuple(len(array.start) for array in self.arrays))

    def _fingerprint(self) -> str:
        """Text that identifies the fit."""
        pictures = [[records.digest_of(t.image, t.weight), t.sensor, t.exposure] for t in self.targets]
        entries = {
            "options": repr(self.options),
            "pictures": pictures,
            "numbers": len(self._low),
            "functions": self._own_settings,
        }
        return records.digest({**entries, "scene": self._scene_digest()})

    def _scene_digest(self) -> str:
        """Text that identifies the scene: numbers of Mitsuba's parameters, but for normals, whose last digits may differ."""
        table = mi.traverse(self.renderer.data.scene)
        keys = [key for key in table.properties if not key.endswith("normals")]
        values = [value for key in keys if dr.is_array_v(value := table[key])]
        matrices = [camera.to_world.matrix for cameras in self.renderer.data.sensors for camera in cameras]
        return records.digest_of(*(np.array(dr.detach(value)) for value in (*values, *matrices)))

    # ------------------------------------------------------------------------------------------------------ results

    @property
    def best_run(self) -> Run:
        """The start with the smallest loss of those that came farthest."""
        if not self._state.runs or self._state.runs[0].stage < 0:
            raise ShadowmapError("the fit has taken no steps yet: call run(), or iterate over steps().")
        return self._state.best

    @property
    def best(self) -> Array:
        """The numbers (n,) with the smallest loss."""
        return self.best_run.x

    def change(self, x: Array) -> SceneChange:
        """The change of the scene at the numbers x."""
        return self.stages[-1].objective.views[0].change(x)

    def changes(self) -> Changes:
        """The fitted values for files, by the names of the scene's parameters."""
        return changes_of(self.change(self.best), self.renderer)

    def fitted_scene(self) -> FittedScene:
        """The scene as it is after the steps taken so far, for files."""
        origin, names = self.renderer.origin, list(mi.traverse(self.renderer.data.scene).properties)
        if origin is None:
            return FittedScene(self.changes(), names=names)
        source = origin.description if origin.file is None else Path(origin.file)
        return FittedScene(self.changes(), source, origin.parameters, names)

    def result(self, command: str = "") -> FitResult:
        """The result of the steps taken so far."""
        objective = self.stages[-1].objective
        point = objective.at(self.best)
        point.refresh()
        spread = uncertainty(point, objective, self._low, self._high)
        # Numbers that move nothing, which starts have left anywhere, are those of the scene.
        x = np.where(spread.idle, np.clip(0, self._low, self._high), point.x)
        self.best_run.x = x
        estimates, names = estimates_of(x, self.parameters, self.renderer, self.change(x), spread)
        of_gains, names_of_gains = gain_estimates(x, short_names(self.targets), self.gains, objective.gains, spread)
        names += names_of_gains
        shares = unexplained(point, objective)
        textures = [array for array in self.arrays if isinstance(array, TextureValues)]
        found = shares.is_small(largest_share(objective))
        words = sentences(found, shares, point.error, spread, names, own=objective.has_own_residuals)
        words += bound_sentences(x, self._low, self._high, names, self._given)
        words += [] if found else colourless(textures, self.targets)
        if self._corrections is not None and self._corrections.failure:
            words.append(f"Images are not corrected, since Mitsuba cannot render the fitted scene: {self._corrections.failure}.")
        seconds = time.perf_counter() - self._began
        return FitResult(
            found=found,
            words=words,
            unexplained=shares.largest,
            estimates=[*estimates, *array_estimates(self.arrays, self._state.values), *of_gains],
            correlations=spread.correlations,
            names=names,
            pictures=self._pictures(point),
            history=self.history,
            seconds=seconds,
            command=command,
            settings={**self._own_settings, "vary": [vary.plain() for vary in self.options.vary]},
            scene=self.fitted_scene(),
        )

    def _pictures(self, point: Point) -> list[Picture]:
        """Pictures of the scene as it was given, and as it is at a point."""
        objective, values = self.stages[-1].objective, self.stages[-1].objective.views[0].values
        objective.set_values([device_array(type(one), array.start) for one, array in zip(values, self.arrays, strict=True)])
        first = with_gains(np.zeros(objective.views[0].count), objective)
        start = [objective.recorded(k, view.image(first).copy(), first) for k, view in enumerate(objective.views)]
        objective.set_values(values)
        shown = short_names(self.targets)
        return [
            Picture(
                target=seen.image,
                start=start[k],
                fit=point.recorded[k],
                weight=seen.weight,
                shadows=lit_share(objective.views[k], point.x),
                frames=self._frames(k),
                name=shown[k],
                exposure=float(np.mean(seen.gain.colour_factors(point.x[objective.gains[k]]))),
            )
            for k, seen in enumerate(objective.observations)
        ]

    def _frames(self, number: int) -> list[tuple[str, npt.NDArray[np.float32]]]:
        """Images of the best start's steps."""
        frames = []
        for count, (stage, x) in enumerate(self.best_run.trail):
            objective = self.stages[stage].objective
            image = objective.recorded(number, objective.views[number].image(x).copy(), x)
            frames.append((f"{self.stages[stage].name}, step {count}", image))
        return frames


def _check_functions(residuals: OwnFunction | None, loss: OwnFunction | None, *, numbers: bool) -> None:
    """ShadowmapError for functions that do not go together, or not with what varies. ``numbers``: true if few numbers vary."""
    if residuals is not None and loss is not None:
        raise ShadowmapError("residuals and loss are both functions: give one of them; loss may name a loss of residuals.")
    if loss is not None and numbers:
        raise ShadowmapError(
            f"loss {function_name(loss)}: a function of one number serves textures and vertices, which follow gradients; poses, "
            "lights, colours and exposures need residuals: give residuals=, or use shadowmap_dr.torch.Parameters in a loop."
        )
