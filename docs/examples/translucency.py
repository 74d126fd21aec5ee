"""Errors of translucent surfaces and of their shadows against Mitsuba's path tracer, and of derivatives.

    python docs/examples/translucency.py [--size 64] [--spp 1024] [--only images encodings derivatives steps]

Run it in the root of the repository. Images: relative root mean square of the difference with 1 and 16 samples per pixel, without
pixels next to outlines of shapes, and of all pixels. Derivatives: cosine and scale against path-traced central differences, after
a blur of 5 pixels. Steps: milliseconds of frozen steps with more and more panes, in turns.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import shadowmap_dr

# isort: split
import drjit as dr
import mitsuba as mi

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support"), str(ROOT / "tests" / "rendering")]

SECTIONS = ("images", "encodings", "derivatives", "steps")
parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--size", type=int, default=64)
parser.add_argument("--spp", type=int, default=1024)
parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
options = parser.parse_args()

mi.set_variant("llvm_ad_rgb")
warnings.simplefilter("ignore")

from test_translucency import changes, derivative, edges, rendered  # noqa: E402
from translucent_scenes import lights, pane, panes, relative_error, scene_of, stacks, traced, veil  # noqa: E402

from mitsuba_baselines.derivatives import agreement  # noqa: E402


def images() -> None:
    print("scene | layers | 1 sample | 16 samples | 16, outlines included")
    cases = [(name, {"ball": None, **parts}, None) for name, parts in panes().items()]
    cases += [(name, parts, None) for name, parts in stacks().items()]
    cases += [(f"two, {name}", stacks()["two"], light) for name, light in lights().items() if name not in ("sun", "sky")]
    cases += [("five, sky", stacks()["five"], lights()["sky"])]
    for name, parts, light in cases:
        scene = scene_of(options.size, light, **parts)
        reference, beside = (
            traced(scene, options.spp * (4 if light and light["type"] in ("rectangle", "constant") else 1)),
            ~edges(scene),
        )
        one, many = rendered(scene, 1), rendered(scene, 16)
        errors = [
            relative_error(one, reference, beside),
            relative_error(many, reference, beside),
            relative_error(many, reference),
        ]
        count = shadowmap_dr.Renderer.from_scene(scene).translucency.camera.layers
        print(name, count, *(f"{100 * error:.2f} %" for error in errors), sep=" | ", flush=True)


def encodings() -> None:
    print("method | groups | five panes | thirty panes")
    scenes = [scene_of(options.size, **stacks()[name]) for name in ("five", "thirty")]
    references = [traced(scene, options.spp) for scene in scenes]
    for method in ("msm", "evsm4", "vsm", "evsm2", "esm", "csm"):
        for groups in (1, 2, 4, 8):
            if groups > 2 and method not in ("msm", "evsm4"):
                continue
            settings = {"transmittance_method": method, "transmittance_groups": groups}
            errors = [
                relative_error(rendered(scene, 4, **settings), reference)
                for scene, reference in zip(scenes, references, strict=True)
            ]
            print(method, groups, *(f"{100 * error:.2f} %" for error in errors), sep=" | ", flush=True)


def derivatives() -> None:
    print("parameter | samples | cosine | scale | forward and backward differ by")
    for name, change in changes(options.size).items():
        build, step = change[:2]
        reference = (traced(build(step), options.spp) - traced(build(-step), options.spp)) / (2 * step)
        for spp in (1, 4, 16):
            image, forward, backward = derivative(change, spp)
            found = agreement(image, reference)
            off = abs(forward - backward) / max(abs(forward), 1e-9)
            print(name, spp, f"{found.cosine:.3f}", f"{found.scale:.3f}", f"{off:.0e}", sep=" | ", flush=True)


def steps() -> None:
    """A step moves the ball below the panes, or the panes with it."""
    print("panes | which move | ms a step | panes' share of a step without any")

    def step_of(count: int, moving: bool) -> Any:
        parts = {f"p{k}": pane(veil(0.5), 0.9 + 0.1 * k, 0.1 * k - 0.1, 5 * k) for k in range(count)}
        renderer = shadowmap_dr.Renderer.from_scene(scene_of(options.size, **parts))
        rest = {name: dr.ravel(renderer.vertices(name)) for name in ("ball", *(parts if moving else ()))}
        target = dr.detach(renderer.render())

        @dr.freeze
        def step(renderer: Any, rest: Any, shift: Any, target: Any) -> Any:
            dr.enable_grad(shift)
            places = {name: dr.unravel(mi.Point3f, points) + mi.Point3f(shift, 0, 0) for name, points in rest.items()}
            dr.backward(dr.mean(dr.square(renderer.render(places) - target), axis=None))
            return dr.grad(shift)

        def run(number: int) -> None:
            dr.eval(step(renderer, rest, mi.Float(0.01 + 1e-4 * number), target))
            dr.sync_thread()

        for number in range(4):
            run(number)
        return run

    kinds = [(0, False), *((count, moving) for count in (1, 2, 4) for moving in (False, True))]
    runs = {kind: step_of(*kind) for kind in kinds}
    taken: dict[tuple[int, bool], list[float]] = {kind: [] for kind in runs}
    for number in range(40):
        for kind, run in runs.items():
            start = time.perf_counter()
            run(number)
            taken[kind].append(1e3 * (time.perf_counter() - start))
    medians = {kind: float(np.median(times)) for kind, times in taken.items()}
    for (count, moving), median in medians.items():
        share = f"{(median / medians[0, False] - 1) / count:.2f} each" if count else ""
        print(count, "all" if moving else "the ball", f"{median:.2f}", share, sep=" | ", flush=True)


for section in options.only:
    {"images": images, "encodings": encodings, "derivatives": derivatives, "steps": steps}[section]()
