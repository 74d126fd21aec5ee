"""Time of a step through `mi.render`, the same without recordings, with a recorded `Renderer`, and of Mitsuba's update, in turns.

    python docs/examples/plugin_speed.py [--scene pose] [--shape object] [--resolution 128] [--rounds 50]

A step moves a shape's vertices, renders, takes the mean squared difference from a gray image, and its gradient.
"""

from __future__ import annotations

import argparse
from typing import Any

import drjit as dr

import shadowmap_dr
from shadowmap_dr.experiments.common.timing import Contender, OtherWork, alternate, compare
from shadowmap_dr.io import assets

# isort: split
import mitsuba as mi  # after shadowmap_dr, which chooses the LLVM library

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--scene", default="pose", help="of this package's scenes")
parser.add_argument("--shape", default="object", help="that moves")
parser.add_argument("--resolution", type=int, default=128)
parser.add_argument("--rounds", type=int, default=50)
options = parser.parse_args()

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(str(assets.scene(options.scene)), resolution=options.resolution, optimize=False)
key = f"{options.shape}.vertex_positions"
start = mi.Float(dr.detach(mi.traverse(scene)[key]))


def gradient(image: Any, shift: Any) -> Any:
    """Of the loss, by how far the shape has moved."""
    dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
    return dr.grad(shift)


class Plugin:
    """The loop of a Mitsuba user."""

    def __init__(self, **parameters: Any) -> None:
        self.integrator = mi.load_dict({"type": "shadowmap", **parameters})
        self.params = mi.traverse(scene)
        self.shift = mi.Float(0.01)

    def __call__(self) -> None:
        shift = mi.Float(self.shift)
        dr.enable_grad(shift)
        self.params[key] = start + shift
        self.params.update()
        self.shift = self.shift - 1e-3 * gradient(mi.render(scene, self.params, integrator=self.integrator), shift)
        dr.eval(self.shift)


class Frozen:
    """The loop with a renderer, in a frozen function."""

    def __init__(self) -> None:
        self.renderer = shadowmap_dr.Renderer.from_scene(scene)
        self.shift = mi.Float(0.01)
        self.step = dr.freeze(self._step)

    def __call__(self) -> None:
        self.shift = self.step(self.shift, start, self.renderer)

    @staticmethod
    def _step(shift: Any, start: Any, renderer: Any) -> Any:
        shift = mi.Float(shift)
        dr.enable_grad(shift)
        image = renderer.render(vertex_positions={options.shape: start + shift})
        return dr.detach(shift) - 1e-3 * gradient(image, shift)


class Update:
    """Mitsuba's own work when vertices change, without an image: the acceleration structure of its rays, normals."""

    def __init__(self) -> None:
        self.params = mi.traverse(scene)

    def __call__(self) -> None:
        self.params[key] = start + 0.01
        self.params.update()
        dr.eval(self.params[key])


contenders = {
    "plug-in": Plugin(),
    "plug-in, recorded=False": Plugin(recorded=False),
    "renderer, recorded": Frozen(),
    "params.update() alone": Update(),
}
others = OtherWork()
samples = alternate({name: Contender(call, options.rounds) for name, call in contenders.items()})
for name, seconds in compare(samples)["seconds"].items():
    print(f"{name}: {1e3 * seconds['median']:.2f} ms a step (quartiles {1e3 * seconds['q1']:.2f}, {1e3 * seconds['q3']:.2f})")
cores = others.cores()
print("" if cores is None else f"cores that other work used meanwhile: {cores:.1f}")
