"""Breaks the renderer on purpose, one way at a time, and checks that a named test notices: ``python tests/support/mutations.py``.

Each mutation replaces one function of the package while the tests run, in a process of their own. A mutation counts as noticed
only if its named tests fail by an assertion, its code was reached, and the same tests pass without it.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

SUPPORT = Path(__file__).resolve().parent
TESTS = SUPPORT.parent
TRACED = "integrator/test_gradients.py::test_derivative_image_agrees_with_path_tracing[llvm_ad_rgb-{}]"
DIFFERENCES = "integrator/test_gradients.py::test_derivative_image_agrees_with_differences[llvm_ad_rgb-{}]"


@dataclass(frozen=True)
class Mutation:
    """A way to break the package, and the tests that must notice.

    ``breaks`` makes the broken function from the good one, which is ``function`` of module ``shadowmap_dr.module``. It takes its
    place in all modules, or with ``only_there`` in this one.
    """

    name: str
    module: str
    function: str
    breaks: Callable[[Callable[..., Any]], Callable[..., Any]]
    tests: tuple[str, ...]
    only_there: bool = False


def _halved_gradient(function: Callable[..., Any]) -> Callable[..., Any]:
    def half(*arguments: Any, **options: Any) -> Any:
        import drjit as dr

        value = function(*arguments, **options)
        return 0.5 * value + 0.5 * dr.detach(value)

    return half


def _flipped_direction(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda direction: function(-direction)


def _flipped_shading(function: Callable[..., Any]) -> Callable[..., Any]:
    def flipped(light: Any, *arguments: Any) -> Any:
        return function(replace(light, direction=-light.direction), *arguments)

    return flipped


def _no_antialiasing(function: Callable[..., Any]) -> Callable[..., Any]:
    def unblended(values: Any, *_: Any, **__: Any) -> Any:
        from shadowmap_dr.jit.packets import packed

        return packed(values) if isinstance(values, list) else values

    return unblended


def _detached_rotation(function: Callable[..., Any]) -> Callable[..., Any]:
    def detached(*arguments: Any) -> Any:
        import drjit as dr

        view = function(*arguments)
        return replace(view, right=dr.detach(view.right), up=dr.detach(view.up), forward=dr.detach(view.forward))

    return detached


def _detached_position(function: Callable[..., Any]) -> Callable[..., Any]:
    def detached(position: Any, *arguments: Any) -> Any:
        import drjit as dr

        return function(dr.detach(position), *arguments)

    return detached


def _nowhere(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments: 0.0 * function(*arguments)


def _both_nowhere(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments: tuple(0.0 * found for found in function(*arguments))


def _never(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments: function(*arguments) & False


def _halves(function: Callable[..., Any]) -> Callable[..., Any]:
    def broken(*arguments: Any) -> Any:
        a, b, c, d, first, second = function(*arguments)
        return a, b, c, d, 0.5 * (first + second), 0.5 * (first + second)

    return broken


def _only_the_first_triangle(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments: function(*arguments)[:3]


def _detached_cone(function: Callable[..., Any]) -> Callable[..., Any]:
    def detached(light: Any, *arguments: Any) -> Any:
        import drjit as dr

        return function(replace(light, cutoff_angle=dr.detach(light.cutoff_angle)), *arguments)

    return detached


def _detached_rays(function: Callable[..., Any]) -> Callable[..., Any]:
    def detached(*arguments: Any) -> Any:
        import drjit as dr

        return dr.detach(function(*arguments))

    return detached


def _always_lit(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments, **options: 0.0 * function(*arguments, **options) + 1.0


def _half_a_texel_off(function: Callable[..., Any]) -> Callable[..., Any]:
    def shifted(maps: Any, map_index: Any, u: Any, v: Any, *arguments: Any, **options: Any) -> Any:
        step = 1.0 / maps.settings.resolution
        return function(maps, map_index, u + step, v + step, *arguments, **options)

    return shifted


def _edges_to_nobody(function: Callable[..., Any]) -> Callable[..., Any]:
    def covers(values: Any, *_: Any) -> Any:
        return (values.x > 0) & (values.y > 0) & (values.z > 0) & (values.w >= -1) & (values.w <= 1)

    return covers


def _unwelded(function: Callable[..., Any]) -> Callable[..., Any]:
    def apart(positions: Any, shapes: Any) -> Any:
        import numpy as np

        every = np.arange(len(positions))
        return replace(function(positions, shapes), place=every, own=every)

    return apart


def _sum_is_not_one(function: Callable[..., Any]) -> Callable[..., Any]:
    def unnormalised(*arguments: Any, **options: Any) -> Any:
        kernel = function(*arguments, **options)
        return kernel / kernel.max()

    return unnormalised


def _always(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *arguments: function(*arguments) | True


def _normals_moved_as_points(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda buffers, to_world: function(buffers, SimpleNamespace(matrix=to_world.matrix, inverse_transpose=to_world.matrix))


def _first_of_them(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda array: function(array)[:1]


def _power_without_area(function: Callable[..., Any]) -> Callable[..., Any]:
    def bare(*arguments: Any) -> Any:
        samples = function(*arguments)
        return replace(samples, power=samples.power / samples.area)

    return bare


def _one_sample_further(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda values, weights, axis: function(values, weights, replace(axis, first=axis.first + 1))


def _camera_stays(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda known, scene, camera, names: function(known, scene, known.camera, names)


MUTATIONS = (
    Mutation("halve the shadow gradient", "shadow.methods.variance", "chebyshev_visibility", _halved_gradient,
             (TRACED.format("sun_box_light_direction"),)),
    Mutation("flip the light of the maps", "shadow.light_camera", "directional_view", _flipped_direction,
             ("rendering/test_references.py::test_shadows_of_1024_texels[llvm_ad_rgb-pose]",)),
    Mutation("flip the light of the shading", "scene.lights.punctual", "DirectionalLight.illuminate", _flipped_shading,
             ("scene/test_lights.py::test_equals_sample_direction[llvm_ad_rgb-rgb-sun]",)),
    Mutation("switch moment anti-aliasing off", "shadow.shadow_map", "antialias", _no_antialiasing,
             (TRACED.format("sun_box_light_direction"),), only_there=True),
    Mutation("detach the light's rotation", "shadow.light_camera", "directional_view", _detached_rotation,
             (TRACED.format("sun_box_light_direction"),)),
    Mutation("detach the spot light's position", "shadow.light_camera", "spot_view", _detached_position,
             (TRACED.format("spot_box_spot_position"),)),
    Mutation("leave the shadows out", "shadow.methods.variance", "chebyshev_visibility", _always_lit,
             ("shadow/test_shadow_methods.py::test_one_surface_shadows_what_lies_behind_it[llvm_ad_rgb-vsm]",)),
    Mutation("look half a texel off", "shadow.lookup", "bilinear", _half_a_texel_off,
             ("shadow/test_shadow_maps.py::test_compat_follows_the_authors_formulas[llvm_ad_rgb-spot]",)),
    Mutation("do not see where surfaces meet", "raster.antialiasing.surface_intersections", "Meetings.weights", _both_nowhere,
             (DIFFERENCES.format("crossing_boxes-camera_shift"), DIFFERENCES.format("fine_box-caster_rise"))),
    Mutation("do not see where a surface cuts itself", "raster.antialiasing.edge_crossings", "_cut", _never,
             ("raster/test_bends.py::test_a_curved_sheet_that_cuts_itself[llvm_ad_rgb-True]",)),
    Mutation("take edges beside a ridge for it", "raster.antialiasing.creases", "find_creases", _halves,
             ("raster/test_raster_creases.py::test_tessellation_of_a_crease_does_not_change_it[llvm_ad_rgb-ridge]",)),
    Mutation("take triangles of one plane for creases", "raster.antialiasing.creases", "CoplanarCreases.flat", _never,
             ("raster/test_shading_edges.py::test_slopes_of_colours_within_flat_faces_count_once[llvm_ad_rgb-0.0-1]",)),
    Mutation("take curved surfaces for flat ones", "raster.antialiasing.surface_intersections", "Meetings._bent", _nowhere,
             ("raster/test_raster_creases.py::test_planes_of_a_curved_surface_are_not_extended[llvm_ad_rgb-2-30]",)),
    Mutation("move one of two surfaces that meet", "raster.antialiasing.surface_intersections", "Meetings.slopes",
             _only_the_first_triangle,
             ("raster/test_raster_creases.py::test_surfaces_that_meet_without_an_edge[llvm_ad_rgb]",)),
    Mutation("detach the spot light's cone", "scene.lights.soft_outline", "share_inside", _detached_cone,
             (DIFFERENCES.format("spot_cow-spot_cone"),)),
    Mutation("detach an orthographic camera's rays", "scene.sensor", "Sensor.pixel_rays", _detached_rays,
             (DIFFERENCES.format("orthographic_cow-camera_turn"),)),
    Mutation("leave points on edges to nobody", "raster.triangle_setup", "covers", _edges_to_nobody,
             ("raster/test_raster_rasterize.py::test_shared_edges_leave_no_hole_and_no_double_owner[llvm_ad_rgb]",)),
    Mutation("weld no vertices", "raster.welding", "weld", _unwelded,
             ("raster/test_raster_antialias.py::test_seams_are_welded[llvm_ad_rgb]",)),
    Mutation("do not normalise a filter", "shadow.filters", "filter_kernel", _sum_is_not_one,
             ("shadow/test_shadow_filters.py::test_formulas",)),
    Mutation("keep frusta for ever", "shadow.frustum_fit", "_still_fits", _always,
             ("shadow/test_shadow_maps.py::test_a_small_move_leaves_the_frustum_alone_and_a_large_one_refits[llvm_ad_rgb-spot]",)),
    Mutation("transform normals as if they were points", "scene.shapes.sources", "_placed", _normals_moved_as_points,
             ("scene/test_scene.py::test_normals_of_stretched_shapes_are_perpendicular[llvm_ad_rgb-few]",)),
    Mutation("notice changes of first components only", "scene.changes", "leaves", _first_of_them,
             ("integrator/test_changed_scenes.py::test_fingerprints_are_those_of_one_array[llvm_ad_rgb]",)),
    Mutation("let light through a triangle's back", "rendering.direct_light", "passes_gate", _always,
             ("rendering/test_shading.py::test_gate_closes_where_a_shadow_ray_would[llvm_ad_rgb]",)),
    Mutation("forget the area of a lamp's parts", "rendering.extended_lights.area_samples", "area_samples", _power_without_area,
             ("rendering/test_soft_samples.py::test_power_adds_up_to_radiance_times_area[llvm_ad_rgb-rectangle-9]",)),
    Mutation("give gradients of pixels to the next sample", "rendering.film.reconstruction", "_to_samples", _one_sample_further,
             ("rendering/test_reconstruction.py::test_reconstruct_in_all_modes[llvm_ad_rgb-3-gaussian-1-False]",)),
    Mutation("do not notice that a camera moves", "integrator.pass_caches", "_valid_level", _camera_stays,
             ("integrator/test_pass_caches.py::test_nothing_that_is_kept_shows[llvm_ad_rgb-unlit]",)),
)  # fmt: skip


@dataclass(frozen=True)
class Verdict:
    """Verdict of the named tests: ``noticed`` if all failed by an assertion, ``detail`` otherwise says what happened."""

    name: str
    tests: tuple[str, ...]
    noticed: bool
    detail: str


def check_all(
    mutations: tuple[Mutation, ...] = MUTATIONS, report: Callable[[Verdict], None] = lambda verdict: None
) -> list[Verdict]:
    """Run the named tests without any mutation (they must pass), then each mutation's with it (they must fail)."""
    healthy = tuple(dict.fromkeys(test for mutation in mutations for test in mutation.tests))
    plan = [("", healthy), *((mutation.name, mutation.tests) for mutation in mutations)]
    verdicts = []
    for (_, tests), mutation, (reached, outcomes) in zip(plan, (None, *mutations), _runs(plan), strict=True):
        seen = [outcomes.get(test, "did not run") for test in tests]
        if mutation is None:
            broken = [test for test, outcome in zip(tests, seen, strict=True) if outcome != "passed"]
            verdict = Verdict("none", tests, not broken, "all pass" if not broken else f"do not pass: {', '.join(broken)}")
        else:
            noticed = reached > 0 and all(outcome.startswith("AssertionError") for outcome in seen)
            detail = "; ".join(seen) + ("" if reached else "; the broken function was never called")
            verdict = Verdict(mutation.name, tests, noticed, detail)
        verdicts.append(verdict)
        report(verdict)
    return verdicts


