"""``dr.freeze`` of steps with a ``Renderer``: a replay gives what the same step gives unrecorded.

What once ended the process runs in one of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent

TEXTURES = '''
import sys
import drjit as dr, numpy as np
import quick_kernels, shadowmap_dr
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
T, kind = mi.ScalarTransform4f, sys.argv[1]

def losses(frozen):
    image = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((16, 16, 3), 0.5, np.float32)), "raw": True}
    bsdfs = {"diffuse": {"type": "diffuse", "reflectance": image},
             "principled": {"type": "twosided", "bsdf": {"type": "principled", "base_color": image, "roughness": 0.4}}}
    film = {"type": "hdrfilm", "width": 32, "height": 32, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    view = T().look_at(origin=[0, 3, 4], target=[0, 0, 0], up=[0, 1, 0])
    scene = mi.load_dict({"type": "scene",
        "camera": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90).scale(1.5), "bsdf": bsdfs[kind]},
        "box": {"type": "cube", "to_world": T().translate([0, 0.3, 0]).scale(0.2), "bsdf": {"type": "roughplastic"}},
        "sun": {"type": "directional", "direction": [0.3, -1, -0.8]}}, optimize=False)
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.startswith("floor.") and key.endswith(".data"))
    renderer = shadowmap_dr.Renderer.from_scene(scene, shadow_map_resolution=32)
    target, adam = 0.8 * renderer.render(), mi.ad.Adam(lr=0.02)
    adam[key] = mi.TensorXf(np.random.default_rng(1).uniform(0.2, 0.8, (16, 16, 3)).astype(np.float32))

    def step(adam, params, target, scene, renderer):
        params[key] = dr.clip(adam[key], 0, 1)
        params.update()
        loss = dr.mean(dr.square(renderer.render() - target), axis=None)
        dr.backward(loss)
        adam.step()
        return dr.detach(loss)

    step = dr.freeze(step) if frozen else step
    found = []
    for _ in range(8):
        found.append(float(step(adam, params, target, scene, renderer).array[0]))
        junk = [dr.opaque(mi.Float, 1e9, size) for size in (1, 1, 16, 32, 64)]
    return np.array(found)

plain, frozen = losses(False), losses(True)
assert plain[-1] < 0.9 * plain[0]
np.testing.assert_allclose(frozen, plain, rtol=1e-4)
'''


def run(code: str, *arguments: str) -> None:
    """Run Python code with modules of the tests at hand; fails where it fails."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)])}
    done = subprocess.run([sys.executable, "-c", code, *arguments], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.parametrize("kind", ["diffuse", "principled"])
def test_textures_that_change_within_the_recorded_step(kind: str) -> None:
    run(TEXTURES, kind)
