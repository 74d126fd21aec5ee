"""Comparison of shadow maps: all methods on difficult scenes, against path tracing."""

from __future__ import annotations

import functools
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from ...errors import ShadowmapError, did_you_mean
from ...io import console as io_console
from ...io import files, plots, records
from ...io.machine import header
from ...io.options import option, setting
from ...io.ranges import FILTER_SIDE, MAP_SIDE, SAMPLES, check_ranges
from ...jit.frozen import freeze
from ...jit.types import Float
from ...rendering.renderer import Renderer
from ...rendering.settings import AUTO
from ...shadow import ShadowSettings, directional_view
from ..common.timing import Contender, alternate
from . import pose as maps_pose
from . import scenes as maps_scenes
from . import view_run
from .metrics import Image, Texel, metrics, texel_in_pixels

#: Labels of the compared shadow maps, and their options of the `Renderer`.
CANDIDATES: dict[str, dict[str, Any]] = {
    "plain vsm": {"shadow_method": "vsm", "shadow_receiver_range": False},
    "vsm": {"shadow_method": "vsm"},
    "vsm, cut": {"shadow_method": "vsm", "shadow_bleeding": 0.2},
    "pcf": {"shadow_method": "pcf"},
    "esm": {"shadow_method": "esm"},
    "evsm2": {"shadow_method": "evsm2"},
    "evsm4": {"shadow_method": "evsm4"},
    "evsm4, cut": {"shadow_method": "evsm4", "shadow_bleeding": 0.1},
    "msm": {"shadow_method": "msm"},
    "msm, cut": {"shadow_method": "msm", "shadow_bleeding": 0.1},
    "csm": {"shadow_method": "csm", "shadow_order": 8},
    # As many maps as pixels are worth, as the renderer chooses without any option.
    "default": {"shadow_map_resolution": AUTO, "shadow_filter_size": 0},
}


#: Names of all scenes: those that are seen from above, and views under the sun.
ALL_SCENES = (*maps_scenes.SCENES, *view_run.VIEWS)


@dataclass(frozen=True)
class MapsOptions:
    """Options of the experiment.

    An image has several pixels for each texel, so that edges can be located.
    """

    scenes: tuple[str, ...] = option(
        ALL_SCENES, names=("--scene",), choices=ALL_SCENES, shown="all", help="Scene; repeatable. A city is 16 views."
    )
    candidates: tuple[str, ...] = option(
        tuple(CANDIDATES), names=("--method",), choices=CANDIDATES, shown="all", help="Shadow map; repeatable."
    )
    resolution: int = option(512, allowed=(8, 4096), help="Image width and height in pixels.")
    map_resolution: int = option(256, allowed=MAP_SIDE, help="Texels along each side of a shadow map.")
    filter_size: int = option(3, allowed=FILTER_SIDE, help="Texels along each side of the filter.")
    reference_spp: int = option(1024, names=("--spp",), allowed=SAMPLES, help="Samples per pixel of the path-traced images.")
    pose_runs: int = option(10, allowed=(0, 100000), help="Poses to find with each shadow map, from shadows alone; 0 for none.")
    view_spp: int = option(64, allowed=SAMPLES, help="Samples per pixel of the path-traced images of contacts and cities.")
    city_folder: Path | None = option(
        None,
        metavar="FOLDER",
        help=f"Folder with {view_run.REAL_CITY}, a real city, to measure as well.",
    )
    out: Path = option(Path("maps"), help="Folder for the results.")
    rounds: int = setting(30, allowed=(1, 10000), help="Number of timed renderings of each shadow map.")

    def __post_init__(self) -> None:
        check_ranges(self)
        for kind, names, known in (("scene", self.scenes, ALL_SCENES), ("method", self.candidates, CANDIDATES)):
            if not names:
                raise ShadowmapError(f"no {kind} given: name at least one.")
            for name in names:
                if name not in known:
                    raise ShadowmapError(
                        f"no {kind} {name!r}: choose from {', '.join(map(repr, known))}.{did_you_mean(name, known)}"
                    )
        view_run.check_city_folder(self.city_folder)
        try:
            ShadowSettings(resolution=self.map_resolution, filter_size=self.filter_size)
        except ValueError as error:
            raise ShadowmapError(str(error)) from None


