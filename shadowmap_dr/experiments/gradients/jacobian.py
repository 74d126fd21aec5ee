"""Derivative images of shadows, compared with central differences (our own and path-traced) and with Mitsuba's."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
from rich.console import Console

from ...errors import ShadowmapError
from ...io import console as io_console
from ...io import files, plots, records
from ...io.machine import header
from ...io.options import option
from ...io.ranges import FILTER_SIDE, MAP_SIDE, SIDE, check_ranges
from ...rendering.renderer import Renderer
from ..common.meshes import Mesh
from . import report as gradients_report
from . import scenes as gradients_scenes
from .images import (
    CANDIDATES,
    Image,
    blurred_by_map,
    central_derivative,
    check_chosen,
    check_maps,
    forward_derivative,
    image_of,
    reverse_error,
    texel_in_pixels,
)
from .references import Sampling, path_traced_derivative, projective_image
from .scenes import MOTIONS

# Test of tessellation: faces of the coarse occluder, number of subdivisions (each in four, together 64-fold), motion in pixels.
_COARSE_FACES, _DIVISIONS, _TARGET_PIXELS = 2000, 3, 8.0


@dataclass(frozen=True)
class JacobianOptions:
    """Options of a run. Everything is run for each candidate, motion, map size and filter size."""

    motions: tuple[str, ...] = option(
        tuple(MOTIONS), names=("--motion",), choices=MOTIONS, shown="all", help="Motion of the occluder; repeatable."
    )
    candidates: tuple[str, ...] = option(
        ("default",), full=tuple(CANDIDATES), names=("--candidate",), choices=CANDIDATES, help="Kind of shadow map; repeatable."
    )
    map_resolutions: tuple[int, ...] = option(
        (256, 1024),
        full=(128, 256, 512, 1024),
        names=("--map-resolution",),
        allowed=MAP_SIDE,
        help="Texels along each side of the map; repeatable.",
    )
    filter_sizes: tuple[int, ...] = option(
        (1, 3, 5, 9, 15),
        names=("--filter-size",),
        allowed=FILTER_SIDE,
        help="Texels along each side of the filter, 1 for none; repeatable.",
    )
    resolution: int = option(512, allowed=SIDE, help="Image width and height in pixels.")
    faces: int = option(130_000, allowed=(20, 10_000_000), help="Triangles of the occluder, roughly.")
    spp: int = option(128, full=512, allowed=(2, 65536), help="Samples per pixel of the path-traced images.")
    mitsuba_passes: int = option(2, allowed=(0, 10000), help="Passes of Mitsuba's projective integrator, 0 for none.")
    out: Path = option(Path("gradients"), help="Folder for the results.")
    resume: bool = option(False, help="Keep the measurements of a killed run with the same settings.")

    def __post_init__(self) -> None:
        check_ranges(self)
        check_chosen(
            {
                "motion": (self.motions, MOTIONS),
                "candidate": (self.candidates, CANDIDATES),
                "map size": (self.map_resolutions, None),
                "filter size": (self.filter_sizes, None),
            }
        )
        check_maps(self.map_resolutions, self.filter_sizes)
        if self.mitsuba_passes == 1:
            raise ShadowmapError(f"{self.mitsuba_passes} passes of Mitsuba: give 0 for none, or at least 2.")


#: Mappings of entries in the record, and what reports read of entries at least.
PARTS: dict[str, tuple[str, ...]] = {
    **{"references": (), "mitsuba": (), "entries": ("candidate", "motion")},
    "tessellation": ("image_change", "gradient_change"),
}


def run_jacobian(options: JacobianOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Run all; write `jacobian.json`, `jacobian.md`, pictures and a plot into `options.out`. Returns the record."""
    console = console or io_console.notes()
    path = files.check_output(options.out / "jacobian.json", (".json",))
    record = _started(path, options)
    mesh = gradients_scenes.ring(options.faces)
    record["settings"]["faces"] = len(mesh.faces)
    sampling = Sampling(options.resolution, options.spp, options.out / "references", options.resume)
    moving = [name for name in options.motions if not MOTIONS[name].along_light]
    work = [
        (label, name, size, taps)
        for label in options.candidates
        for name in options.motions
        for size in options.map_resolutions
        for taps in options.filter_sizes
        if _key(label, name, size, taps) not in record["entries"]
    ]
    with io_console.progress(console) as progress:

        def track(title: str, items: list[Any]) -> Iterable[Any]:
            task = progress.add_task(title, total=len(items), note="")
            for item in items:
                progress.update(task, note=" ".join(map(str, item)) if isinstance(item, tuple) else str(item))
                yield item
                progress.advance(task)

        traced = {}
        for name in track("path-traced differences", list(options.motions)):
            traced[name], record["references"][name] = path_traced_derivative(mesh, name, sampling)
        mitsuba = {}
        for name in track("Mitsuba, projective", moving if options.mitsuba_passes else []):
            mitsuba[name], record["mitsuba"][name] = projective_image(mesh, name, sampling, options.mitsuba_passes)
            records.write_record(path, record, *PARTS)
        for label, name, size, taps in track("derivative images", work):
            entry = _measure(mesh, label, name, size, taps, traced[name], options)
            record["entries"][_key(label, name, size, taps)] = entry
            records.write_record(path, record, *PARTS)
        for name in track("64-fold tessellation", [name for name in moving if name not in record["tessellation"]]):
            record["tessellation"][name] = _tessellation(name, options)
        records.write_record(path, record, *PARTS)
        pictures = {name: _pictures(mesh, name, traced, mitsuba, options) for name in track("pictures", list(options.motions))}
    labels = {name: f"radiance per {MOTIONS[name].unit}" for name in pictures}
    plots.signed_sheet(options.out / "jacobian.png", pictures, label=labels)
    gradients_report.plot_agreement(options.out / "jacobian-agreement.png", record)
    with files.atomic(options.out / "jacobian.md") as temporary:
        temporary.write_text(gradients_report.read_jacobian(record), encoding="utf-8")
    return record


