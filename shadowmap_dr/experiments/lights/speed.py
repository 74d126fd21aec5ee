"""Time of a step of light estimation for a run: in batches, alone, and with a renderer without batches."""

from __future__ import annotations

import dataclasses
import functools
import operator
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console

from ...inverse import LightBatch, StillScene, run_sweep
from ...inverse.light_directions.batch import batch_bytes
from ...inverse.light_directions.pixels import mixed_pixels
from ...io import console as io_console
from ...io.options import option
from ...io.ranges import check_ranges
from ...jit.arrays import device_array
from ...jit.frozen import freeze
from ...jit.types import Float, Vector3f
from ...jit.vectors import mean_of
from ...rendering.renderer import Renderer
from ...rendering.shadow_pass import make_maps, visibility_of
from ...scene.lights.punctual import DirectionalLight
from ..common import timing
from .problem import LightProblem
from .scene import OBJECTS, make_scene


@dataclasses.dataclass(frozen=True)
class TimesOptions:
    """Options of the measurement. ``lights`` are those of each run, ``batches`` the numbers of runs in a batch."""

    object: str = option("bunny", choices=OBJECTS, help="Object, by name or mesh file.")
    lights: int = option(1, help="Lights, 1 to 5.")
    batches: tuple[int, ...] = option((1, 16, 150), names=("--batch",), allowed=(1, 100_000), help="Runs of a batch; repeatable.")
    workers: bool = option(True, help="Also compare one Dask worker with two.")
    out: Path = option(Path("lights-times"), help="Folder for the results.")

    def __post_init__(self) -> None:
        check_ranges(self)


def measure_workers(problem: LightProblem, counts: Sequence[int], out: Path, *, console: Console | None = None) -> dict[str, Any]:
    """Seconds of a warm sweep for each number of Dask workers on this machine, with one Dr.Jit thread each.

    All sweeps do the same batches, several for each worker. A first sweep, which compiles, is not timed.
    """
    from distributed import LocalCluster

    seconds: dict[int, float] = {}
    memory = problem.runs * batch_bytes(problem.lights, problem.resolution**2, 3, problem.map_resolution)
    with io_console.progress(console or io_console.notes()) as progress:
        task = progress.add_task("sweeps", total=2 * len(counts), note="")
        for count in counts:
            progress.update(task, note=f"starting {count} worker{'s' * (count > 1)}")
            with LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster:
                for name in ("warm-up", "timed"):
                    progress.update(task, note=f"{count} worker{'s' * (count > 1)}, {name}")
                    began = time.perf_counter()
                    run_sweep(
                        [problem],
                        out / f"{name}-{count}",
                        scheduler=cluster.scheduler_address,
                        variant=mi.variant(),
                        threads=1,
                        memory=memory // (4 * max(counts)),
                        console=Console(quiet=True),
                    )
                    seconds[count] = time.perf_counter() - began
                    progress.advance(task)
    first = counts[0]
    return {
        "seconds": {str(count): value for count, value in seconds.items()},
        "speed_up": {str(count): seconds[first] / value for count, value in seconds.items()},
        "settings": problem.settings(),
        "runs": problem.runs,
    }


