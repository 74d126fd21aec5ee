"""The picture of docs/how-it-works.md: two scenes of the package, and a pose at the start, as found, and its path-traced image.

python docs/examples/overview.py [--out docs/overview.png] [--size 256] [--steps 150]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from mitsuba_baselines.reference import path_traced
from shadowmap_dr import Renderer
from shadowmap_dr.experiments.pose.methods import shadow_settings
from shadowmap_dr.experiments.pose.scene import make_problem
from shadowmap_dr.inverse import PoseFit
from shadowmap_dr.io import assets
from shadowmap_dr.io.plots import image_sheet

# isort: split
import mitsuba as mi  # after shadowmap_dr, which chooses the LLVM library

SCENES = ["pavilion", "still_life"]
START = (np.radians(-25), 0.2, -0.15)  # rotation, x, y


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/overview.png"))
    parser.add_argument("--size", type=int, default=256, help="pixels along each side of a picture")
    parser.add_argument("--steps", type=int, default=150, help="steps from the start to the pose")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    pictures = {}
    for name in SCENES:
        scene = mi.load_file(str(assets.scene(name)), resolution=str(options.size), optimize=False)
        pictures[name.replace("_", " ")] = np.array(mi.render(scene, integrator=mi.load_dict({"type": "shadowmap"}), spp=16))
    with tempfile.TemporaryDirectory() as folder:
        problem = make_problem("spot", options.size, work=Path(folder))
        reference = path_traced(problem.scene, spp=512).image
        fit = PoseFit(Renderer.from_scene(problem.scene, **shadow_settings("shadows")), "object", problem.p_rest, reference)
        fit.reset(START)
        pictures["pose, start"] = fit.render(np.array(START))
        for _ in range(options.steps):
            fit.step()
        pictures[f"after {options.steps} steps"] = fit.render(np.array(fit.parameters()))
        pictures["its path-traced image"] = reference
    image_sheet(options.out, {"": pictures})
    print(options.out)


if __name__ == "__main__":
    main()