def _started(path: Path, options: JacobianOptions) -> dict[str, Any]:
    """The stored record if the run is resumed, else a new one."""
    identity = {"resolution": options.resolution, "requested_faces": options.faces, "spp": options.spp}
    empty: dict[str, Any] = {**header(identity), "candidates": CANDIDATES, **{part: {} for part in PARTS}}
    if options.resume and path.exists():
        return records.read_record(path, empty, PARTS)
    return empty


def _key(label: str, motion: str, size: int, taps: int) -> str:
    return f"{label} | {motion} | {size} | {taps}"


def make_renderer(scene: mi.Scene, label: str, size: int, taps: int) -> Renderer:
    """A renderer for a candidate; ``size``: texels along each side of the map, ``taps``: size of the Gaussian, 1 for none."""
    filters: dict[str, Any] = {"shadow_filter": "gaussian" if taps > 1 else "none", "shadow_filter_size": taps}
    return Renderer.from_scene(scene, shadow_map_resolution=size, **filters, **CANDIDATES[label])


def _measure(mesh: Mesh, label: str, name: str, size: int, taps: int, traced: Image, options: JacobianOptions) -> dict[str, Any]:
    """Agreement of one derivative image with all its references."""
    motion, resolution = MOTIONS[name], options.resolution
    renderer = make_renderer(gradients_scenes.build(mesh, resolution), label, size, taps)
    rate = motion.rate(mesh)
    _, derivative = forward_derivative(renderer, rate)
    texel = texel_in_pixels(renderer, resolution)
    entry: dict[str, Any] = {
        "candidate": label,
        "motion": name,
        "map": size,
        "filter": taps,
        "texel_pixels": list(texel),
        "norm": float(np.linalg.norm(derivative)),
        "reverse_error": reverse_error(renderer, rate, derivative),
    }
    if motion.along_light:
        # Relative to a motion across the light of the same speed.
        _, across = forward_derivative(renderer, MOTIONS["x"].rate(mesh))
        return entry | {"relative_norm": entry["norm"] / max(float(np.linalg.norm(across)), 1e-300)}
    footprint = taps * max(texel)
    own = central_derivative(renderer, mesh, motion, motion.step(mesh, resolution))
    blurred = blurred_by_map(traced, renderer)
    return entry | {
        "own": _agreement(derivative, own, footprint),
        "traced": _agreement(derivative, traced, footprint),
        "traced_blurred": _agreement(derivative, blurred, footprint),
        # Agreement of an exact map with a sharp shadow: only its blur counts. No map with this filter comes closer.
        "blur": _agreement(blurred, traced, footprint),
    }


