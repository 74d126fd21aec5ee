"""Check of the problems: everything that is scored can be seen in the photographs.

``python -m shadowmap_dr.experiments.bench.fits.observability [--only NAME]...`` prints two numbers for each one that varies:

- the standard deviation with which pictures with errors of 1 % of their brightness at every pixel determine it, as a share of the
  bar of the score; above 1/2 it cannot be found honestly.
- the change of the picture by a step as large as the bar, less all that steps of the other numbers do as well: the 99th
  percentile of the pixels' changes, in steps of the photographs' 8 bits. Rounding averages out over many pixels,
  but below a quarter of a step nothing is left.

Derivatives are differences of pictures without noise, of this library, at half of the size. Textures and vertices are left out.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ....io.images import to_srgb
from . import catalogue
from .problem import FitProblem
from .scenes import Scene, load_scene, write_scene
from .score import ANGLE_DEG, POSITION, VALUE
from .variations import Variation, freedoms, nudged

Array = npt.NDArray[np.float64]
#: Errors of pixels, as a share of a picture's brightness; the most that a standard deviation may be, as a share of the bar.
_ERROR, WORST = 0.01, 0.5
#: The least change, in steps of 8 bits.
LEAST = 0.25
#: Step of differences, as a share of the bar.
_STEP = 1.0
_SIZE = 0.5


def visibility(problem: FitProblem) -> dict[str, tuple[float, float]]:
    """(standard deviation as a share of the bar, change by the bar in steps of 8 bits) by the names of the numbers."""
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
    deviations = _ERROR * np.sqrt(np.maximum(np.diag(covariance), 0))[:count]
    slopes = [_steps(picture, photo.exposure) * s for picture, photo, s in zip(middle, problem.photographs, sizes, strict=True)]
    shown = matrix * np.concatenate(slopes)
    return {name: (float(deviations[k]), _own_change(shown, k)) for k, name in enumerate(names)}


def _steps(picture: Array, exposure: float) -> Array:
    """Steps of 8 bits of a photograph for each unit of light in a picture; 0 where it is saturated."""
    light, small = picture * exposure, 1e-3
    ends = (np.clip(light + sign * small, 0, 1) for sign in (1, -1))
    high, low = (to_srgb(end).astype(float) for end in ends)
    return np.where(light < 1, 255 * exposure * (high - low) / (2 * small), 0)


def _own_change(matrix: Array, number: int) -> float:
    """The 99th percentile of the part of a row (n, pixels) that the other rows do not make."""
    others = np.delete(matrix, number, 0)
    rest = matrix[number]
    if len(others):
        rest = rest - np.linalg.lstsq(others.T, rest, rcond=None)[0] @ others
    return float(np.percentile(np.abs(rest), 99))


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
        loaded = load_scene(write_scene(scene, Path(folder)))
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
        found = visibility(problem)
        note = f"; up to a factor: {', '.join(problem.common_factor)}" if problem.common_factor else ""
        print(f"{problem.name}{note}", flush=True)
        for name, (deviation, change) in found.items():
            scored = any(name.startswith(f"{one.name} ") for one in problem.scored)
            note = "  NOT SEEN" if scored and (deviation > WORST or change < LEAST) else ""
            print(f"    {name:40} {deviation:8.3f} {change:8.2f}{note}", flush=True)


if __name__ == "__main__":
    main()
