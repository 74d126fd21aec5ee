"""Check of the problems: everything that is scored can be seen in the photographs.

``python -m shadowmap_dr.experiments.bench.fits.observability [--only NAME]...`` prints, for each number that varies, the standard
deviation with which pictures with errors of 1 % of their brightness at every pixel determine it, as a share of the bar of the
score. Derivatives are differences of pictures without noise, of this library, at half of the size. A number above 1/2 cannot be
found honestly. Textures and vertices are left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from . import catalogue
from .problem import FitProblem
from .scenes import Scene, write_scene
from .score import ANGLE_DEG, POSITION, VALUE
from .variations import Variation, freedoms, nudged

Array = npt.NDArray[np.float64]
#: Errors of pixels, as a share of a picture's brightness; the most that a standard deviation may be, as a share of the bar.
_ERROR, WORST = 0.01, 0.5
#: Step of differences, as a share of the bar.
_STEP = 1.0
_SIZE = 0.5


def standard_deviations(problem: FitProblem) -> dict[str, float]:
    """Standard deviations by the names of the numbers, as shares of their bars."""
    scene = _smaller(problem.truth)
    middle = _pictures(scene)
    sizes = [np.sqrt(np.mean(picture**2)) for picture in middle]
    names, columns = [], []
    for variation in problem.varied:
        bars = _bars(scene, variation)
        for number, bar in enumerate(bars):
            step = np.eye(len(bars))[number] * bar * _STEP
            ahead, behind = (_pictures(nudged(scene, variation, sign * step)) for sign in (1, -1))
            columns.append(np.concatenate([(a - b) / (2 * _STEP * s) for a, b, s in zip(ahead, behind, sizes, strict=True)]))
            names.append(f"{variation.name} {number}")
    count = len(columns)
    if not problem.common_factor:
        for k in range(len(middle)):  # the exposures, which are not printed
            columns.append(np.concatenate([picture / sizes[k] * (j == k) for j, picture in enumerate(middle)]))
    matrix = np.array(columns)
    # Pixels that are alike in their errors: a block of four counts once.
    covariance = np.linalg.pinv(matrix @ matrix.T / 4, rcond=1e-12)
    return dict(zip(names, _ERROR * np.sqrt(np.maximum(np.diag(covariance), 0))[:count], strict=True))


def _bars(scene: Scene, variation: Variation) -> list[float]:
    """Bars of a quantity's numbers, in the units of `nudged`."""
    count, length = freedoms(scene, variation), POSITION * scene.diameter()
    if variation.kind == "pose":
        return [ANGLE_DEG] * (count - 3) + [length] * 3
    if variation.kind == "scale":
        body = scene.body(variation.part)
        return [length / float(np.linalg.norm(body.world() - body.centre(), axis=1).max())]
    bar = {"value": VALUE, "translation": length, "position": length}.get(variation.kind, ANGLE_DEG)
    return [bar] * count


def _smaller(scene: Scene) -> Scene:
    cameras = [
        dataclasses.replace(camera, width=round(camera.width * _SIZE), height=round(camera.height * _SIZE))
        for camera in scene.cameras
    ]
    return dataclasses.replace(scene, cameras=tuple(cameras))


def _pictures(scene: Scene) -> list[Array]:
    """Pictures of all cameras, flat."""
    with tempfile.TemporaryDirectory() as folder:
        loaded = mi.load_file(str(write_scene(scene, Path(folder))))
    method = mi.load_dict({"type": "shadowmap"})
    images = [mi.render(loaded, sensor=sensor, integrator=method, spp=4) for sensor in range(len(scene.cameras))]
    return [np.array(image, float)[..., :3].ravel() for image in images]


def main() -> None:
    parser = argparse.ArgumentParser(description="Check that all that varies can be seen in the pictures.")
    parser.add_argument("--only", action="append", default=[], help="name of a problem")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    every = (*catalogue.scored(), *catalogue.calibration())
    for problem in catalogue.named(arguments.only) if arguments.only else every:
        found = standard_deviations(problem)
        note = f"; up to a factor: {', '.join(problem.common_factor)}" if problem.common_factor else ""
        print(f"{problem.name}{note}", flush=True)
        for name, deviation in found.items():
            scored = any(name.startswith(f"{one.name} ") for one in problem.scored)
            note = "  NOT SEEN" if scored and deviation > WORST else ""
            print(f"    {name:40} {deviation:8.3f}{note}", flush=True)


if __name__ == "__main__":
    main()
