"""Benchmark: growth of a step's time and memory with the sizes of its inputs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...inverse import PoseFit
from ...jit.frozen import freeze
from ...jit.types import AnyArray, Float
from ...rendering.renderer import Renderer
from ..common import meshes as bench_meshes
from ..common.timing import Contender, alternate, compare, exponent, forget_peak_memory, peak_memory, summary
from .common import BenchOptions, Unit, Update, run_child
from .raster import _forward_backward, offsets, raster_scene

# A child that takes longer than this hangs.
CHILD_SECONDS = 900.0


@dataclass(frozen=True)
class Case:
    """An optimisation step: its scene and its settings. `mesh` as in `common.meshes.make`; `views` cameras side by side."""

    mesh: str = "spot-6k"
    resolution: int = 256
    map_resolution: int = 256
    filter_size: int = 3
    lights: int = 1
    method: str = "vsm"
    views: int = 1

    def fit(self, work: Path) -> PoseFit:
        """The fit that takes these steps. ``work``: folder of meshes."""
        path = bench_meshes.stored(self.mesh, work)
        scene = bench_meshes.scene(path, self.resolution, self.lights, self.views)
        renderer = Renderer.from_scene(
            scene, shadow_method=self.method, shadow_map_resolution=self.map_resolution, shadow_filter_size=self.filter_size
        )
        p_rest = np.array(renderer.data.geometry.shape_positions("object")).T
        reference = np.zeros((self.resolution, self.resolution * self.views, 3), np.float32)
        # Hardly any movement, so that all steps of a case cost the same.
        return PoseFit(renderer, "object", p_rest, reference, step_size=1e-4)


#: Series -> the field of `Case` that changes, and the other settings: steps of which this quantity makes up much.
BASES = {
    "triangles": ("mesh", Case(resolution=512)),
    "resolution": ("resolution", Case()),
    "map_resolution": ("map_resolution", Case(resolution=128)),
    "filter_size": ("filter_size", Case(resolution=128, map_resolution=512)),
    "lights": ("lights", Case(resolution=128)),
}


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each series, one for the largest step, one for batches."""
    result = [Unit(name, functools.partial(measure_series, options, name)) for name in options.what.series]
    if options.what.large is not None:
        result.append(Unit("large", functools.partial(measure_large, options)))
    if options.what.batch:
        result.append(Unit("batch", functools.partial(measure_batch, options)))
    return result


