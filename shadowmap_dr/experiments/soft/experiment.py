"""Light of extended emitters against path tracing: how far off it is, how that falls with samples, and what it costs."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console

from ...errors import ShadowmapError
from ...io import console as io_console
from ...io import files, records
from ...rendering.renderer import Renderer
from ..common.timing import Contender, alternate, machine
from . import report as soft_report
from . import scenes as soft_scenes

#: Error that scenes are held to, relative to the mean of the image, with this many samples of each area light and of the sky.
BAR, BAR_SAMPLES = 0.02, (64, 128)
# Distances from the camera whose second difference, relative to themselves, is larger lie on either side of an outline.
_JUMP = 0.01
# Errors below this are not told from none (relative to the mean of the image); samples of one image that Mitsuba takes at once.
_RESOLVED, _MOST_SAMPLES = 5e-3, (1 << 32) - 1
# Seconds and renderings at most that a time is measured for.
_TIMED_SECONDS, _TIMED_ROUNDS = 10.0, 9

Image = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class SoftOptions:
    """Options of a run.

    Attributes:
        scenes: names in `soft.scenes.SCENES`.
        samples: pairs (of each area light, of the environment).
        resolution: of images, pixels.
        map_resolution: texels along each side of each sample's shadow map.
        spp: samples per pixel of our images.
        reference_spp: samples per pixel of each of the two path-traced images.
        timed: whether times are measured.
        out: folder for the results.
        resume: keep scenes that an earlier run with the same settings has finished.
    """

    scenes: tuple[str, ...] = tuple(soft_scenes.SCENES)
    samples: tuple[tuple[int, int], ...] = ((16, 32), (32, 64), (64, 128))
    resolution: int = 96
    map_resolution: int = 128
    spp: int = 16
    reference_spp: int = 512
    timed: bool = True
    out: Path = Path("soft")
    resume: bool = False

    def __post_init__(self) -> None:
        if not self.scenes or not self.samples:
            raise ShadowmapError("no scene or no number of samples given: name at least one.")
        for name in self.scenes:
            if name not in soft_scenes.SCENES:
                raise ShadowmapError(f"no scene {name!r}: choose from {', '.join(soft_scenes.SCENES)}.")
        if self.resolution < 8 or self.reference_spp < 16 or self.spp < 1:
            raise ShadowmapError("resolution, reference samples and samples must be at least 8, 16 and 1.")

    @property
    def settings(self) -> dict[str, Any]:
        """Settings on which numbers depend: a run is resumed with the same."""
        kept = asdict(self)
        for name in ("scenes", "out", "resume"):
            kept.pop(name)
        return records.plain(kept)


@dataclass(frozen=True)
class Traced:
    """Two independent path-traced images (H, W, 3), and which of their pixels count: surfaces, away from outlines.

    ``spp``: samples per pixel of each.
    """

    first: Image
    second: Image
    mask: Mask
    spp: int

    @property
    def image(self) -> Image:
        """Mean of both."""
        return 0.5 * (self.first + self.second)

    @property
    def level(self) -> float:
        """Mean radiance where pixels count."""
        return float(self.image[self.mask].mean())

    @property
    def variance(self) -> float:
        """Mean variance of :attr:`image`, as the difference of the two tells it."""
        difference = (self.first - self.second)[self.mask].astype(np.float64)
        return float(np.square(difference).mean()) / 4

    def error(self, image: Image) -> float:
        """Relative root mean square error of an image, the reference's own variance subtracted."""
        square = float(np.square((image - self.image)[self.mask].astype(np.float64)).mean())
        return math.sqrt(max(square - self.variance, 0.0)) / self.level

    def bias(self, image: Image) -> float:
        """Relative error of the mean."""
        return float(image[self.mask].mean()) / self.level - 1

    @property
    def noise(self) -> float:
        """Relative root mean square error of a path-traced image with one sample per pixel."""
        return math.sqrt(2 * self.variance * self.spp) / self.level


