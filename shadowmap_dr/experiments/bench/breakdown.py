"""Benchmark: where the time of a step goes, by pass, and how much of it is tracing and Python."""

from __future__ import annotations

import copy
import functools
import importlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass
from typing import Any
from unittest import mock

import drjit as dr
import numpy as np

from ...inverse import PoseFit
from ...inverse.pose import _pose_step
from ...jit.gc import gc_quiet
from ..common.timing import Contender, alternate, summary, timed
from .common import BenchOptions, Unit, Update
from .scaling import Case

#: The passes of a step in their order: label, and the function (module:name below `shadowmap_dr`) that makes them up.
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
    """Time of the kernels of each pass, and the part of a step in which no kernel runs.

    For the passes, a step is run piece by piece: everything is evaluated at the end of each pass, in both directions. This
    hinders fusion across passes, so that the sum over the passes is somewhat more than the kernels of a whole step.
    """
    rounds = options.what.rounds
    update(0, 1, "set-up")
    fit = Case(resolution=resolution, method=method).fit(options.work)
    calls = {"frozen": fit.step, "not frozen": functools.partial(unfrozen_step, fit)}
    samples = alternate({name: Contender(call, rounds) for name, call in calls.items()}, update)
    result: dict[str, Any] = {"resolution": resolution, "method": method}
    for name, call in calls.items():
        walls, kernels = _kernels(call, rounds)
        busy = np.array([sum(entries) for entries in kernels])
        result[name] = {
            "seconds": summary(samples[name]),
            "seconds_in_kernels": float(np.median(busy)),
            "kernels": len(kernels[0]),
            # Tracing, Python, and the launch of the kernels. Of the same calls, since the clock of kernels costs time, too.
            "share_outside_kernels": float(np.median(np.maximum(0, 1 - busy / np.array(walls)))),
        }
    result["passes"] = _passes(fit, rounds, update)
    return result


def unfrozen_step(fit: PoseFit) -> Any:
    """A step of a fit, traced anew."""
    constants = {"shape": fit._shape, "shift_z": fit._shift_z, "spp": fit._spp}
    return _pose_step(fit._renderer, fit._optimizer, fit._p_rest, fit._reference, **constants)


@contextmanager
def _history() -> Iterator[None]:
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        yield
        dr.kernel_history_clear()


def _kernels(call: Callable[[], Any], rounds: int) -> tuple[list[float], list[list[float]]]:
    """Seconds of some calls, and of each kernel of theirs."""
    walls, kernels = [], []
    with gc_quiet(), _history():
        for _ in range(min(rounds, 20) + 1):
            walls.append(timed(call))
            kernels.append([entry["execution_time"] / 1e3 for entry in dr.kernel_history()])
    return walls[1:], kernels[1:]


class Recorder:
    """Notes to which pass the kernels belong: those launched between two calls of `drain` go to the pass named then."""

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

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with everything evaluated before and after it."""

        @functools.wraps(function)
        def wrapped(*args: Any, **kwargs: Any) -> Any:
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
    """Identity, whose backward pass evaluates the gradients that have come so far."""

    def eval(self, value: Any, recorder: Recorder, label: str) -> Any:
        self.recorder, self.label = recorder, label
        return value

    def backward(self) -> None:
        gradient = self.grad_out()
        dr.eval(gradient)
        self.recorder.reached(self.label)
        self.set_grad_in("value", gradient)


def _marked(value: Any, recorder: Recorder, label: str) -> Any:
    """The same tree of arrays with the differentiable ones behind a common `_Mark`."""
    leaves: list[Any] = []
    _mapped(value, lambda leaf: leaves.append(leaf) or leaf)
    if not leaves:
        return value
    marked = iter(dr.custom(_Mark, leaves, recorder, label))
    return _mapped(value, lambda leaf: next(marked))


def _mapped(value: Any, function: Callable[[Any], Any]) -> Any:
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


def _switch(records: list[Recorder], name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    def call(*args: Any, **kwargs: Any) -> Any:
        return records[-1].wrap(name, function)(*args, **kwargs)

    return call


def find(place: str) -> tuple[Any, str]:
    """Owner (module or class) and name of a function `module:name` or `module:class.name`."""
    module, _, path = place.partition(":")
    owner: Any = importlib.import_module(f"shadowmap_dr.{module}")
    *classes, attribute = path.split(".")
    for name in classes:
        owner = getattr(owner, name)
    return owner, attribute
