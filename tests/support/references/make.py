"""Makes the stored references: ``python tests/support/references/make.py [NAME ...]`` (all by default; some minutes on two
cores).

Files, 128 x 128, 16-bit EXR with the settings in the header (`mitsuba_baselines.reference.load` reads them):

- `SCENE_direct.exr`, `SCENE_unshadowed.exr` for each opaque scene in `scenes/` and the meadow: with and without shadow rays.
- `SCENE_volpath.exr`, 96 x 96, for scenes with translucent surfaces: `volpath` with `max_depth` 2.
- `derivative_CASE_PARAMETER.exr` for what `cases.py` lists: central differences of path-traced renderings. The header's
  `independent_cosine` says how well two references made with different seeds agree (asked for: 0.995).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mitsuba_baselines import derivatives, reference, unshadowed  # noqa: E402
from shadowmap_dr.io import assets  # noqa: E402

# isort: split
import mitsuba as mi  # noqa: E402

from references import cases  # noqa: E402

SPP_SCENE = 2048
SPP_DERIVATIVE = 4096
SPP_TRANSLUCENT = 4096  # paths end at translucent surfaces at random


def make_scene(name: str) -> None:
    scene = mi.load_file(str(assets.scene(name)), optimize=False, resolution=cases.RESOLUTION)
    reference.save(cases.FOLDER / f"{name}_direct.exr", reference.path_traced(scene, spp=SPP_SCENE), half=True)
    reference.save(cases.FOLDER / f"{name}_unshadowed.exr", unshadowed.unshadowed(scene, spp=SPP_SCENE), half=True)


def make_translucent(name: str) -> None:
    scene = mi.load_file(str(assets.scene(name)), optimize=False, resolution=cases.TRANSLUCENT_RESOLUTION)
    traced = reference.path_traced(scene, spp=SPP_TRANSLUCENT, integrator="volpath")
    reference.save(cases.FOLDER / f"{name}_volpath.exr", traced, half=True)


def make_derivative(traced: cases.Traced) -> None:
    step = traced.changed.step
    first, second = (derivatives.central_difference(traced.build, step, spp=SPP_DERIVATIVE, seed=seed) for seed in (0, 1))
    cosine = derivatives.agreement(first.image, second.image).cosine
    settings = {**first.settings, "parameter": traced.changed.key, "independent_cosine": cosine}
    reference.save(traced.path, replace(first, settings=settings), half=True)


def main() -> None:
    jobs = {name: lambda name=name: make_scene(name) for name in cases.SCENES}
    jobs |= {name: lambda name=name: make_translucent(name) for name in cases.TRANSLUCENT}
    jobs |= {traced.name: lambda traced=traced: make_derivative(traced) for traced in cases.TRACED}
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(jobs))
    names = parser.parse_args().names or list(jobs)
    unknown = [name for name in names if name not in jobs]
    if unknown:
        parser.error(f"no reference {unknown[0]!r}: choose from {', '.join(jobs)}.")
    mi.set_variant("llvm_ad_rgb")
    for index, name in enumerate(names, 1):
        print(f"{index}/{len(names)} {name}", flush=True)
        jobs[name]()


if __name__ == "__main__":
    main()
