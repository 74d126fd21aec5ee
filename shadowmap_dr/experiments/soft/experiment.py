"""Comparison of extended lights with path tracing: errors, their convergence with samples, and times."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console

from ...errors import ShadowmapError, did_you_mean
from ...io import console as io_console
from ...io import files, records
from ...io.machine import header
from ...io.options import option
from ...io.ranges import MAP_SIDE, SAMPLES, check_range, check_ranges
from ...jit.frozen import freeze
from ...jit.types import UInt32
from ...rendering.renderer import Renderer
from ...rendering.settings import MOST_SAMPLES
from ..common.timing import Contender, alternate
from . import report as soft_report
from . import scenes as soft_scenes

#: Largest acceptable error, relative to the mean of the image, with these samples of each area light and of the sky.
BAR, BAR_SAMPLES = 0.02, (64, 128)
# A larger second difference of the distances from the camera, relative to the distance, marks a silhouette.
_JUMP = 0.01
# Smallest measurable error, relative to the mean of the image; largest number of samples of one Mitsuba launch.
_RESOLVED, _MOST_SAMPLES = 5e-3, (1 << 32) - 1
# Limits of a measurement of time: seconds and renderings.
_TIMED_SECONDS, _TIMED_ROUNDS = 10.0, 9

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


def _pair(text: str) -> tuple[int, int]:
    """Two numbers of samples as the command line has them, for instance 64/128."""
    area, _, sky = text.partition("/")
    if not (area.isdecimal() and sky.isdecimal() and int(area) and int(sky)):
        raise ShadowmapError(f"--samples {text}: give two positive numbers, as in 64/128.")
    return int(area), int(sky)


@dataclass(frozen=True)
class SoftOptions:
    """Options of the experiment."""

    scenes: tuple[str, ...] = option(
        tuple(soft_scenes.SCENES), names=("--scene",), choices=soft_scenes.SCENES, shown="all", help="Scene; repeatable."
    )
    samples: tuple[tuple[int, int], ...] = option(
        ((16, 32), (32, 64), (64, 128)),
        full=((16, 32), (32, 64), (64, 128), (128, 256)),
        metavar="AREA/SKY",
        shown="16/32, 32/64, 64/128",
        parse=_pair,
        help="Samples of each area light and of the sky; repeatable.",
    )
    resolution: int = option(96, full=192, allowed=(8, 4096), help="Image width and height in pixels.")
    map_resolution: int = option(128, allowed=MAP_SIDE, help="Texels along each side of the map of each sample.")
    spp: int = option(16, allowed=SAMPLES, help="Samples per pixel of our images.")
    reference_spp: int = option(
        512, full=2048, allowed=(16, 65536), help="Samples per pixel of each of the two path-traced images."
    )
    timed: bool = option(True, names=("--times/--no-times",), help="Measure times.")
    out: Path = option(Path("soft"), help="Folder for the results.")
    resume: bool = option(False, help="Keep the finished scenes of a killed run with the same settings.")

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.scenes or not self.samples:
            raise ShadowmapError("no scene or no number of samples given: name at least one.")
        for name in self.scenes:
            if name not in soft_scenes.SCENES:
                raise ShadowmapError(
                    f"no scene {name!r}: choose from {', '.join(soft_scenes.SCENES)}.{did_you_mean(name, soft_scenes.SCENES)}"
                )
        for pair in self.samples:
            for name, value in zip(("area", "sky"), pair, strict=True):
                check_range(f"number of {name} samples (--samples)", value, (1, MOST_SAMPLES))

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the results depend on: a resumed run must have the same."""
        kept = asdict(self)
        for name in ("scenes", "out", "resume"):
            kept.pop(name)
        return records.plain(kept)