def run_soft(options: SoftOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Measure all scenes; writes `soft.json`, `soft.md` and `soft.png` into `options.out` and returns the record."""
    path = options.out / "soft.json"
    files.check_output(path, (".json",))
    record: dict[str, Any] = {"settings": options.settings, "machine": machine(), "scenes": _kept(path, options)}
    with io_console.progress(console or Console(stderr=True)) as progress:
        task = progress.add_task("scenes", total=len(options.scenes) * (2 + len(options.samples)), note="")
        for name in options.scenes:
            if name in record["scenes"]:
                progress.update(task, advance=2 + len(options.samples))
                continue

            def step(note: str, name: str = name, done: int = 1) -> None:
                progress.update(task, advance=done, note=f"{name}, {note}")

            entry, pictures = measure(name, options, step)
            record["scenes"][name] = entry
            records.write_json(path, record)
            soft_report.save_pictures(options.out / "pictures" / f"{name}.exr", pictures)
    record["scenes"] = {name: record["scenes"][name] for name in soft_scenes.SCENES if name in record["scenes"]}
    records.write_json(path, record)
    soft_report.write(record, options.out)
    return record


def _kept(path: Path, options: SoftOptions) -> dict[str, Any]:
    if not options.resume or not path.exists():
        return {}
    scenes = records.read_record(path, options.settings, "scenes")["scenes"]
    return {name: entry for name, entry in scenes.items() if isinstance(entry, dict) and "errors" in entry}


def measure(name: str, options: SoftOptions, step: Callable[..., None]) -> tuple[dict[str, Any], dict[str, Image]]:
    """Errors and times of one scene, and its pictures: reference and our best image."""
    scene = soft_scenes.build(name, options.resolution)
    step("reference", done=0)
    traced = path_traced_twice(scene, options.reference_spp)
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


def one_map(scene: Any, traced: Traced, options: SoftOptions) -> dict[str, float] | None:
    """Error of the fast mode, with the most samples for shading; None where no light of the scene is fit for it."""
    area, sky = options.samples[-1]
    renderer = Renderer.from_scene(scene, area_light_samples=area, environment_light_samples=sky, emitter_shadows="single")
    if not any(plan.kind == "single" for plan in renderer.soft):
        return None
    image = np.array(renderer.render(spp=options.spp))[..., :3]
    return {"error": traced.error(image), "bias": traced.bias(image)}


def make_renderer(scene: Any, samples: tuple[int, int], map_resolution: int) -> Renderer:
    """A renderer with so many samples of (each area light, the environment)."""
    area, sky = samples
    return Renderer.from_scene(scene, area_light_samples=area, environment_light_samples=sky, soft_map_resolution=map_resolution)


def path_traced_twice(scene: Any, spp: int) -> Traced:
    """Two independent references of ``spp`` samples per pixel each."""
    from mitsuba_baselines.reference import path_traced

    first, second = (path_traced(scene, spp=spp, seed=seed, integrator="direct") for seed in (0, 1))
    return Traced(first.image[..., :3], second.image[..., :3], counted_pixels(scene), int(first.settings["spp"]))


def counted_pixels(scene: Any) -> Mask:
    """Bool (H, W): pixels that show a surface which does not shine, and no outline within one pixel; found by ray tracing."""
    sensor = scene.sensors()[0]
    width, height = (int(v) for v in sensor.film().crop_size())
    lane = dr.arange(mi.UInt32, width * height)
    position = mi.Point2f((mi.Float(lane % width) + 0.5) / width, (mi.Float(lane // width) + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    shape = dr.reinterpret_array(mi.UInt32, hit.shape).numpy().reshape(height, width)
    distance = np.where(hit.is_valid().numpy(), hit.t.numpy(), 0).reshape(height, width)
    surface = (hit.is_valid() & ~hit.shape.is_emitter()).numpy().reshape(height, width)
    outline = np.zeros((height, width), bool)
    for axis in (0, 1):
        s, d, o = (np.moveaxis(array, axis, 0) for array in (shape, distance, outline))
        differs = s[1:] != s[:-1]
        o[1:] |= differs
        o[:-1] |= differs
        # Large on both sides of a jump, and there only.
        o[1:-1] |= np.abs(d[2:] - 2 * d[1:-1] + d[:-2]) > _JUMP * d[1:-1]
    grown = outline.copy()
    for y in (-1, 0, 1):
        for x in (-1, 0, 1):
            rows, columns = (slice(max(v, 0), n + min(v, 0)) for v, n in ((y, height), (x, width)))
            back_rows, back_columns = (slice(max(-v, 0), n + min(-v, 0)) for v, n in ((y, height), (x, width)))
            grown[rows, columns] |= outline[back_rows, back_columns]
    return surface & ~grown


def equal_error_samples(error: float, noise: float, pixels: int) -> int:
    """Samples per pixel with which path tracing has an error, if it is ``noise`` with one.

    In favour of path tracing an error that the references cannot tell from none counts as `_RESOLVED`, and images of more samples
    than Mitsuba takes at once count as ones of so many.
    """
    wanted = math.ceil((noise / max(error, _RESOLVED)) ** 2)
    return min(max(1, wanted), _MOST_SAMPLES // pixels)


def _times(scene: Any, errors: list[dict[str, Any]], noise: float, options: SoftOptions) -> dict[str, Any]:
    """Seconds of our image with the most samples, and of a path-traced one with the same error."""
    best = errors[-1]
    width, height = (int(side) for side in scene.sensors()[0].film().crop_size())
    spp = equal_error_samples(best["error"], noise, width * height)
    renderer = make_renderer(scene, tuple(best["samples"]), options.map_resolution)
    render = dr.freeze(lambda spp, renderer: renderer.render(spp=spp).array)
    plugin = mi.load_dict({"type": "direct"})
    limits = {"rounds": _TIMED_ROUNDS, "warm_up": 2, "settle": 0, "burst": 1, "seconds": _TIMED_SECONDS}
    contenders = {
        "ours": Contender(lambda: dr.eval(render(options.spp, renderer)), **limits),
        "path traced": Contender(lambda: dr.eval(mi.render(scene, integrator=plugin, spp=spp)), **limits),
    }
    seconds = {name: statistics.median(values) for name, values in alternate(contenders).items()}
    return {"seconds": seconds, "path_traced_spp": spp, "ratio": seconds["path traced"] / seconds["ours"]}
