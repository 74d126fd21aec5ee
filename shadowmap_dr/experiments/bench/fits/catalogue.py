"""The problems: 40 that are scored, and 16 others for tuning. Each line of the tables is one."""

from __future__ import annotations

import functools
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ....errors import ShadowmapError, did_you_mean
from ....io.meshes import SUFFIXES
from . import stages
from .photographs import Photograph
from .problem import FitProblem
from .variations import parse


@dataclass(frozen=True)
class Row:
    """A line of the tables.

    Attributes:
        name: of the problem.
        stage, things, lights: see `stages.scene`.
        varied: names of ``--vary``.
        photo: what was done to the photographs: `noise`, `jpeg`, `vignetting`, `white`.
        extra: `path`: pictures with light that bounces; `views`: two views; `intruder`: something that the scene lacks is in the
            picture; `picture:BODY`: a body with a texture; `deformed:BODY`: one with other vertices than its mesh.
        seed: another number gives another scene.
    """

    name: str
    stage: str
    things: str
    lights: str
    varied: str
    photo: str = ""
    extra: str = ""
    seed: int = 0


def _colours(*things: str) -> str:
    return " ".join(f"{thing}.bsdf.reflectance" for thing in things)


SCORED = (
    # One directional light.
    Row("bunny-pose", "corner", "bunny^", "sun", "bunny:pose"),
    Row("chair-pose", "floor", "chair", "sun", "chair:pose", "noise"),
    Row("spot-sun", "corner", "spot", "sun", "sun:direction"),
    Row("house-pose-sun", "floor", "house^", "sun", "house:pose sun:direction", "jpeg"),
    Row("teapot-colours", "corner", "teapot rock", "sun", _colours("teapot", "floor", "rock")),
    Row("cam-wall", "wall", "cam", "sun", "cam:pose sun:direction"),
    Row("dragon-all", "niche", "dragon", "sun", "dragon:pose sun:direction dragon.bsdf.reflectance", "noise"),
    Row("two-poses", "corner", "suzanne^ glider^", "sun", "suzanne:pose glider:pose"),
    Row("stairs-turn", "floor", "stairs", "sun", "stairs:rotation:y stairs:translation:xz", "noise jpeg"),
    Row("spring-scale", "corner", "spring", "sun", "spring:scale spring:translation:xyz", "vignetting"),
    Row("knot-irradiance", "corner", "knot^", "sun", "sun:direction sun.irradiance", "noise"),
    Row("glider-views", "corner", "glider^", "sun", "glider:pose sun:direction", "noise jpeg", "views"),
    Row("chair-mask", "floor", "chair", "sun", "chair:rotation:y chair:translation:xz sun:direction", "", "intruder"),
    # Spots and point lights.
    Row("spot-aim", "corner", "bunny", "spot", "spot:direction", "noise"),
    Row("spot-pose", "corner", "chair", "spot", "spot:pose spot.intensity", "jpeg"),
    Row("spot-and-dragon", "corner", "dragon", "spot", "spot:pose dragon:pose"),
    Row("point-position", "niche", "suzanne", "point", "point:position point.intensity", "noise"),
    Row("point-and-rock", "niche", "rock", "point", "point:position rock:pose rock.bsdf.reflectance", "jpeg"),
    # Area lamps.
    Row("panel-place", "corner", "house", "panel", "panel:translation:xyz panel.emitter.radiance", "noise"),
    Row("panel-pose", "niche", "stairs", "panel", "panel:pose", "jpeg"),
    Row(
        "panel-colours",
        "corner",
        "teapot knot",
        "panel",
        "teapot.bsdf.reflectance knot.bsdf.reflectance panel:translation:xyz",
        "noise",
    ),
    # Skies.
    Row("sky-teapot", "corner", "teapot", "sky", "teapot:pose", "noise"),
    Row("dome-spot", "corner", "spot", "dome", "spot:pose spot.bsdf.reflectance"),
    Row("sunsky-house", "corner", "house", "sunsky", "house:pose", "noise"),
    Row("sun-and-sky", "corner", "chair", "sun sky", "sun:direction sun.irradiance", "noise jpeg"),
    Row("both-lights", "corner", "suzanne^", "sun sky", "suzanne:pose sun.irradiance sky.radiance"),
    # Materials.
    Row("plastic", "corner", "vase/plastic", "point sky", "vase.bsdf.alpha vase.bsdf.diffuse_reflectance"),
    Row("metal", "corner", "bunny/metal", "panel sky", "bunny.bsdf.alpha bunny:pose", "noise"),
    Row(
        "white-balance",
        "corner",
        "rock spot",
        "sun sky",
        "rock.bsdf.reflectance spot.bsdf.reflectance sun:direction",
        "white noise",
    ),
    Row("picture-on-wall", "wall", "glider", "sun sky", "wall.bsdf:texture", "", "picture:wall"),
    Row("hill-vertices", "floor", "hill", "sun sky", "hill:vertices", "", "views deformed:hill"),
    # Cameras.
    Row("camera-pose", "niche", "dragon", "sun", "camera:pose", "noise"),
    Row("camera-fov", "corner", "house knot", "sun sky", "camera:pose camera:fov", "jpeg vignetting"),
    Row("second-camera", "corner", "stairs", "sun sky", "camera1:pose stairs:translation:xz", "noise", "views"),
    # Pictures with light that bounces. A sky that is not there stands for it.
    Row("bounces-bunny", "niche", "bunny", "sun sky", "bunny:pose sky.radiance", "noise", "path"),
    Row("bounces-sun", "niche", "chair", "sun sky", "sun:direction sky.radiance", "", "path"),
    Row("bounces-point", "niche", "rock", "point sky", "point:position sky.radiance", "jpeg", "path"),
    Row("bounces-panel", "corner", "spot", "panel sky", "spot:pose sky.radiance", "", "path"),
    Row("bounces-camera", "niche", "stairs cam", "sun sky", "camera:pose sky.radiance", "noise", "path"),
    Row(
        "bounces-all",
        "corner",
        "suzanne^",
        "sun sky",
        "suzanne:pose sun:direction suzanne.bsdf.reflectance sky.radiance",
        "jpeg",
        "path",
    ),
)

