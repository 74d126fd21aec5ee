"""Light estimation as a problem of sweeps: all runs of one object under n lights with one setting."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...inverse import LightBatch, Problem, Stage, StillScene
from ...inverse.light_directions.batch import batch_bytes
from ...io import assets
from ...io.options import option, setting
from ...io.ranges import MAP_SIDE, RUNS, SEED, STEPS, check_ranges
from ...rendering.renderer import Renderer
from ...shadow import ShadowSettings
from .scene import CONE_DEG, MOST_LIGHTS, alignment, check_scene, make_scene, target_and_starts

ReferenceKind = Literal["own", "mitsuba"]
StrategyKind = Literal["plain", "coarse"]

STEP_SIZE = 0.01
FILTERS = ("gaussian", "box", "wendland")
MOST_SAMPLES = 1 << 16
#: Step size and filter size of the first half of the iterations with the strategy ``coarse``.
COARSE_STEP_SIZE, COARSE_FILTER = 0.05, 15
# Iterations between two points of a record's curve.
_CURVE_STRIDE = 5


@dataclass(frozen=True, kw_only=True)
class LightSetting:
    """Settings that all problems of an experiment share.

    With the strategy ``coarse``, the first half of the iterations has larger steps and a larger filter. For ``seed`` and
    ``cone_deg`` see :func:`shadowmap_dr.experiments.lights.scene.target_and_starts`.
    """

    filter: str = option("gaussian", choices=FILTERS, help="Filter of the shadow maps.")
    map_resolution: int = option(256, allowed=MAP_SIDE, help="Texels along each side of a shadow map.")
    resolution: int = option(128, allowed=(4, 4096), help="Image width and height in pixels.")
    iterations: int = option(200, allowed=STEPS, help="Steps of the optimiser.")
    strategy: StrategyKind = option("plain", help="coarse: larger steps and a larger filter in the first half.")
    starts: int = option(1, allowed=(1, 1000), help="Starts of each run; the start with the least final loss counts.")
    reference: ReferenceKind = option("own", help="Renderer of the targets.")
    spp: int = option(
        512, allowed=(1, MOST_SAMPLES), help="Samples per pixel and light of path-traced targets, rounded up to a square."
    )
    cone_deg: float = option(
        CONE_DEG,
        names=("--cone",),
        allowed=(0.001, 178.0),
        help="Opening angle in degrees of the cone that directions are drawn from.",
    )
    seed: int = option(0, allowed=SEED, help="Seed of targets and starts.")


@dataclass(frozen=True)
class LightProblem(Problem, LightSetting):
    """All runs of one object with one setting.

    Attributes:
        object: name of a mesh of this package, or path of a mesh file, which is centred and scaled into [-1, 1]^3.
        lights: number n of lights of each run.
        runs: number of runs.
        filter_size: texels along each side of the shadow maps' filter, 1 for no filter, 0 for no shadows.
    """

    object: str
    lights: int = setting(help="Number n of lights of each run.", allowed=(1, MOST_LIGHTS))
    runs: int = setting(help="Number of runs.", allowed=RUNS)
    filter_size: int = setting(3, help="Texels of the filter, 1 for none, 0 for no shadows.", allowed=(0, 255))

    @property
    def name(self) -> str:
        return f"{re.sub(r'[^A-Za-z0-9_.-]', '_', Path(self.object).stem)}-{self.setting}"

    @property
    def setting(self) -> str:
        """Name of the setting in file names: differs from other settings of the same object."""
        shadow = f"k{self.filter_size}-{self.filter}-m{self.map_resolution}" if self.shadows else "no-shadows"
        reference = f"mitsuba{self.spp}" if self.reference == "mitsuba" else self.reference
        parts = [f"n{self.lights}", shadow, f"r{self.resolution}", f"i{self.iterations}", f"c{self.cone_deg:g}", reference]
        parts += ["coarse"] if self.strategy == "coarse" else []
        parts += [f"s{self.starts}"] if self.starts > 1 else []
        return "-".join([*parts, f"seed{self.seed}"])

    @property
    def shadows(self) -> bool:
        """True if the images have shadows."""
        return self.filter_size > 0

    @property
    def steps(self) -> int:
        return self.iterations

    def settings(self) -> dict[str, Any]:
        own = super().settings()
        unused = [] if self.shadows else ["filter", "map_resolution"]
        unused += ["spp"] if self.reference == "own" else []
        for name in unused:  # their values do not change the runs
            del own[name]
        if self.object in assets.mesh_names():
            return own
        content = assets.mesh(self.object).read_bytes()  # the file may change, under the same name
        return {**own, "object_digest": hashlib.sha256(content).hexdigest()[:12]}

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Stages of the optimisation: steps, filters and step sizes."""
        if self.strategy == "plain":
            return (Stage(self.iterations, None, STEP_SIZE),)
        first = self.iterations // 2
        larger = max(COARSE_FILTER, self.filter_size) if self.shadows else None
        return Stage(first, larger, COARSE_STEP_SIZE), Stage(self.iterations - first, None, STEP_SIZE)

    def batch_size(self, memory: int) -> int:
        size = self.map_resolution if self.shadows else 0
        return max(1, memory // (self.starts * batch_bytes(self.lights, self.resolution**2, 3, size)))

    def directions(self, runs: Sequence[int]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Targets (R, n, 3) and starts (R, starts, n, 3) of some runs."""
        pairs = [target_and_starts(self.seed, run, self.lights, self.starts, self.cone_deg) for run in runs]
        return np.stack([target for target, _ in pairs]), np.stack([starts for _, starts in pairs])

    def build(self) -> LightBatch:
        scene = make_scene(self.object, self.lights, self.resolution)
        return LightBatch(StillScene.of(Renderer.from_scene(scene, **self.renderer_settings())))

    def renderer_settings(self) -> dict[str, Any]:
        """Options of `Renderer.from_scene`."""
        if not self.shadows:
            return {"shadow_method": "none"}
        # One texel is no filter, until a stage makes it larger.
        return {
            "shadow_method": "vsm",
            "shadow_map_resolution": self.map_resolution,
            "shadow_filter": self.filter,
            "shadow_filter_size": self.filter_size,
        }

    def target_images(self, batch: LightBatch, targets: npt.NDArray[np.float64], runs: Sequence[int]) -> npt.NDArray[np.float32]:
        """(R, H, W, 3) linear images under the target lights."""
        if self.reference == "own":
            return batch.render(targets)
        scene = make_scene(self.object, self.lights, self.resolution)
        return np.stack([_path_traced(scene, target, self.spp, run) for target, run in zip(targets, runs, strict=True)])

    def run_batch(
        self, built: LightBatch, runs: Sequence[int], checkpoint: Path | None, on_step: Callable[[int], None]
    ) -> list[dict[str, Any]]:
        targets, starts = self.directions(runs)
        images = np.repeat(self.target_images(built, targets, runs), self.starts, 0)
        history = built.run(starts.reshape(-1, self.lights, 3), images, self.stages, on_step)
        # (steps, R, starts, ...)
        losses = history.losses.reshape(self.iterations, len(runs), self.starts)
        directions = history.directions.reshape(self.iterations + 1, len(runs), self.starts, self.lights, 3)
        records = []
        for k, run in enumerate(runs):
            best = int(np.argmin(losses[-1, k]))
            path = directions[:, k, best]
            shown = curve_iterations(self.iterations)
            records.append(
                {
                    "run": run,
                    "target": targets[k],
                    "start": starts[k, best],
                    "final": path[-1],
                    "alignment": alignment(targets[k], path[-1]),
                    "alignment_curve": [round(alignment(targets[k], path[i]), 6) for i in shown],
                    "loss": losses[-1, k, best],
                }
            )
        return records


def curve_iterations(iterations: int) -> list[int]:
    """Steps after which a run's curve has points: every fifth, and the last."""
    return [*range(0, iterations, _CURVE_STRIDE), iterations]


def check_problem(problem: LightProblem) -> None:
    """Raise ShadowmapError for impossible settings, before any work is done."""
    check_ranges(problem)
    check_scene(problem.object, problem.lights, problem.resolution)
    if problem.filter not in FILTERS:
        raise ShadowmapError(f"no filter {problem.filter!r}: choose {', '.join(FILTERS)}; 1 texel is no filter.")
    if problem.reference not in ("own", "mitsuba"):
        raise ShadowmapError(f"no reference {problem.reference!r}: choose own or mitsuba.")
    if problem.strategy not in ("plain", "coarse"):
        raise ShadowmapError(f"no strategy {problem.strategy!r}: choose plain or coarse.")
    for size in (problem.filter_size, *(stage.filter_size for stage in problem.stages)):
        try:
            ShadowSettings(filter=problem.filter, filter_size=max(1, size or 1), resolution=problem.map_resolution)
        except ValueError as error:
            raise ShadowmapError(str(error)) from None


def _path_traced(scene: mi.Scene, target: npt.NDArray[np.float64], spp: int, seed: int) -> npt.NDArray[np.float32]:
    """Path-traced image under lights in the directions ``target`` (n, 3)."""
    from mitsuba_baselines.reference import path_traced

    parameters = mi.traverse(scene)
    for k, direction in enumerate(target):
        up = [1, 0, 0] if abs(direction[0]) < math.sqrt(0.5) else [0, 0, 1]
        parameters[f"light_{k}.to_world"] = mi.Transform4f().look_at(
            origin=mi.Point3f(0), target=mi.Point3f(*(-float(c) for c in direction)), up=mi.Vector3f(*up)
        )
    parameters.update()
    return np.asarray(path_traced(scene, spp=spp, seed=seed, passes=1).image, np.float32)