def measure_series(options: BenchOptions, name: str, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Measure each case in a process of its own, for its peak memory, in alternating order, against drifts of the load."""
    field, base = BASES[name]
    cases = [replace(base, **{field: value}) for value in options.what.series[name]]
    there = list(range(len(cases)))
    order = [k for turn in range(options.what.passes) for k in (there if turn % 2 == 0 else there[::-1])]
    found: list[list[dict[str, Any]]] = [[] for _ in cases]
    for number, k in enumerate(order):
        update(number, len(order), f"{getattr(cases[k], field)}")
        found[k].append(_in_child(options, cases[k]))
    points = [_point(case, results, _size(case, name, results)) for case, results in zip(cases, found, strict=True)]
    good = [point for point in points if "seconds" in point]
    sizes, medians = [point["size"] for point in good], [point["seconds"]["median"] for point in good]
    result: dict[str, Any] = {"quantity": name, "points": points, "exponent": exponent(sizes, medians)}
    # The fixed cost of a step flattens the curve at small sizes; the last two sizes show the trend.
    result["exponent_of_the_last_two"] = exponent(sizes[-2:], medians[-2:])
    if name == "lights":
        result["in turns"] = _in_turns(options, cases, update)
        # The cost of a light hardly depends on the image's size; the rest of a step does.
        result["in turns, larger images"] = {
            str(resolution): _in_turns(options, [replace(case, resolution=resolution) for case in cases], update)
            for resolution in options.what.light_resolutions
        }
    return result


def _in_turns(options: BenchOptions, cases: list[Case], update: Update) -> dict[str, Any]:
    """Times of the steps of all cases, which differ in the number of lights, in turns."""
    update(0, 1, f"all numbers of lights in turns at {cases[0].resolution}")
    fits = {str(case.lights): case.fit(options.work) for case in cases}
    samples = alternate({key: Contender(fit.step, options.what.rounds) for key, fit in fits.items()}, update)
    return compare(samples, [(key, "1") for key in fits if key != "1"])


def measure_large(options: BenchOptions, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Time and memory of the largest step."""
    assert options.what.large is not None
    mesh, resolution = options.what.large
    case = Case(mesh=mesh, resolution=resolution)
    update(0, 1, mesh)
    found = [_in_child(options, case)]
    return _point(case, found, _size(case, "triangles", found))


def _in_child(options: BenchOptions, case: Case) -> dict[str, Any]:
    bench_meshes.stored(case.mesh, options.work)
    arguments = {"case": asdict(case), "work": str(options.work), "rounds": max(5, options.what.rounds // 2)}
    return run_child("bench.scaling:measure_case", arguments, CHILD_SECONDS)


def measure_case(case: Mapping[str, Any], work: str, rounds: int, emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Seconds of the steps of a case, and peak memory (bytes) of this process: overall, at its start, and in the steps."""
    imported = peak_memory()
    fit = Case(**case).fit(Path(work))
    set_up = peak_memory()
    forget_peak_memory()
    samples = alternate({"step": Contender(fit.step, rounds, seconds=60.0)})["step"]
    steps = peak_memory()
    faces = fit._initial_renderer.data.geometry.faces
    return {
        "seconds": samples,
        "triangles": dr.width(faces) // 3,
        "recordings": fit.recordings(),
        "peak_memory": max(set_up, steps),
        "peak_memory_imports": imported,
        "peak_memory_steps": steps,
    }


def _size(case: Case, quantity: str, results: list[dict[str, Any]]) -> int | None:
    """Size against which the cost is plotted: a number of triangles, pixels, texels, taps or lights."""
    if quantity == "triangles":
        return next((result["triangles"] for result in results if "triangles" in result), None)
    value = getattr(case, quantity)
    return value**2 if quantity in ("resolution", "map_resolution") else value


def _point(case: Case, results: list[dict[str, Any]], size: int | None) -> dict[str, Any]:
    point: dict[str, Any] = {"case": asdict(case), "size": size}
    failed = [result["failed"] for result in results if "failed" in result]
    complete = [result for result in results if "failed" not in result]
    if failed:
        point["failed"] = failed
    if complete:
        point["seconds"] = summary([second for result in complete for second in result["seconds"]])
        for name in ("peak_memory", "peak_memory_imports", "peak_memory_steps", "recordings"):
            point[name] = max(result[name] for result in complete)
    return point


def measure_batch(options: BenchOptions, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Images per second of batches, and of as many frozen single steps, each of which waits for the device.

    Two kinds: the raster functions with a batch of poses (forward and backward), and a `Renderer` whose sensor is a batch
    of cameras (one set of vertices, one shadow pass).
    """
    what = options.what
    size = what.batch_resolution
    result: dict[str, Any] = {"resolution": size, "batches": list(what.batch)}
    update(0, 1, "meshes")
    data = raster_scene(options, "spot-6k", size)
    topology = data.topology()
    dr.make_opaque(topology)
    calls: dict[str, Contender] = {}
    for count in what.batch:
        step = freeze(_forward_backward)
        target = dr.zeros(mi.Float, 3 * count * size * size)
        dr.make_opaque(target)
        common = (data.p_rest, data.moving, data.matrix, data.faces)
        calls[str(count)] = Contender(_raster_call(step, common, offsets(count), (topology, target), size), what.rounds)
    result["raster"] = _throughput(alternate(calls, update), what.batch)
    update(0, 1, "cameras")
    fits = {str(count): Case(resolution=size, views=count).fit(options.work) for count in what.batch}
    samples = alternate({key: Contender(fit.step, what.rounds) for key, fit in fits.items()}, update)
    result["sensors"] = _throughput(samples, what.batch)
    return result


def _raster_call(
    step: Callable[..., object], common: tuple[AnyArray, ...], moves: Iterator[Float], more: tuple[object, ...], size: int
) -> Callable[[], object]:
    def call() -> object:
        result = step(*common, next(moves), *more, size=size)
        dr.eval(result)
        return result

    return call


def _throughput(samples: Mapping[str, list[float]], batches: tuple[int, ...]) -> dict[str, Any]:
    times = compare(samples)["seconds"]
    images = {str(count): count / times[str(count)]["median"] for count in batches}
    gain = {key: value / images["1"] for key, value in images.items()} if "1" in images else {}
    return {"seconds": times, "images_per_second": images, "throughput_over_single_steps": gain}
