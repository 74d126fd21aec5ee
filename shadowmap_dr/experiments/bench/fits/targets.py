"""Photographs of the problems, from Mitsuba's own integrators. Pictures are kept by a digest of their scene."""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ....io.files import atomic
from ....io.images import read_image, write_exr
from .problem import FitProblem
from .scenes import MAX_DEPTH, Scene, load_scene, write_scene

Array = npt.NDArray[np.float64]
#: Samples of a pass: their memory is what one render takes.
_PASS = 64
#: A pixel is left out where the intruder changes it by more than this share of the mean, or near such pixels.
_CHANGED, _NEAR = 0.02, 2


def write_problem(problem: FitProblem, start: int, folder: Path, cache: Path) -> None:
    """Write all that the command gets: the scene with start values, photographs and masks."""
    write_scene(problem.start(start), folder, integrator=problem.integrator)
    pictures = truth_pictures(problem, cache)
    for k, (photo, file) in enumerate(zip(problem.photographs, problem.targets(), strict=True)):
        photo.write(folder / file, pictures[k], seed=problem.seed * 10 + k)
    for k, file in enumerate(problem.masks()):
        from PIL import Image

        kept = mask(pictures[k], _pictures(problem.truth, problem, cache)[k])
        Image.fromarray((kept * 255).astype(np.uint8)).save(folder / file)


def truth_pictures(problem: FitProblem, cache: Path) -> list[Array]:
    """Linear pictures (H, W, 3) by the cameras of the true scene, with the intruder."""
    scene = problem.truth
    if problem.intruder is not None:
        scene = dataclasses.replace(scene, bodies=(*scene.bodies, problem.intruder))
    return _pictures(scene, problem, cache)


def mask(with_intruder: Array, without: Array) -> npt.NDArray[np.bool_]:
    """True (H, W) for pixels that an intruder and its shadow leave as they are."""
    changed = np.abs(with_intruder - without).max(-1) > _CHANGED * without.mean()
    # Single bright samples are no change.
    count = _box_sum(changed, 1)
    return _box_sum(changed & (count > 3), _NEAR) == 0


def _box_sum(flags: npt.NDArray[np.bool_], reach: int) -> npt.NDArray[np.int64]:
    padded = np.pad(flags.astype(np.int64), reach)
    size = 2 * reach + 1
    return np.lib.stride_tricks.sliding_window_view(padded, (size, size)).sum((-1, -2))


def _pictures(scene: Scene, problem: FitProblem, cache: Path) -> list[Array]:
    with tempfile.TemporaryDirectory() as temporary:
        file = write_scene(scene, Path(temporary))
        digest = hashlib.sha256(f"{mi.__version__} {problem.integrator} {problem.spp}".encode())
        for path in sorted(Path(temporary).iterdir()):
            digest.update(path.name.encode() + path.read_bytes())
        stems = [cache / f"{digest.hexdigest()[:20]}-{k}.exr" for k in range(len(scene.cameras))]
        if not all(path.exists() for path in stems):
            cache.mkdir(parents=True, exist_ok=True)
            for path, image in zip(stems, render(file, problem.integrator, problem.spp), strict=True):
                with atomic(path) as unfinished:
                    write_exr(unfinished, {name: image[..., k].astype(np.float32) for k, name in enumerate("RGB")})
    return [read_image(path).astype(float) for path in stems]


def render(file: Path, integrator: str, spp: int) -> list[Array]:
    """Linear pictures (H, W, 3) by all sensors of a scene file, from one of Mitsuba's integrators."""
    scene = load_scene(file)
    settings = {"max_depth": MAX_DEPTH} if integrator == "path" else {}
    method = mi.load_dict({"type": integrator, **settings})
    pictures = []
    for sensor in range(len(scene.sensors())):
        passes = [
            np.array(mi.render(scene, sensor=sensor, integrator=method, spp=min(spp, _PASS), seed=number), float)
            for number in range(-(-spp // _PASS))
        ]
        pictures.append(np.mean(passes, axis=0)[..., :3])
    return pictures