@dataclass(frozen=True)
class Traced:
    """Two independent path-traced images (H, W, 3) of ``spp`` samples per pixel each, and the mask of the pixels that count.

    Pixels count if they show a surface, away from silhouettes.
    """

    first: Image
    second: Image
    mask: Mask
    spp: int

    @property
    def image(self) -> Image:
        """Mean of both images."""
        return 0.5 * (self.first + self.second)

    @property
    def level(self) -> float:
        """Mean radiance of the pixels that count."""
        return float(self.image[self.mask].mean())

    @property
    def variance(self) -> float:
        """Mean variance of :attr:`image`, estimated from the difference of the two images."""
        difference = (self.first - self.second)[self.mask].astype(np.float64)
        return float(np.square(difference).mean()) / 4

    def error(self, image: Image) -> float:
        """Relative root mean square error of an image, without the variance of the reference."""
        square = float(np.square((image - self.image)[self.mask].astype(np.float64)).mean())
        return math.sqrt(max(square - self.variance, 0.0)) / self.level

    def bias(self, image: Image) -> float:
        """Relative error of an image's mean."""
        return float(image[self.mask].mean()) / self.level - 1

    @property
    def noise(self) -> float:
        """Relative root mean square error of a path-traced image with one sample per pixel."""
        return math.sqrt(2 * self.variance * self.spp) / self.level


