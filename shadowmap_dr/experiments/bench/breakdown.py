"""Benchmark: time of a step by pass, and the share of tracing and Python."""

from __future__ import annotations

import copy
import functools
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from typing import Any, ParamSpec
from unittest import mock

import drjit as dr
import numpy as np

from ...inverse import PoseFit
from ...inverse.pose import _pose_step
from ...jit.gc import gc_quiet
from ...jit.types import AnyArray, ArrayT, Float, PyTree
from ..common.timing import Contender, alternate, summary, timed
from .common import BenchOptions, Unit, Update
from .scaling import Case

P = ParamSpec("P")

#: Passes of a step in order: label, and the pass's function (`module:name` below `shadowmap_dr`).
PASSES = (
    ("vertices", "scene.geometry:Geometry.with_positions"),
    ("facets: mean normals", "rendering.gbuffer.camera_view:mean_normals"),
    ("camera: projection", "rendering.gbuffer.camera_view:camera_clip"),
    ("camera: rasterization", "rendering.gbuffer.camera_view:visible_triangles"),
    ("shadow map: frustum", "rendering.shadow_pass:fit_frusta"),
    ("shadow map: rendering", "rendering.shadow_pass:render_maps"),
    ("shadow map: filter", "rendering.shadow_pass:filter_maps"),
    ("hits", "rendering.gbuffer.camera_view:pixel_hits"),
    ("normals", "rendering.gbuffer.camera_view:normals_at"),
    ("facets: blend", "rendering.gbuffer.camera_view:prefilter_normals"),
    ("surface", "rendering.gbuffer.camera_view:surface_at"),
    ("shadow look-up", "rendering.light_pass:LightPass.visibilities"),
    ("shading", "rendering.light_pass:LightPass.radiance"),
    ("anti-aliasing", "rendering.image_pass:antialias"),
)
REST = "loss, Adam, the rest"


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each resolution, with and without shadows."""
    return [
        Unit(f"{name}-{resolution}", functools.partial(measure, options, method, resolution))
        for resolution in options.what.resolutions
        for name, method in (("shadows", "vsm"), ("rasterizer", "none"))
    ]


def measure(options: BenchOptions, method: str, resolution: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Time of the kernels of each pass, and the share of a step in which no kernel runs.

    To measure the passes, everything is evaluated at the end of each pass, in both directions. This prevents fusion across
    passes, so that the sum over the passes is somewhat more than the kernels of a whole step.
    """
    rounds = options.what.rounds
    update(0, 1, "set-up")
    fit = Case(resolution=resolution, method=method).fit(options.work)
    calls: dict[str, Callable[[], object]] = {"frozen": fit.step, "not frozen": functools.partial(unfrozen_step, fit)}
    samples = alternate({name: Contender(call, rounds) for name, call in calls.items()}, update)
    result: dict[str, Any] = {"resolution": resolution, "method": method}
    for name, call in calls.items():
        walls, kernels = _kernels(call, rounds)
        busy = np.array([sum(entries) for entries in kernels])
        result[name] = {
            "seconds": summary(samples[name]),
            "seconds_in_kernels": float(np.median(busy)),
            "kernels": len(kernels[0]),
            # Tracing, Python and kernel launches. Both times are of the same calls, since timing the kernels takes time, too.
            "share_outside_kernels": float(np.median(np.maximum(0, 1 - busy / np.array(walls)))),
        }
    result["passes"] = _passes(fit, rounds, update)
    return result


def unfrozen_step(fit: PoseFit) -> Float:
    """A step of a fit without `dr.freeze`. Returns the loss, Float (1,)."""
    return _pose_step(
        fit._renderer, fit._optimizer, fit._p_rest, fit._reference, shape=fit._shape, shift_z=fit._shift_z, spp=fit._spp
    )


@contextmanager
def _history() -> Iterator[None]:
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield
        dr.kernel_history_clear()


def _kernels(call: Callable[[], object], rounds: int) -> tuple[list[float], list[list[float]]]:
    """Seconds of each call, and of each of its kernels."""
    walls, kernels = [], []
    with gc_quiet(), _history():
        for _ in range(min(rounds, 20) + 1):
            walls.append(timed(call))
            kernels.append([entry["execution_time"] / 1e3 for entry in dr.kernel_history()])
    return walls[1:], kernels[1:]