def _runs(plan: list[tuple[str, tuple[str, ...]]]) -> Iterator[tuple[int, dict[str, str]]]:
    """For each mutation (its name, or none) and tests: (calls of the broken function, outcome by test).

    An outcome is ``passed``, ``skipped`` or the exception in one line. All run in one process, which loads its libraries once.
    """
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    environment["PYTHONPATH"] = os.pathsep.join([str(SUPPORT), str(TESTS.parent), environment.get("PYTHONPATH", "")])
    with tempfile.TemporaryFile("w+") as errors, subprocess.Popen(
        [sys.executable, __file__, "--worker"],
        env=environment, cwd=TESTS.parent, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True,
    ) as worker:  # fmt: skip
        worker.stdin.write(json.dumps(plan))
        worker.stdin.close()
        for name, _ in plan:
            line = next((line for line in worker.stdout if line.startswith(_MARK)), None)
            if line is None:
                errors.seek(0)
                raise RuntimeError(f"pytest did not run with '{name or 'none'}':\n{errors.read()[-2000:]}")
            yield tuple(json.loads(line.removeprefix(_MARK)))


# In the process that runs the tests. Its output has other lines, too.

_MARK = "@mutation "


class _Recorder:
    """A plug-in of pytest: what became of the tests, and how often a broken function was called."""

    def __init__(self) -> None:
        self.calls = 0
        self.outcomes: dict[str, str] = {}

    def apply(self, mutation: Mutation) -> Callable[[], None]:
        """Break the package. Returns what mends it."""
        import shadowmap_dr.integrator.plugin  # noqa: F401  (everything a rendering calls is loaded now)

        owner: Any = sys.modules[f"shadowmap_dr.{mutation.module}"]
        *classes, attribute = mutation.function.split(".")
        for name in classes:
            owner = getattr(owner, name)
        good = getattr(owner, attribute)
        bad = mutation.breaks(good)

        def counted(*arguments: Any, **options: Any) -> Any:
            self.calls += 1
            return bad(*arguments, **options)

        places = [(owner, attribute)]
        if not mutation.only_there:
            # Functions are imported by name: replace them wherever they are known.
            for module in [m for key, m in sys.modules.items() if key.startswith("shadowmap_dr") and isinstance(m, ModuleType)]:
                places += [(module, key) for key, value in vars(module).items() if value is good]
        for place, key in places:
            setattr(place, key, counted)

        def mend() -> None:
            for place, key in places:
                setattr(place, key, good)

        return mend

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo) -> Any:
        outcome = (yield).get_result()
        name = item.nodeid.removeprefix("tests/")
        if call.excinfo is not None:
            reason = " ".join(str(call.excinfo.value).split("\n")[:1])
            self.outcomes[name] = "skipped" if outcome.skipped else f"{call.excinfo.type.__name__}: {reason}"
        elif call.when == "call":
            self.outcomes[name] = outcome.outcome


