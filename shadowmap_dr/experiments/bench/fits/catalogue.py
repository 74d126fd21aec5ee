"""The problems: 40 that are scored, and 16 others for tuning. Each line of the tables is one."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
        extra: `path`: pictures with light that bounces; `views`: two views; `intruder`: something stands before the camera.
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


SCORED = (
    # One directional light.
    Row("bunny-pose", "corner", "bunny^", "sun", "bunny:pose"),
    Row("chair-pose", "floor", "chair", "sun", "chair:pose", "noise"),
    Row("spot-sun", "corner", "spot", "sun", "sun:direction"),
    Row("house-pose-sun", "floor", "house^", "sun", "house:pose sun:direction", "jpeg"),
    Row("teapot-colours", "corner", "teapot rock", "sun", "teapot.bsdf.reflectance floor.bsdf.reflectance rock.bsdf.reflectance"),
    Row("cam-wall", "wall", "cam", "sun", "cam:pose sun:direction"),
    Row("dragon-all", "niche", "dragon", "sun", "dragon:pose sun:direction dragon.bsdf.reflectance", "noise"),
    Row("two-poses", "corner", "suzanne^ glider^", "sun", "suzanne:pose glider:pose"),
)


@functools.cache
def scored() -> tuple[FitProblem, ...]:
    """The problems that are scored."""
    return tuple(problem(row, "scored") for row in SCORED)


def named(names: Sequence[str]) -> list[FitProblem]:
    """Problems by their names; KeyError for others."""
    every = {one.name: one for one in scored()}
    return [every[name] for name in names]


def problem(row: Row, table: str) -> FitProblem:
    """The problem of a line."""
    seed = zlib.crc32(f"{table} {row.name} {row.seed}".encode())
    random = np.random.default_rng(seed + 1)
    views = 2 if "views" in row.extra else 1
    size = ((256, 192), (240, 192), (208, 208), (288, 216))[int(random.integers(4))]
    truth = stages.scene(row.stage, row.things.split(), row.lights.split(), views, size, seed)
    photographs = tuple(_photograph(row.photo, random) for _ in range(views))
    path = "path" in row.extra
    return FitProblem(
        row.name,
        truth,
        tuple(parse(name) for name in row.varied.split()),
        photographs,
        seed % 1_000_003,
        integrator="path" if path else "direct",
    )


def _photograph(effects: str, random: np.random.Generator) -> Photograph:
    exposure = float(2 ** random.uniform(-1, 1))
    white = tuple(random.uniform(0.8, 1.2, 2).tolist()) if "white" in effects else (1.0, 1.0)
    vignetting = float(random.uniform(0.35, 0.55)) if "vignetting" in effects else 0.0
    quality = int(random.integers(80, 96)) if "jpeg" in effects else None
    return Photograph(exposure, white, vignetting, "noise" in effects, quality)