def measure(
    problem: LightProblem, batches: Sequence[int], seconds: float = 6.0, *, console: Console | None = None
) -> dict[str, Any]:
    """Seconds of a step for each run.

    Contenders take turns: batches of several sizes; ``reverse``, a single run whose frozen step differentiates ordinary shadow
    maps in reverse mode, but also reuses the G-buffer; ``renderer``, the frozen step of a user who calls ``render``. All do the
    same step; the last two leave out Adam, whose time is negligible.
    """
    with io_console.progress(console or io_console.notes()) as progress:
        task = progress.add_task("steps", total=1, note="scene, targets, recordings")
        renderer = Renderer.from_scene(
            make_scene(problem.object, problem.lights, problem.resolution), **problem.renderer_settings()
        )
        still = StillScene.of(renderer)
        batch = LightBatch(still)
        targets, starts = problem.directions(range(max(batches)))
        images = batch.render(targets)
        contenders: dict[str, Callable[[], object]] = {
            f"batch of {size}": batch.stepper(starts[:size, 0], images[:size]) for size in batches
        }
        contenders["reverse"] = _single(_reverse_image, (renderer, still), starts[0, 0], images[0])
        contenders["renderer"] = _single(_rendered_image, (renderer,), starts[0, 0], images[0])
        sizes = [*batches, 1, 1]
        samples = timing.alternate(
            {name: timing.Contender(call, rounds=40, burst=4, seconds=seconds) for name, call in contenders.items()},
            lambda done, total, name: progress.update(task, completed=done, total=total, note=name),
        )
    per_run = {name: [s / size for s in samples[name]] for name, size in zip(contenders, sizes, strict=True)}
    largest = f"batch of {max(batches)}"
    ratios = [(name, largest) for name in contenders if name != largest]
    return {**timing.compare(per_run, ratios), "settings": problem.settings(), "machine": timing.machine()}


def _single(image: Callable[..., Float], scene: tuple[Any, ...], start: np.ndarray, target: np.ndarray) -> Callable[[], object]:
    """Frozen step of one run without Adam. ``image(*scene, to_light)`` renders it."""
    wanted = device_array(mi.Float, target)
    vectors = [mi.Vector3f(*(float(c) for c in direction)) for direction in start]

    def step(scene: tuple[Any, ...], vectors: list[Vector3f], wanted: Float) -> tuple[Float, list[Vector3f]]:
        dr.enable_grad(vectors)
        pixels = image(*scene, vectors)
        difference = dr.detach(pixels) - wanted
        square, slope = dr.square(difference), difference * (2 / dr.width(difference))
        dr.eval(square, slope)
        dr.set_grad(pixels, slope)
        dr.enqueue(dr.ADMode.Backward, pixels)
        dr.traverse(dr.ADMode.Backward)
        return dr.mean(square), [dr.grad(vector) for vector in vectors]

    frozen = freeze(step)
    copies = [mi.Vector3f(*(v[c] + dr.opaque(mi.Float, 0) for c in range(3))) for v in vectors]
    dr.eval(copies)
    return lambda: frozen(scene, [mi.Vector3f(v) for v in copies], wanted)


def _lights(renderer: Renderer, to_light: list[Vector3f]) -> list[DirectionalLight]:
    old = cast(tuple[DirectionalLight, ...], renderer.data.lights)
    return [dataclasses.replace(light, direction=-dr.normalize(v)) for light, v in zip(old, to_light, strict=True)]


def _rendered_image(renderer: Renderer, to_light: list[Vector3f]) -> Float:
    return renderer.render(lights={light.name: light for light in _lights(renderer, to_light)}).array


def _reverse_image(renderer: Renderer, still: StillScene, to_light: list[Vector3f]) -> Float:
    """Image from the G-buffer in ``still``, with ordinary shadow maps."""
    pixels, lights = still.pixels, _lights(renderer, to_light)
    maps = None
    if still.shadow.method != "none":
        common = (renderer.data.geometry, renderer.topology, still.shadow)
        maps = make_maps(renderer.plan, lights, *common, renderer.frusta, still.seen)
        renderer.frusta = maps.frusta
    total = [mi.Float(0) for _ in range(pixels.channels)]
    for k, light in enumerate(lights):
        axis = dr.gather(mi.Vector3f, dr.ravel(-light.direction), dr.zeros(mi.UInt32, pixels.count))
        cosine = dr.dot(pixels.n_shading, axis)
        active = pixels.active & (cosine > 0) & (dr.dot(pixels.n_world, axis) > 0)
        shown = mi.Float(1)
        if maps is not None:
            found = [visibility_of(maps, renderer.plan, light, k, p, active) for p in pixels.points]
            shown = mean_of(functools.reduce(operator.add, found)) / len(found)
        for c in range(pixels.channels):
            total[c] = total[c] + dr.select(active, cosine * shown * still.irradiance[k][c], 0)
    colours = [value * colour for value, colour in zip(total, pixels.colours, strict=True)]
    return mixed_pixels(pixels, colours)