def _work() -> None:
    """Run all tests of a plan (standard input) and print a line for each mutation."""
    known = {mutation.name: mutation for mutation in MUTATIONS}
    for name, tests in json.load(sys.stdin):
        recorder = _Recorder()
        mend = recorder.apply(known[name]) if name else lambda: None
        options = ["-q", "-p", "no:cacheprovider", f"--rootdir={TESTS.parent}"]
        pytest.main([*options, *(str(TESTS / test) for test in tests)], plugins=[recorder])
        mend()
        _forget_tests()
        print(f"\n{_MARK}{json.dumps([recorder.calls, recorder.outcomes])}", flush=True)


def _forget_tests() -> None:
    """Import test modules anew: they keep images that they have rendered."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file and Path(file).is_relative_to(TESTS) and name not in ("__main__", "quick_kernels"):
            del sys.modules[name]
    gc.collect()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    if parser.parse_args().worker:
        _work()
        return

    def report(verdict: Verdict) -> None:
        mark = "ok    " if verdict.noticed else "MISSED"
        print(f"{mark} {verdict.name:43} {verdict.detail}", flush=True)
        for test in verdict.tests:
            print(f"{'':6} {'':43} {test}", flush=True)

    verdicts = check_all(report=report)
    sys.exit(0 if all(verdict.noticed for verdict in verdicts) else 1)


if __name__ == "__main__":
    main()