#: Other things, other scenes: to tune what the fit says of itself.
CALIBRATION = (
    Row("hand-pose", "corner", "hand^", "sun", "hand:pose", "noise"),
    Row("arch-sun", "floor", "arch", "sun", "sun:direction sun.irradiance", "jpeg"),
    Row("cactus-all", "corner", "cactus", "sun", "cactus:pose sun:direction cactus.bsdf.reflectance"),
    Row("bracket-turn", "floor", "bracket", "sun", "bracket:rotation:y bracket:translation:xz floor.bsdf.reflectance", "noise"),
    Row("mug-wall", "wall", "mug", "sun", "mug:pose", "vignetting"),
    Row("two-things", "corner", "mug arch", "sun sky", "mug:translation:xz arch:pose", "jpeg"),
    Row("crank-views", "corner", "crank^", "sun", "crank:pose", "noise jpeg", "views"),
    Row("tower-spot", "corner", "tower", "spot", "spot:pose tower:rotation:y tower:translation:xz"),
    Row("tower-point", "niche", "tower", "point", "point:position point.intensity", "jpeg"),
    Row("drape-panel", "corner", "drape^", "panel", "drape:pose", "noise"),
    Row("hand-dome", "corner", "hand", "dome", "hand:pose"),
    Row("cactus-sunsky", "floor", "cactus", "sunsky", "cactus:pose cactus.bsdf.reflectance", "noise"),
    Row("drape-plastic", "floor", "drape/plastic^", "point sky", "drape.bsdf.alpha drape.bsdf.diffuse_reflectance", "noise"),
    Row("crank-camera", "niche", "crank", "sun sky", "camera:pose camera:fov", "jpeg"),
    Row("bounces-bracket", "niche", "bracket", "sun sky", "bracket:pose sky.radiance", "noise", "path"),
    Row("bounces-tower", "niche", "tower", "point sky", "point:position sky.radiance", "", "path"),
)