def run_maps(options: MapsOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Measure all candidates on all scenes, and return the record.

    Writes `maps.json` into `options.out`, `maps.png` with the scenes that are seen from above, and `views.png` with views under
    the sun.
    """
    console = console or io_console.notes()
    files.check_output(options.out / "maps.json", (".json",))
    record: dict[str, Any] = {**header(asdict(options)), "candidates": CANDIDATES, "scenes": {}}
    sheet: dict[str, dict[str, Image]] = {}
    with io_console.progress(console) as progress:
        for name in options.scenes:
            if name not in maps_scenes.SCENES:
                continue
            task = progress.add_task(name, total=len(options.candidates) + 1, note="reference")
            scene = maps_scenes.build(name, options.resolution)
            reference, mask = reference_visibility(scene, options.reference_spp)
            derivative = _reference_derivative(name, options)
            p_world = _positions(scene)
            progress.update(task, advance=1)
            record["scenes"][name], sheet[name] = {}, {"path traced": reference[..., None]}
            for label in options.candidates:
                progress.update(task, note=label)
                renderer = _renderer(scene, label, options)
                image = visibility_image(renderer)
                texel = _texel(name, p_world, renderer, mask)
                entry = {"texel_pixels": asdict(texel)} | metrics(image, reference, mask, texel, options.filter_size)
                footprint = options.filter_size * texel.longest
                record["scenes"][name][label] = entry | _derivative_agreement(name, label, derivative, footprint, options)
                sheet[name][label] = image[..., None]
                progress.update(task, advance=1)
            _add_times(record["scenes"][name], scene, options)
            records.write_json(options.out / "maps.json", record)
        if options.pose_runs:
            record["poses"] = _poses(options, progress)
            records.write_json(options.out / "maps.json", record)
        views = _add_views(record, options, progress)
    for name, rows in (("maps", sheet), ("views", views)):
        if rows:
            plots.image_sheet(options.out / f"{name}.png", rows, size=1.8)
    return record


def _add_views(record: dict[str, Any], options: MapsOptions, progress: Progress) -> dict[str, dict[str, Image]]:
    """Add all views under the sun to a record, and return rows of pictures of those in which parts move."""
    settings = {label: _settings(label, options) for label in options.candidates}
    chosen = view_run.ViewOptions(settings, options.resolution, options.map_resolution, options.filter_size, options.view_spp)
    sheet: dict[str, dict[str, Image]] = {}
    for view in view_run.views_of(options.scenes, options.city_folder):
        task = progress.add_task(view.name, total=len(options.candidates) + 1, note="")

        def note(text: str, task: TaskID = task) -> None:
            progress.update(task, advance=int(text != view_run.FIRST), note=text)

        entry, rows = view_run.measure(view, chosen, note)
        progress.update(task, completed=len(options.candidates) + 1)
        if entry:
            if view.motions:
                _add_times(entry["methods"], view.scene(options.resolution), options)
            record.setdefault("views", {})[view.name] = entry
            records.write_json(options.out / "maps.json", record)
        if view.motions:
            sheet |= rows
    return sheet


def _poses(options: MapsOptions, progress: Progress) -> dict[str, Any]:
    """Pose estimation with each candidate."""
    task = progress.add_task("poses", total=len(options.candidates) * options.pose_runs, note="reference")
    problem, reference = maps_pose.shadow_problem(options.out / "pose")
    result = {}
    for label in options.candidates:
        progress.update(task, note=label)
        advance = functools.partial(progress.update, task, advance=1)
        result[label] = maps_pose.poses_found(problem, reference, _settings(label, options), options.pose_runs, advance)
    return result


def _settings(label: str, options: MapsOptions) -> dict[str, Any]:
    """Options of `Renderer.from_scene` for a candidate."""
    sizes = {"shadow_map_resolution": options.map_resolution, "shadow_filter_size": options.filter_size}
    return {**sizes, **CANDIDATES[label]}


def _renderer(scene: mi.Scene, label: str, options: MapsOptions) -> Renderer:
    return Renderer.from_scene(scene, **_settings(label, options), aovs=("visibility",))


def visibility_image(renderer: Renderer) -> Image:
    """Visibility image (H, W), 0 (dark) to 1 (lit)."""
    return np.array(renderer.render())[..., 3]


def reference_visibility(scene: mi.Scene, spp: int) -> tuple[Image, npt.NDArray[np.bool_]]:
    """Path-traced visibility (H, W), the ratio of images with and without shadows, and a mask of its valid pixels."""
    from mitsuba_baselines.reference import path_traced
    from mitsuba_baselines.unshadowed import unshadowed

    lit = path_traced(scene, spp=spp).image.mean(-1)
    full = unshadowed(scene, spp=min(spp, 64)).image.mean(-1)
    mask = full > 0.05 * full.max()
    return np.where(mask, np.clip(lit / np.where(mask, full, 1), 0, 1), 0).astype(np.float32), mask


def _step(options: MapsOptions) -> float:
    """Step of a central difference, world units: shadows of its two renderings lie one pixel apart."""
    return 0.5 * 2 * maps_scenes.HALF / options.resolution


def _reference_derivative(name: str, options: MapsOptions) -> Image:
    from mitsuba_baselines.derivatives import central_difference

    build = functools.partial(maps_scenes.build, name, options.resolution)
    return central_difference(build, _step(options), spp=max(1, options.reference_spp)).image


def _positions(scene: mi.Scene) -> Image:
    """Positions (H, W, 3) of the visible surfaces, world space."""
    return np.array(Renderer.from_scene(scene, shadow_method="none", aovs=("position",)).render())[..., 3:6]


def _texel(name: str, p_world: Image, renderer: Renderer, mask: npt.NDArray[np.bool_]) -> Texel:
    """Size of a texel of a renderer's map on the visible surfaces; it depends on the fit of the map to the scene."""
    assert renderer.frusta is not None  # all candidates have maps
    view = directional_view(mi.Vector3f(*maps_scenes.SCENES[name][1]))
    return texel_in_pixels(p_world, view, renderer.frusta, renderer.settings.shadow.resolution, mask)


def _derivative_agreement(name: str, label: str, reference: Image, footprint: float, options: MapsOptions) -> dict[str, float]:
    """Agreement of the forward derivative of the image by the casters' offset with path-traced central differences.

    ``footprint``: width of the filter in image pixels.
    """
    from mitsuba_baselines.derivatives import agreement

    scene = maps_scenes.build(name, options.resolution)
    renderer = _renderer(scene, label, options)
    step = _step(options)
    rates = {}
    low, high = (maps_scenes.SCENES[name][0](sign * step) for sign in (-1, 1))
    for key, (points, _) in high.items():
        rates[key] = (points.astype(np.float64) - low[key][0]).ravel() / (2 * step)
    offset = dr.opaque(mi.Float, 0.0)  # a literal zero would be broadcast at its first product
    dr.enable_grad(offset)
    positions = {
        key: cast(Float, dr.ravel(renderer.data.geometry.shape_positions(key))) + mi.Float(rate.astype(np.float32)) * offset
        for key, rate in rates.items()
    }
    image = renderer.render(positions)
    dr.forward(offset)
    derivative = np.array(dr.grad(image))[..., :3]
    result = agreement(derivative, reference, footprint)
    return {"derivative_cosine": result.cosine, "derivative_scale": result.scale}


def _add_times(entries: dict[str, dict[str, Any]], scene: mi.Scene, options: MapsOptions) -> None:
    """Add the times of map, filter and look-ups: frozen renderings minus one without shadows. All take turns."""

    def contender(settings: dict[str, Any]) -> Contender:
        renderer = Renderer.from_scene(scene, **settings)
        render = freeze(lambda renderer: renderer.render().array)
        return Contender(lambda: dr.eval(render(renderer)), options.rounds)

    calls = {label: contender(_settings(label, options)) for label in entries}
    calls["none"] = contender({"shadow_method": "none"})
    samples = alternate(calls)
    base = statistics.median(samples["none"])
    seconds = {label: statistics.median(samples[label]) - base for label in entries}
    for label, entry in entries.items():
        entry["seconds"] = seconds[label]
        if "plain vsm" in seconds:
            entry["seconds_over_plain_vsm"] = seconds[label] / seconds["plain vsm"]


def tables(record: dict[str, Any]) -> list[Table]:
    """All tables of a record that have rows."""
    found = (poses_table(record), view_run.faults_table(record), view_run.derivatives_table(record))
    return [*([table(record)] if record["scenes"] else []), *(each for each in found if each is not None)]


def table(record: dict[str, Any]) -> Table:
    """Table with a row for each scene and method."""
    columns = ["scene, method", "RMSE", "shade", "bleed", "acne", "shift", "cos", "scale", "time"]
    rows: list[Sequence[str]] = []
    for scene, entries in record["scenes"].items():
        for label, e in entries.items():
            ratio = e.get("seconds_over_plain_vsm")
            rows.append(
                [
                    f"{scene}, {label}",
                    *(view_run.cell(e[key]) for key in ("rmse", "rmse_shadowed", "bleeding", "acne", "contour_shift_texels")),
                    *(view_run.cell(e[key]) for key in ("derivative_cosine", "derivative_scale")),
                    f"{ratio:.2f}x" if ratio is not None else f"{1e3 * e['seconds']:.2f} ms",
                ]
            )
    return io_console.table("Shadow maps against path tracing (shift in texels, time over plain vsm)", columns, rows)


def poses_table(record: dict[str, Any]) -> Table | None:
    """Table of the poses found with each method; None if none were looked for."""
    rows = [
        [label, f"{e['found']} of {e['runs']}", f"{e['median_rotation_deg']:.3f}", f"{e['median_offset_x100']:.3f}"]
        for label, e in record.get("poses", {}).items()
    ]
    columns = ["method", "found", "degrees", "offset x 100"]
    return io_console.table("Poses found with the shadow maps, medians of the errors", columns, rows) if rows else None
