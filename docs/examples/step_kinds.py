"""Time of steps that differentiate by parameters of different kinds, under different lights.

    python docs/examples/step_kinds.py [--resolution 1024] [--variant llvm_ad_rgb] [--seconds 2.5] [KIND ...]

A ball over a floor. A step sets a parameter, renders with the plug-in, takes the mean squared difference from a gray image, and
its gradient; `frozen` is a step of the `Renderer` by the ball's vertices, recorded. Prints medians. To compare two versions, run
them in turns with PYTHONPATH set to each.
"""

from __future__ import annotations

import argparse
import gc
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import shadowmap_dr

# isort: split
import drjit as dr  # after shadowmap_dr, which chooses the LLVM library
import mitsuba as mi

#: Name -> light, parameter, and whether the floor has a texture.
KINDS = {
    "vertices": ("sun", "ball.to_world", False),
    "reflectance": ("sun", "floor.bsdf.reflectance.value", False),
    "texture": ("sun", "floor.bsdf.reflectance.data", True),
    "irradiance": ("sun", "light.irradiance.value", False),
    "lamp_vertices": ("lamp", "ball.to_world", False),
    "lamp_reflectance": ("lamp", "floor.bsdf.reflectance.value", False),
    "lamp_texture": ("lamp", "floor.bsdf.reflectance.data", True),
    "sky_vertices": ("sky", "ball.to_world", False),
    "sky_reflectance": ("sky", "floor.bsdf.reflectance.value", False),
}
WARM_UP, LEAST = 5, 8

Step = Callable[[int], Any]


def build(light: str, size: int, textured: bool = False) -> Any:
    """The scene, square images."""
    T = mi.ScalarTransform4f
    texels = np.random.default_rng(0).uniform(0.2, 0.8, (64, 64, 3)).astype(np.float32)
    picture = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True}
    lamp = T().translate([0, 0, 3]).rotate([1, 0, 0], 180).scale(0.4)
    lights = {
        "sun": {"type": "directional", "direction": [0.3, 0.2, -1]},
        "lamp": {"type": "rectangle", "to_world": lamp, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}},
        "sky": {"type": "constant"},
    }
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    look = T().look_at([2, -4, 4], [0, 0, 0], [0, 0, 1])
    colour = picture if textured else {"type": "rgb", "value": [0.5, 0.4, 0.3]}
    gray = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}
    ball = {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.6, "bsdf": gray}
    return mi.load_dict(
        {
            "type": "scene",
            "floor": {"type": "rectangle", "to_world": T().scale(3), "bsdf": {"type": "diffuse", "reflectance": colour}},
            "ball": ball,
            "light": lights[light],
            "camera": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
        }
    )


def plugin_step(light: str, key: str, textured: bool, size: int) -> Step:
    """The loop of a Mitsuba user."""
    scene = build(light, size, textured)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "shadowmap"})
    rest = type(params[key])(params[key])

    def step(k: int) -> Any:
        if key.endswith("to_world"):
            changing = mi.Point3f(0.01 * k, 0, 0)
            dr.enable_grad(changing)
            params[key] = mi.Transform4f().translate(changing) @ rest
        else:
            changing = type(rest)(rest * (1 + 0.001 * k))
            dr.make_opaque(changing)
            dr.enable_grad(changing)
            params[key] = changing
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=1)
        dr.backward(dr.mean(dr.square(image - 0.3), axis=None))
        return dr.grad(changing)

    return step


def frozen_step(size: int) -> Step:
    """The loop with a renderer, in a frozen function."""
    renderer = shadowmap_dr.Renderer.from_scene(build("sun", size))

    @dr.freeze
    def gradient(shift: Any, renderer: Any) -> Any:
        dr.enable_grad(shift)
        moved = renderer.data.geometry.shape_positions("ball") + mi.Vector3f(shift, 0, 0)
        dr.backward(dr.mean(dr.square(renderer.render({"ball": moved}) - 0.3), axis=None))
        return dr.grad(shift)

    return lambda k: gradient(dr.opaque(mi.Float, 0.01 * (k % 5)), renderer)


def median_milliseconds(step: Step, seconds: float) -> tuple[float, int]:
    """Of single steps, and how many there were."""
    times: list[float] = []
    for k in range(WARM_UP):
        dr.eval(step(k))
    begin = time.perf_counter()
    while len(times) < LEAST or time.perf_counter() - begin < seconds:
        start = time.perf_counter()
        dr.eval(step(len(times)))
        dr.sync_thread()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times), len(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}, frozen")
    parser.add_argument("--resolution", type=int, default=1024)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--seconds", type=float, default=2.5, help="for each kind, at least")
    options = parser.parse_args()
    if unknown := set(options.kinds) - {*KINDS, "frozen"}:
        parser.error(f"no kind {', '.join(sorted(unknown))}: choose from {', '.join(KINDS)}, frozen")
    mi.set_variant(options.variant)
    gc.disable()
    for kind in options.kinds or [*KINDS, "frozen"]:
        step = frozen_step(options.resolution) if kind == "frozen" else plugin_step(*KINDS[kind], options.resolution)
        median, count = median_milliseconds(step, options.seconds)
        print(f"{kind}: {median:.2f} ms a step ({count} steps)", flush=True)
        gc.collect()


if __name__ == "__main__":
    main()