class Recorder:
    """Record of kernel times by pass: `drain` books the kernels launched since its last call to the current pass."""

    def __init__(self) -> None:
        self.forward: dict[str, list[float]] = {}
        self.backward: dict[str, list[float]] = {}
        self.stack = [REST]
        self.behind = REST
        self.going_back = False

    def drain(self) -> None:
        dr.sync_thread()
        book = self.backward if self.going_back else self.forward
        name = self.behind if self.going_back else self.stack[-1]
        book.setdefault(name, []).extend(entry["execution_time"] / 1e3 for entry in dr.kernel_history())

    def reached(self, name: str) -> None:
        """The backward pass has reached the output of a pass."""
        self.drain()
        self.going_back, self.behind = True, name

    def wrap(self, name: str, function: Callable[P, ArrayT]) -> Callable[P, ArrayT]:
        """The function of a pass, with its arguments and its result evaluated, so that its kernels are those of the pass."""

        @functools.wraps(function)
        def wrapped(*args: P.args, **kwargs: P.kwargs) -> ArrayT:
            dr.eval(args, kwargs)
            self.drain()
            self.stack.append(name)
            result = function(*args, **kwargs)
            dr.eval(result)
            self.drain()
            self.stack.pop()
            return _marked(result, self, name)

        return wrapped


class _Mark(dr.CustomOp):
    """Identity. Its backward pass evaluates the gradients and tells the recorder the pass that begins."""

    def eval(self, value: list[AnyArray], recorder: Recorder, label: str) -> list[AnyArray]:
        self.recorder, self.label = recorder, label
        return value

    def backward(self) -> None:
        gradient = self.grad_out()
        dr.eval(gradient)
        self.recorder.reached(self.label)
        self.set_grad_in("value", gradient)


def _marked(value: ArrayT, recorder: Recorder, label: str) -> ArrayT:
    """A copy of a tree of arrays with all attached arrays passed through one `_Mark`."""
    leaves: list[AnyArray] = []

    def collected(leaf: AnyArray) -> AnyArray:
        leaves.append(leaf)
        return leaf

    _mapped(value, collected)
    if not leaves:
        return value
    marked = iter(dr.custom(_Mark, leaves, recorder, label))
    return _mapped(value, lambda leaf: next(marked))


def _mapped(value: PyTree, function: Callable[[AnyArray], AnyArray]) -> PyTree:
    """A copy of a tree (sequences, records, Mitsuba's structures) with the attached arrays replaced by the function's results."""
    if dr.is_array_v(value):
        return function(value) if dr.is_float_v(value) and dr.grad_enabled(value) else value
    if isinstance(value, (tuple, list)):
        return type(value)(_mapped(entry, function) for entry in value)
    if is_dataclass(value) and not isinstance(value, type):
        result, names = copy.copy(value), [f.name for f in fields(value)]
    elif hasattr(value, "DRJIT_STRUCT"):
        result, names = type(value)(value), list(value.DRJIT_STRUCT)
    else:
        return value
    for name in names:
        old = getattr(value, name)
        new = _mapped(old, function)
        if new is not old:
            object.__setattr__(result, name, new)  # records are frozen
    return result


def _passes(fit: PoseFit, rounds: int, update: Update) -> list[dict[str, Any]]:
    """Median seconds of the kernels of each pass in both directions."""
    count = max(3, rounds // 4)
    records: list[Recorder] = []
    with gc_quiet(), ExitStack() as stack:
        for name, place in PASSES:
            owner, attribute = find(place)
            original = owner.__dict__[attribute]
            stack.enter_context(mock.patch.object(owner, attribute, _switch(records, name, original)))
        with _history():
            for k in range(count + 2):
                update(k, count + 2, "passes")
                records.append(Recorder())
                unfrozen_step(fit)
                records[-1].drain()
    kept = records[2:]  # the first two compile
    result = []
    for name in (*(label for label, _ in PASSES), REST):
        forward = [record.forward.get(name, []) for record in kept]
        backward = [record.backward.get(name, []) for record in kept]
        result.append(
            {
                "pass": name,
                "forward_seconds": float(np.median([sum(entries) for entries in forward])),
                "backward_seconds": float(np.median([sum(entries) for entries in backward])),
                "kernels": len(forward[0]) + len(backward[0]),
            }
        )
    return [entry for entry in result if entry["kernels"]]


def _switch(records: list[Recorder], name: str, function: Callable[P, ArrayT]) -> Callable[P, ArrayT]:
    def call(*args: P.args, **kwargs: P.kwargs) -> ArrayT:
        return records[-1].wrap(name, function)(*args, **kwargs)

    return call


def find(place: str) -> tuple[object, str]:
    """Owner (module or class) and name of a function `module:name` or `module:class.name`."""
    module, _, path = place.partition(":")
    owner: object = importlib.import_module(f"shadowmap_dr.{module}")
    *classes, attribute = path.split(".")
    for name in classes:
        owner = getattr(owner, name)
    return owner, attribute
