"""Benchmark: seconds to first pictures and derivatives.

Where scenes have many shapes, each picture is of a newly loaded scene. Other scenes of its kind have been rendered before, so
that kernels are compiled, as they are in the second process that renders a scene. Mitsuba's `direct` renders the same scenes in
turns.

From nothing: each derivative is that of a new process, with no kernels on disk. Mitsuba's `direct_projective` takes turns,
without indirect visibility (`sppi` 0), whose guiding takes several times as long as all else.
"""

from __future__ import annotations

import functools
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError
from ...io import assets
from ...jit.types import Point3f
from ..common.timing import compare, timed
from .common import BenchOptions, Unit, Update, run_child

# Pictures of each scene, and the time limit (seconds) of a scene's process.
_ROUNDS, _SECONDS = 3, 900.0
_KINDS = ("cube", "rectangle", "sphere", "cylinder", "disk")
_GROUPED = ("cube", "sphere", "cylinder")
# Vertices of first derivatives from nothing, by scene; samples per pixel; pixels along each side.
_VERTICES = {"pose": "object.vertex_positions", "pavilion": "hand.vertex_positions"}
_SPP, _SIZE = 16, 128


@dataclass(frozen=True)
class Crowd:
    """A scene of many shapes.

    Attributes:
        instances: number of instances; they take the shape groups in turns.
        groups: number of shape groups.
        shapes: number of single shapes.
        kinds: plug-ins of the single shapes, in turns.
        lights: number of lights; directional, point and spot lights in turns.
    """

    instances: int = 0
    groups: int = 0
    shapes: int = 0
    kinds: tuple[str, ...] = _KINDS
    lights: int = 1

    def __str__(self) -> str:
        parts = []
        if self.instances:
            parts.append(f"{self.instances} instances of {self.groups} groups")
        if self.shapes:
            parts.append(f"{self.shapes} {self.kinds[0]}s" if len(self.kinds) == 1 else f"{self.shapes} shapes")
        if self.lights > 1:
            parts.append(f"{self.lights} lights")
        return ", ".join(parts)

    def scene(self, seed: int) -> mi.Scene:
        """A new scene (64 x 64 pixels) with shapes and lights in other places for each ``seed``."""
        place = functools.partial(_place, np.random.default_rng(seed))
        film = {"type": "hdrfilm", "width": 64, "height": 64, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        to_world = mi.ScalarTransform4f().look_at([0, -5, 4], [0, 0, 0], [0, 0, 1])
        parts: dict[str, Any] = {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
            "sensor": {"type": "perspective", "fov": 45, "to_world": to_world, "film": film},
        }
        for k in range(self.lights):
            x, y = np.random.default_rng((seed, k)).uniform(-1, 1, 2).tolist()
            parts[f"light{k}"] = (
                {"type": "directional", "direction": [0.3 + x, y, -2]},
                {"type": "point", "position": [x, y, 3]},
                {"type": "spot", "to_world": mi.ScalarTransform4f().look_at([x, y, 3], [y, x, 0], [0, 1, 0])},
            )[k % 3]
        for k in range(self.groups):
            parts[f"group{k}"] = {"type": "shapegroup", "shape": {"type": _GROUPED[k % len(_GROUPED)]}}
        for k in range(self.instances):
            parts[f"instance{k}"] = {
                "type": "instance",
                "to_world": place(),
                "of": {"type": "ref", "id": f"group{k % self.groups}"},
            }
        for k in range(self.shapes):
            parts[f"shape{k}"] = {"type": self.kinds[k % len(self.kinds)], "to_world": place()}
        return mi.load_dict(parts)


def _place(random: np.random.Generator) -> mi.ScalarTransform4f:
    x, y = random.uniform(-2, 2, 2).tolist()
    return mi.ScalarTransform4f().translate([x, y, 0.2]).scale(0.2)


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each scene."""
    crowds = [Crowd(**crowd) for crowd in options.what.crowds]
    cold = [Unit(f"{name}, no kernels", functools.partial(_measure_cold, options, name)) for name in options.what.cold]
    return [Unit(str(crowd), functools.partial(_measure, crowd)) for crowd in crowds] + cold


def _measure(crowd: Crowd, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    update(0, 1, str(crowd))
    return run_child("bench.first:measure_first", {"crowd": asdict(crowd)}, _SECONDS)


def measure_first(crowd: Mapping[str, Any], emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Seconds of first pictures by both integrators, and of our first backward pass."""
    made = Crowd(**{**crowd, "kinds": tuple(crowd["kinds"])})
    methods = {"ours": "shadowmap", "direct": "direct"}
    seconds: dict[str, list[float]] = {name: [] for name in (*methods, "backward")}
    for seed in range(1 + _ROUNDS):
        for name, plugin in methods.items():
            # `mi.traverse` puts earlier scenes into reference cycles. While they live, Mitsuba compiles calls of their objects.
            scene = integrator = None
            gc.collect()
            scene, integrator = made.scene(seed), mi.load_dict({"type": plugin})
            dr.sync_thread()
            seconds[name].append(timed(functools.partial(mi.render, scene, integrator=integrator, spp=1)))
            if name == "ours":
                seconds["backward"].append(timed(functools.partial(_derivative, scene, integrator)))
    # The first calls include the compilation of kernels that Dr.Jit had not cached on disk.
    return {"uncompiled": {name: values.pop(0) for name, values in seconds.items()}, **compare(seconds, [("ours", "direct")])}


def _derivative(scene: mi.Scene, integrator: mi.Integrator) -> Point3f:
    """Gradient of the image's sum by the position of the floor."""
    params, change = mi.traverse(scene), mi.Point3f(0)
    dr.enable_grad(change)
    params["floor.to_world"] = mi.Transform4f().translate(change) @ mi.Transform4f(params["floor.to_world"])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=integrator, spp=1), axis=None))
    return dr.grad(change)