def _agreement(derivative: Image, reference: Image, footprint: float) -> dict[str, float]:
    from mitsuba_baselines.derivatives import agreement

    # A derivative or a reference of zero (no anti-aliasing) agrees with nothing.
    return asdict(agreement(derivative, reference, footprint)) if np.any(reference) else {"cosine": 0.0, "scale": 0.0}


def _tessellation(name: str, options: JacobianOptions) -> dict[str, float]:
    """Relative change of derivative image and gradient when each triangle of a coarse occluder is divided into 64."""
    coarse = gradients_scenes.ring(_COARSE_FACES)
    motion = MOTIONS[name]
    # The gradient is that of the squared difference to the image of the same occluder, moved by several pixels.
    target_mesh = motion.moved(coarse, motion.step(coarse, options.resolution, 2 * _TARGET_PIXELS))
    images, gradients, faces = [], [], []
    for divisions in (0, _DIVISIONS):
        mesh, aim = (gradients_scenes.tessellated(each, divisions) for each in (coarse, target_mesh))
        renderer = make_renderer(gradients_scenes.build(mesh, options.resolution), "default", 256, 3)
        value, derivative = forward_derivative(renderer, motion.rate(mesh))
        target = image_of(renderer, aim)
        images.append(derivative)
        faces.append(len(mesh.faces))
        gradients.append(float(((value - target).astype(np.float64) * derivative).sum()))
    a, b = images
    return {
        "faces": faces[0],
        "divided_faces": faces[1],
        "image_change": float(np.linalg.norm(a - b) / np.linalg.norm(a)),
        "gradient_change": abs(gradients[1] / gradients[0] - 1),
    }


def _pictures(
    mesh: Mesh, name: str, traced: dict[str, Image], mitsuba: dict[str, Image], options: JacobianOptions
) -> dict[str, npt.NDArray[np.floating[Any]]]:
    """Derivative images side by side, (H, W) each: the references, and forward mode for all filters of the first map size."""
    motion, size = MOTIONS[name], options.map_resolutions[0]
    scene = gradients_scenes.build(mesh, options.resolution)
    blank = np.zeros((options.resolution, options.resolution))
    row: dict[str, npt.NDArray[np.floating[Any]]] = {"path-traced differences": traced[name][..., 0]}
    if options.mitsuba_passes:
        row["Mitsuba, area light"] = mitsuba[name][..., 0] if name in mitsuba else blank
    taps = options.filter_sizes[min(1, len(options.filter_sizes) - 1)]
    renderer = make_renderer(scene, options.candidates[0], size, taps)
    row[f"own differences, {taps}"] = central_derivative(renderer, mesh, motion, motion.step(mesh, options.resolution))[..., 0]
    for taps in options.filter_sizes:
        renderer = make_renderer(scene, options.candidates[0], size, taps)
        label = f"filter {taps}" if taps > 1 else "no filter"
        row[label] = forward_derivative(renderer, motion.rate(mesh))[1][..., 0]
    return {title: _middle(image) for title, image in row.items()}


def _middle(image: npt.NDArray[np.floating[Any]]) -> npt.NDArray[np.floating[Any]]:
    """An image without the outer eighth along each side, which no shadow reaches."""
    border = len(image) // 8
    return image[border : len(image) - border, border : len(image) - border]