#: Those of a short run.
QUICK = ("bunny-pose", "house-pose-sun", "teapot-colours", "spot-aim", "panel-place", "camera-pose")


@functools.cache
def scored() -> tuple[FitProblem, ...]:
    """The problems that are scored."""
    return tuple(problem(row) for row in SCORED)


@functools.cache
def calibration() -> tuple[FitProblem, ...]:
    """The problems for tuning."""
    return tuple(problem(row) for row in CALIBRATION)


def named(names: Sequence[str]) -> list[FitProblem]:
    """Problems by their names, of both tables. Raises ShadowmapError for names that neither has."""
    every = {one.name: one for one in (*SCORED, *CALIBRATION)}
    for name in names:
        if name not in every:
            raise ShadowmapError(f"no problem {name!r} for the fit.{did_you_mean(name, every)}")
    return [problem(every[name]) for name in names]


def of_meshes(folder: Path) -> list[FitProblem]:
    """A problem for each mesh in a folder: its pose under a sun whose direction is unknown. Shapes have the files' names."""
    files = {re.sub(r"\W", "_", path.stem): path for path in sorted(folder.iterdir()) if path.suffix.lower() in SUFFIXES}
    if not files:
        raise ShadowmapError(f"{folder} holds no meshes: give a folder with files of the kinds {', '.join(SUFFIXES)}.")
    rows = [Row(f"mesh-{name}", "corner", f"{name}^", "sun", f"{name}:pose sun:direction", "noise") for name in files]
    return [problem(row, files) for row in rows]


def problem(row: Row, files: Mapping[str, Path] | None = None) -> FitProblem:
    """The problem of a line; ``files``: meshes by name."""
    # Lines keep their scenes when others are added or moved.
    seed = zlib.crc32(f"scored {row.name} {row.seed}".encode())
    random = np.random.default_rng(seed + 1)
    views = 2 if "views" in row.extra else 1
    size = ((256, 192), (240, 192), (208, 208), (288, 216))[int(random.integers(4))]
    truth = stages.scene(row.stage, row.things.split(), row.lights.split(), views, size, seed, files)
    photographs = tuple(_photograph(row.photo, random) for _ in range(views))
    intruder = None
    for extra in row.extra.split():
        kind, _, part = extra.partition(":")
        if kind == "picture":
            truth = stages.with_picture(truth, part, random)
        elif kind == "deformed":
            truth = stages.deformed(truth, part, random)
        elif kind == "intruder":
            intruder = stages.intruder(truth, random)
    path = "path" in row.extra
    return FitProblem(
        row.name,
        stages.without_sky(truth) if path else truth,
        tuple(parse(name) for name in row.varied.split()),
        photographs,
        seed % 1_000_003,
        integrator="path" if path else "direct",
        spp=512 if set(row.lights.split()) & {"panel", "sky", "dome", "sunsky"} else 256,
        ambient=("sky.radiance",) if path else (),
        intruder=intruder,
    )


def _photograph(effects: str, random: np.random.Generator) -> Photograph:
    exposure = float(2 ** random.uniform(-1, 1))
    white = tuple(random.uniform(0.8, 1.2, 2).tolist()) if "white" in effects else (1.0, 1.0)
    vignetting = float(random.uniform(0.35, 0.55)) if "vignetting" in effects else 0.0
    quality = int(random.integers(80, 96)) if "jpeg" in effects else None
    return Photograph(exposure, white, vignetting, "noise" in effects, quality)