def _measure_cold(options: BenchOptions, name: str, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    """Seconds from the start of a process to the first derivative, in turns, and the ends of the parts before it."""
    methods: dict[str, dict[str, Any]] = {
        "ours": {"type": "shadowmap"},
        "direct_projective": {"type": "direct_projective", "sppi": 0},
    }
    parts: dict[str, list[dict[str, float]]] = {method: [] for method in methods}
    for count in range(options.what.cold_rounds):
        update(count, options.what.cold_rounds, name)
        for method, integrator in methods.items():
            parts[method].append(_cold_seconds(name, integrator))
    seconds = {method: [ends["derivative"] for ends in found] for method, found in parts.items()}
    ends = {
        method: {part: float(np.median([one[part] for one in found])) for part in found[0]} for method, found in parts.items()
    }
    return {"cold": True, "ends": ends, **compare(seconds, [("ours", "direct_projective")])}


def _cold_seconds(name: str, integrator: dict[str, Any]) -> dict[str, float]:
    """Seconds of `bench.cold` in a new process, whose home directory, where Dr.Jit keeps kernels, is empty."""
    package = Path(__file__).resolve().parents[3]
    paths = filter(None, (str(package), os.environ.get("PYTHONPATH")))
    task = {
        "integrator": dict(integrator),
        "variant": mi.variant(),
        "threads": dr.thread_count(),
        "spp": _SPP,
        "size": str(_SIZE),
    }
    task |= {"scene": str(assets.scene(name)), "parameter": _VERTICES[name]}
    with tempfile.TemporaryDirectory() as home:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "HOME": home, "LOCALAPPDATA": home}
        process = subprocess.run(
            [sys.executable, str(Path(__file__).with_name("cold.py"))],
            input=json.dumps({**task, "began": time.time()}).encode(),
            capture_output=True,
            env=environment,
            timeout=_SECONDS,
            check=False,
        )
    if process.returncode:
        lines = process.stderr.decode(errors="replace").strip().splitlines()
        raise ShadowmapError(f"status {process.returncode}: {lines[-1] if lines else 'no message'}")
    found: dict[str, float] = json.loads(process.stdout.decode(errors="replace").splitlines()[-1])["seconds"]
    return found