def run_soft(options: SoftOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Measure all scenes, write `soft.json`, `soft.md` and `soft.png` into `options.out`, and return the record."""
    path = options.out / "soft.json"
    files.check_output(path, (".json",))
    record: dict[str, Any] = {**header(options.settings), "scenes": _kept(path, options)}
    with io_console.progress(console or io_console.notes()) as progress:
        task = progress.add_task("scenes", total=len(options.scenes) * (2 + len(options.samples)), note="")
        for name in options.scenes:
            if name in record["scenes"]:
                progress.update(task, advance=2 + len(options.samples))
                continue

            def step(note: str, name: str = name, done: int = 1) -> None:
                progress.update(task, advance=done, note=f"{name}, {note}")

            entry, pictures = measure(name, options, step)
            record["scenes"][name] = entry
            records.write_record(path, record, "scenes")
            soft_report.save_pictures(options.out / "pictures" / f"{name}.exr", pictures)
    record["scenes"] = {name: record["scenes"][name] for name in soft_scenes.SCENES if name in record["scenes"]}
    records.write_record(path, record, "scenes")
    soft_report.write(record, options.out)
    return record


def _kept(path: Path, options: SoftOptions) -> dict[str, Any]:
    if not options.resume or not path.exists():
        return {}
    needed = ("about", "glossy", "counted", "reference_noise", "noise_of_one_sample", "errors")
    scenes: dict[str, Any] = records.read_record(
        path,
        {"settings": options.settings, "scenes": {}},
        {"scenes": needed},
        lambda record: soft_report.reading(record) and soft_report.rows(record),
    )["scenes"]
    return scenes


def measure(name: str, options: SoftOptions, step: Callable[..., None]) -> tuple[dict[str, Any], dict[str, Image]]:
    """Errors and times of one scene, and its pictures: the reference and our image with the most samples."""
    scene = soft_scenes.build(name, options.resolution)
    step("reference", done=0)
    traced = path_traced_twice(scene, options.reference_spp)
    if not traced.mask.any() or not traced.level > 0:
        side = options.resolution
        raise ShadowmapError(
            f"scene {name!r} has no lit pixel away from silhouettes in {side} x {side} pixels: give a larger --resolution."
        )
    step("reference")
    entry: dict[str, Any] = {
        "about": soft_scenes.SCENES[name].about,
        "glossy": soft_scenes.SCENES[name].glossy,
        "counted": float(traced.mask.mean()),
        "reference_noise": math.sqrt(traced.variance) / traced.level,
        "noise_of_one_sample": traced.noise,
        "errors": [],
    }
    image = traced.image
    for pair in options.samples:
        renderer = make_renderer(scene, pair, options.map_resolution)
        image = np.array(renderer.render(spp=options.spp))[..., :3]
        entry["errors"].append({"samples": list(pair), "error": traced.error(image), "bias": traced.bias(image)})
        step(f"{pair[0]} and {pair[1]} samples")
    entry["one_map"] = one_map(scene, traced, options)
    if options.timed:
        entry["times"] = _times(scene, entry["errors"], traced.noise, options)
    step("times")
    return entry, {"path traced": traced.image, "ours": image}


def one_map(scene: mi.Scene, traced: Traced, options: SoftOptions) -> dict[str, float] | None:
    """Errors of the fast mode with the most samples for shading; None if it supports no light of the scene."""
    area, sky = options.samples[-1]
    renderer = Renderer.from_scene(scene, area_light_samples=area, environment_light_samples=sky, emitter_shadows="single")
    if not any(plan.kind == "single" for plan in renderer.soft):
        return None
    image = np.array(renderer.render(spp=options.spp))[..., :3]
    return {"error": traced.error(image), "bias": traced.bias(image)}


def make_renderer(scene: mi.Scene, samples: tuple[int, int], map_resolution: int) -> Renderer:
    """A renderer with the given samples of (each area light, the environment)."""
    area, sky = samples
    return Renderer.from_scene(scene, area_light_samples=area, environment_light_samples=sky, soft_map_resolution=map_resolution)


def path_traced_twice(scene: mi.Scene, spp: int) -> Traced:
    """Render two independent references of ``spp`` samples per pixel each."""
    from mitsuba_baselines.reference import path_traced

    first, second = (path_traced(scene, spp=spp, seed=seed, integrator="direct") for seed in (0, 1))
    return Traced(first.image[..., :3], second.image[..., :3], counted_pixels(scene), int(first.settings["spp"]))


def counted_pixels(scene: mi.Scene) -> Mask:
    """Mask (H, W) of pixels that show no emitter and are more than one pixel away from silhouettes, found by ray tracing."""
    sensor = scene.sensors()[0]
    width, height = (int(v) for v in sensor.film().crop_size())
    lane = dr.arange(mi.UInt32, width * height)
    position = mi.Point2f((mi.Float(lane % width) + 0.5) / width, (mi.Float(lane // width) + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    shape = cast(UInt32, dr.reinterpret_array(mi.UInt32, hit.shape)).numpy().reshape(height, width)
    distance = np.where(hit.is_valid().numpy(), hit.t.numpy(), 0).reshape(height, width)
    surface = (hit.is_valid() & ~hit.shape.is_emitter()).numpy().reshape(height, width)
    outline = np.zeros((height, width), bool)
    for axis in (0, 1):
        s, d, o = (np.moveaxis(array, axis, 0) for array in (shape, distance, outline))
        differs = s[1:] != s[:-1]
        o[1:] |= differs
        o[:-1] |= differs
        # The second difference is large on both sides of a jump only.
        o[1:-1] |= np.abs(d[2:] - 2 * d[1:-1] + d[:-2]) > _JUMP * d[1:-1]
    grown = outline.copy()
    for y in (-1, 0, 1):
        for x in (-1, 0, 1):
            rows, columns = (slice(max(v, 0), n + min(v, 0)) for v, n in ((y, height), (x, width)))
            back_rows, back_columns = (slice(max(-v, 0), n + min(-v, 0)) for v, n in ((y, height), (x, width)))
            grown[rows, columns] |= outline[back_rows, back_columns]
    return surface & ~grown


def equal_error_samples(error: float, noise: float, pixels: int) -> int:
    """Samples per pixel with which path tracing has the given error, if its error is ``noise`` with one sample.

    In favour of path tracing, smaller errors than `_RESOLVED` count as `_RESOLVED`, and the samples of an image are limited to
    those of one launch.
    """
    wanted = math.ceil((noise / max(error, _RESOLVED)) ** 2)
    return min(max(1, wanted), _MOST_SAMPLES // pixels)


def _times(scene: mi.Scene, errors: list[dict[str, Any]], noise: float, options: SoftOptions) -> dict[str, Any]:
    """Seconds of our image with the most samples, and of a path-traced one with the same error."""
    best = errors[-1]
    width, height = (int(side) for side in scene.sensors()[0].film().crop_size())
    spp = equal_error_samples(best["error"], noise, width * height)
    renderer = make_renderer(scene, tuple(best["samples"]), options.map_resolution)
    render = freeze(lambda spp, renderer: renderer.render(spp=spp).array)
    plugin = mi.load_dict({"type": "direct"})
    limits: dict[str, Any] = {"rounds": _TIMED_ROUNDS, "warm_up": 2, "settle": 0, "burst": 1, "seconds": _TIMED_SECONDS}
    contenders = {
        "ours": Contender(lambda: dr.eval(render(options.spp, renderer)), **limits),
        "path traced": Contender(lambda: dr.eval(mi.render(scene, integrator=plugin, spp=spp)), **limits),
    }
    seconds = {name: statistics.median(values) for name, values in alternate(contenders).items()}
    return {"seconds": seconds, "path_traced_spp": spp, "ratio": seconds["path traced"] / seconds["ours"]}
