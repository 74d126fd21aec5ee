"""Comparison of shadow maps on views under the sun: contacts and cities, against path tracing."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.table import Table

from ...errors import ShadowmapError
from ...io import console as io_console
from ...rendering.renderer import Renderer
from ...rendering.settings import RenderSettings
from ...scene.load import load
from ...shadow import Frusta, directional_view
from .city_views import city_views, file_views
from .contacts import CONTACTS
from .metrics import Image, texel_in_pixels
from .view import View, seen_by
from .view_metrics import Truth, detachment, view_metrics

#: Words for scenes that are views under the sun.
VIEWS = (*CONTACTS, "city")
#: The file of a real city in its folder.
REAL_CITY = Path("munich/munich.xml")
# Derivatives of path-traced images need more samples: two references of 4 x 64 agree to a cosine of 0.995.
_MORE = 4
#: The first thing that is being done in a view.
FIRST = "reference"


@dataclass(frozen=True)
class ViewOptions:
    """Options of a comparison.

    Attributes:
        settings: options of the `Renderer` by the names of the methods.
        resolution: pixels along each side of an image.
        map_resolution, filter_size: texels along each side of the map, and of its filter, that a derivative's blur follows.
        spp: samples per pixel of the path-traced images.
        city_folder: of a real city, or None.
    """

    settings: Mapping[str, dict[str, Any]]
    resolution: int
    map_resolution: int
    filter_size: int
    spp: int
    city_folder: Path | None = None


def views_of(names: Sequence[str], city_folder: Path | None = None) -> Iterator[View]:
    """Views of the scenes with these names, and of a real city."""
    for name in names:
        if name in CONTACTS:
            yield CONTACTS[name]()
        elif name == "city":
            yield from city_views()
    if city_folder is not None:
        yield from file_views(city_folder / REAL_CITY)


def measure(view: View, options: ViewOptions, note: Callable[[str], None]) -> tuple[dict[str, Any], dict[str, dict[str, Image]]]:
    """Errors of all methods in one view, and rows of pictures; both empty if the view is to be left out.

    ``note`` is told what is being done.
    """
    from mitsuba_baselines.reference import path_traced

    note(FIRST)
    scene = view.scene(options.resolution)
    data = load(scene)
    bare = _image(Renderer.from_data(data, RenderSettings.of(shadow_method="none")))
    traced = path_traced(scene, spp=options.spp).image
    truth = Truth.of(traced, bare)
    if truth.dark.mean() < view.least_dark:
        return {}, {}
    seen = seen_by(view, scene, options.resolution)
    caster = seen.shape == list(view.meshes).index(view.caster) if view.caster else np.zeros_like(truth.dark)
    footprint = _footprint(view, seen.p_world, truth.shone_on, options)
    derivatives = _reference_derivatives(view, options)
    methods: dict[str, Any] = {}
    pictures, errors = {"path traced": traced}, {"visibility": truth.visibility[..., None]}
    for label, settings in options.settings.items():
        note(label)
        renderer = Renderer.from_data(data, RenderSettings.of(**settings))
        image = _image(renderer)
        share = truth.share(image)
        entry: dict[str, Any] = view_metrics(image, truth)
        if view.caster:
            entry["detachment_pixels"] = detachment(share, truth, caster, view.along)
        entry["derivatives"] = _agreements(view, renderer, derivatives, footprint)
        methods[label] = entry
        pictures[label] = image
        error = np.where(truth.shone_on, np.clip(share, 0, 1) - truth.visibility, 0)
        errors[f"difference, {label}"] = error.astype(np.float32)[..., None]
    record = {"dark": float(truth.dark.mean()), "footprint_pixels": footprint, "methods": methods}
    return record, {view.name: pictures, f"{view.name}\nerrors": errors}


def _image(renderer: Renderer) -> Image:
    return np.array(renderer.render())[..., :3]


def _footprint(view: View, p_world: npt.NDArray[np.float32], shone_on: npt.NDArray[np.bool_], options: ViewOptions) -> float:
    """Width in pixels of the filter of one map over all that is seen: the same for all methods, however they divide it."""
    light = directional_view(mi.Vector3f(*view.direction().tolist()))
    seen = shone_on & np.isfinite(p_world).all(-1)
    halves = []
    for axis in (light.right, light.up):
        along = p_world[seen] @ np.array([float(axis[k][0]) for k in range(3)])
        halves.append(0.5 * float(np.ptp(along)))
    zero, one = mi.Float(0), mi.Float(1)
    frusta = Frusta(zero, zero, mi.Float(halves[0]), mi.Float(halves[1]), zero, one, zero, one)
    whole = seen.copy()
    for axis_number in (0, 1):  # differences of neighbours need both of them
        whole &= np.roll(seen, 1, axis_number) & np.roll(seen, -1, axis_number)
    return options.filter_size * texel_in_pixels(p_world, light, frusta, options.map_resolution, whole).longest


def _reference_derivatives(view: View, options: ViewOptions) -> dict[str, Image]:
    """Path-traced central differences (H, W, 3) of all motions that change the image."""
    from mitsuba_baselines.derivatives import central_difference

    found = {}
    for motion in view.motions:
        build = functools.partial(view.scene, options.resolution, motion)
        image = central_difference(build, view.step(motion, options.resolution), spp=_MORE * options.spp).image
        if image.any():
            found[motion] = image
    return found


def _agreements(view: View, renderer: Renderer, references: Mapping[str, Image], footprint: float) -> dict[str, dict[str, float]]:
    """Agreement of derivatives with differences, after the protocol's blur and after one of five pixels."""
    from mitsuba_baselines.derivatives import agreement

    found = {}
    for motion, reference in references.items():
        derivative = view.derivative(renderer, motion)
        wide, narrow = (agreement(derivative, reference, width) for width in (footprint, 0.0))
        found[motion] = {
            "cosine": wide.cosine,
            "scale": wide.scale,
            "cosine_5_pixels": narrow.cosine,
            "scale_5_pixels": narrow.scale,
        }
    return found


