"""Random steps of a scene whose parameters of all kinds change, replayed and compared with the same steps unrecorded.

``python tests/support/recording_stress.py 2000 7`` takes 2000 steps with seed 7.
"""

from __future__ import annotations

import gc
import sys
import time
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from shadowmap_dr.jit.arrays import own_memory
from shadowmap_dr.jit.pytree import tree_map
from shadowmap_dr.rendering.renderer import Renderer

FLOOR, SKY, BOX = "floor.bsdf.reflectance", "sky.data", "box.bsdf"


def scene(few: bool, size: int = 24) -> Any:
    """A coloured ball and a glossy box on a textured floor, a sun, two cameras; a bulb, a lamp and a sky unless ``few``."""
    from renderer_scenes import ball

    def camera(*origin: float) -> dict[str, Any]:
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        to_world = mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0.5], [0, 0, 1])
        return {"type": "perspective", "fov": 45, "to_world": to_world, "film": film}

    def bitmap(*shape: int) -> mi.Bitmap:
        return mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, shape).astype(np.float32))

    coloured = ball("ball", [0, 0, 0.9])
    coloured.add_attribute("vertex_color", 3, np.full(3 * coloured.vertex_count(), 0.5, np.float32))
    coloured.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}))
    translate = mi.ScalarTransform4f().translate
    parts = {
        "ball": coloured,
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3),
                  "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap(8, 8, 3), "raw": True}}},
        "box": {"type": "cube", "to_world": translate([1, 0.4, 0.4]).scale(0.3),
                "bsdf": {"type": "principled", "roughness": 0.4, "base_color": {"type": "rgb", "value": [0.6, 0.4, 0.2]}}},
        "lamp": {"type": "rectangle", "to_world": translate([0, 0, 4]).rotate([1, 0, 0], 180).scale(0.3),
                 "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}},
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": {"type": "rgb", "value": [1.0, 0.9, 0.8]}},
        "bulb": {"type": "point", "position": [1.5, 0, 2.5], "intensity": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        "sky": {"type": "envmap", "bitmap": bitmap(8, 17, 3)},
        "one": camera(2, -3, 4), "two": camera(-2, -3, 3),
    }  # fmt: skip
    if few:
        parts = {name: part for name, part in parts.items() if name not in ("lamp", "bulb", "sky")}
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


class Walk:
    """A scene whose parameters change at random."""

    def __init__(self, seed: int, few: bool) -> None:
        self.rng, self.scene, self.few = np.random.default_rng(seed), scene(few), few
        self.params = mi.traverse(self.scene)
        settings = {
            "shadow_map_resolution": 32,
            "area_light_samples": 4,
            "environment_light_samples": 4,
            "soft_map_resolution": 32,
        }
        self.renderers = [Renderer.from_scene(self.scene, antialias=antialias, **settings) for antialias in (True, False)]
        self.start = {key: type(value)(value) for key, value in self.params if dr.is_array_v(value)}
        self.cameras = {key: self.params[key] for key in ("one.to_world", "two.to_world", "lamp.to_world") if key in self.params}

    def numbers(self, *shape: int, low: float = 0.1, high: float = 0.9) -> Any:
        return mi.TensorXf(self.rng.uniform(low, high, shape).astype(np.float32))

    def offset(self) -> Any:
        return mi.Transform4f().translate(self.rng.uniform(-0.1, 0.1, 3).tolist())

    def texture(self) -> Any:
        return self.numbers(*[8 if self.few else int(self.rng.choice([8, 16]))] * 2, 3)

    def move(self) -> list[str]:
        """Change a few parameters outside of the recorded function. Names of the kinds."""
        rng, params = self.rng, self.params
        kinds = {
            "vertices": ("ball.vertex_positions", lambda: self.start["ball.vertex_positions"] + float(rng.uniform(-0.1, 0.1))),
            "bulb": ("bulb.position", lambda: mi.Point3f(*rng.uniform([1, -0.5, 2], [2, 0.5, 3]).tolist())),
            "sun": ("sun.irradiance.value", lambda: mi.Color3f(*rng.uniform(0.5, 2, 3).tolist())),
            "lamp": ("lamp.to_world", lambda: self.offset() @ self.cameras["lamp.to_world"]),
            "camera": ("one.to_world", lambda: self.offset() @ self.cameras["one.to_world"]),
            "texture": (f"{FLOOR}.data", self.texture),
            "to_uv": (f"{FLOOR}.to_uv", lambda: mi.ScalarTransform3f().scale(float(rng.choice([1, 2])))),
            "sky": (SKY, lambda: self.numbers(n := int(rng.choice([4, 8])), 2 * n + 1, 3)),
            "roughness": (f"{BOX}.roughness.value", lambda: mi.Float(float(rng.uniform(0.2, 0.6)))),
            "metallic": (f"{BOX}.metallic.value", lambda: mi.Float(float(rng.choice([0, 0.5])))),
            "colour": (f"{BOX}.base_color.value", lambda: mi.Color3f(*rng.uniform(0.1, 0.9, 3).tolist())),
        }
        chosen = [str(kind) for kind in rng.choice([kind for kind in kinds if kinds[kind][0] in params], rng.integers(0, 3))]
        if self.few or rng.random() < 0.9:  # these are recorded anew
            chosen = [kind for kind in chosen if kind not in ("to_uv", "metallic")]
        for kind in chosen:
            key, value = kinds[kind]
            params[key] = value()
        params.update()
        return chosen


def _step(renderer: Renderer, sensor: int, spp: int, inside: dict[str, Any], params: Any, weight: Any, ball: Any) -> Any:
    """Image and gradients of a weighted sum of it, after parameters have been set in the recorded function."""
    leaves = [ball, *inside.values()]
    dr.enable_grad(leaves)
    for key, value in inside.items():
        params[key] = value
    if inside:
        params.update()
    image = renderer.render({"ball": ball}, sensor=sensor, spp=spp)
    dr.backward(dr.sum(image * weight, axis=None))
    return dr.detach(image), [dr.grad(leaf) for leaf in leaves]


def stress(steps: int, seed: int = 0, seconds: float = 1e9, report: Any = None, few: bool = False) -> tuple[int, int, list[str]]:
    """(steps taken, recordings among them, what was wrong in which). ``few``: a simpler scene, and fewer kinds of steps."""
    walk, rng, frozen, wrong = Walk(seed, few), np.random.default_rng(seed), dr.freeze(_step), []
    start = time.monotonic()
    for count in range(steps):
        if time.monotonic() - start > seconds:
            return count, frozen.n_recordings, wrong
        kinds = walk.move()
        # Few kinds of steps, so that most are replayed; and colours seldom, which Dr.Jit does not see: all is recorded anew.
        kind = int(rng.integers(0, 2) if few else rng.integers(4))
        inside = {}
        if kind < 3:
            inside[f"{FLOOR}.data"] = walk.texture()
        if not few and rng.random() < 0.01:
            inside["ball.vertex_color"] = walk.numbers(len(walk.start["ball.vertex_positions"])).array
        sensor, spp = kind % 2, 4 if kind in (1, 2) else 1
        renderer = walk.renderers[kind == 3].refresh()
        ball = mi.Float(dr.detach(walk.start["ball.vertex_positions"])) + float(rng.uniform(-0.1, 0.1))
        weight = walk.numbers(24, 24, 3)
        dr.make_opaque(ball, weight, inside)
        found = []
        for function in (_step, frozen):
            own = replace(renderer)
            own.frusta, own.soft_frusta = tree_map((own.frusta, own.soft_frusta), lambda array: type(array)(array))
            # Copies: Mitsuba compares what is the same array as before.
            given = [own_memory(value) for value in (ball, *inside.values())]
            new = dict(zip(inside, given[1:], strict=True))
            image, gradients = function(own, sensor, spp, new, walk.params, weight, given[0])
            found.append([value.numpy().ravel() for value in (image, *gradients)])
        names = ["image", "ball", *inside]
        for name, right, value in zip(names, *found, strict=True):
            if right.shape != value.shape or not np.abs(value - right).max() <= 1e-4 + 2e-3 * np.abs(right).max():
                where = f"step {count}, after {kinds}, sensor {sensor}, spp {spp}, inside {list(inside)}"
                wrong.append(f"{where}: {name} is {np.abs(value - right).max():.2g} off, of {np.abs(right).max():.2g}")
        if report is not None and count % 50 == 0:
            report(f"{count}: {frozen.n_recordings} recordings, {len(wrong)} wrong {wrong[-1:]}")
        if count % 7 == 0:
            gc.collect()
    return steps, frozen.n_recordings, wrong


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    chosen = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    taken, made, faults = stress(int(sys.argv[1]), chosen, report=lambda line: print(line, flush=True))
    print("\n".join(faults), f"\n{taken} steps, {made} recordings, {len(faults)} wrong")
    sys.exit(bool(faults))