def faults_table(record: dict[str, Any]) -> Table | None:
    """Table of the errors in views, with a row for each view and method; None without views."""
    columns = ["view, method", "light", "inside", "dark", "RMSE", "detached", "time"]
    keys = ("light_in_shadow", "light_in_shadow_inside", "dark_in_light", "rmse", "detachment_pixels")
    rows = [
        [f"{name}, {label}", *(cell(entry.get(key)) for key in keys), _time(entry.get("seconds"))]
        for name, view in record.get("views", {}).items()
        for label, entry in view["methods"].items()
    ]
    return (
        io_console.table("Views: light in shadow (inside: away from borders), dark in light, pixels detached", columns, rows)
        if rows
        else None
    )


def derivatives_table(record: dict[str, Any]) -> Table | None:
    """Table of the derivatives in views, with a row for each view and method; None without views."""
    motions = ("sun", "height", "place")
    columns = ["view, method", *(f"{motion}, {letter}" for motion in motions for letter in ("c", "s"))]
    rows = []
    for name, view in record.get("views", {}).items():
        for label, entry in view["methods"].items():
            found = entry["derivatives"]
            if found:
                pairs = [cell(found.get(motion, {}).get(key)) for motion in motions for key in ("cosine", "scale")]
                rows.append([f"{name}, {label}", *pairs])
    return io_console.table("Derivatives in views under the sun: cosine c, scale s", columns, rows) if rows else None


def cell(value: float | None) -> str:
    """A number of a table; records have None where a quantity is not defined, for instance a shift where there is no outline."""
    return "-" if value is None or not np.isfinite(value) else f"{value:.3f}"


def _time(seconds: float | None) -> str:
    return "-" if seconds is None else f"{1e3 * seconds:.1f} ms"


def check_city_folder(folder: Path | None) -> None:
    """Raise ShadowmapError if a folder for a real city has none."""
    if folder is not None and not (folder / REAL_CITY).is_file():
        raise ShadowmapError(f"no city in {str(folder)!r}: give a folder that has {REAL_CITY}.")
