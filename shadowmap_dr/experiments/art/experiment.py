"""Shadow art: an object is deformed until its shadows match one or two images.

Protocol: a sphere of 12,800 triangles (or any mesh) between directional lights and receivers; 400 steps; intersection over union
with the target, of pixels with visibility below one half. Targets with enclosed holes are also compared after filling the holes,
since a sphere has none.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from ...errors import ShadowmapError, did_you_mean
from ...inverse import Collection, RemeshingSculptor, Sculptor, even_sphere, shadow_view
from ...inverse.runs.schedulers import check_threads
from ...inverse.shadow_art import exports, target_images
from ...io import animations, assets, files, meshes, records
from ...io import console as io_console
from ...io import images as io_images
from ...io.machine import header
from ...io.options import option, setting
from ...io.ranges import MAP_SIDE, SEED, STEPS, check_ranges
from ...rendering.receivers.shadow_views import CAMERAS, RECEIVERS, ShadowView
from . import pictures as art_pictures
from .advice import warnings_of
from .run import Frame, Maker, Trace, intersection_over_union, make

#: Light directions of the first and the second view; y is up in both.
DIRECTIONS = ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))
# Size of a target relative to the largest that fits into the visible part of the receiver.
_FILL = {"orthographic": 0.8, "perspective": 0.92}


Array = npt.NDArray[np.float32]


def _suffix(kind: str) -> str | None:
    """Suffix of animated pictures by the kind on the command line."""
    return None if kind == "none" else f".{kind}"


@dataclass(frozen=True)
class ArtOptions:
    """Settings of a piece.

    ``targets`` are image files, names of this package, or ``text:L`` for letters; one for each view. ``animate`` is the suffix of
    the animations (.webp or .gif), None for no animations. For ``receiver`` and ``camera`` see `shadow_view`.

    Raises ShadowmapError for settings that are out of range or contradict each other.
    """

    targets: tuple[str, ...] = option(
        names=("--target",), metavar="NAME|IMAGE", help="Image (PNG, JPEG, SVG, ...) of a shadow; twice for two views."
    )
    stained: str | None = option(
        None, metavar="NAME|IMAGE", help="Picture that the sun throws in colours through a sheet of tinted panes."
    )
    panes: int = option(128, allowed=(1, 512), help="Panes along each side of the picture of --stained.")
    mesh: str | None = option(None, metavar="NAME|FILE", shown="a sphere of 12,800 triangles", help="Mesh to deform.")
    collection: str | None = option(None, metavar="NAME|FILE", help="Mesh whose moved, turned and scaled copies cast the shadow.")
    most: int = option(
        128, names=("--copies",), metavar="N", allowed=(1, 4096), help="Largest number of copies; it doubles every 150 steps."
    )
    receiver: str = option("plane", choices=RECEIVERS, help="Receiver of the shadow.")
    camera: str = option("orthographic", choices=CAMERAS, help="Frontal view, or perspective from the side.")
    iterations: int | None = option(
        None, shown="400; 1100 for a collection; 200 for panes", allowed=STEPS, help="Steps of the optimiser."
    )
    smoothness: float = option(20.0, allowed=(0.0, 1e6), help="Stiffness of the mesh; finer meshes need more.")
    remesh: int | None = option(None, metavar="STEPS", allowed=STEPS, help="Remesh the surface every so many steps.")
    fill_holes: bool = option(False, help="Fill enclosed holes of the targets.")
    resolution: int = option(256, allowed=(16, 2048), help="Pixels along each side of the shadow images.")
    map_resolution: int | None = option(
        None, shown="the resolution", allowed=MAP_SIDE, help="Texels along each side of the shadow maps."
    )
    animate: str | None = option(
        ".webp", metavar="webp|gif|none", shown="webp", parse=_suffix, help="Kind of the animated pictures."
    )
    printable: bool = option(False, help="Also write an STL file, and report on the mesh.")
    out: Path = option(Path("art"), help="Folder for the results.")
    resume: bool = option(False, help="Resume a killed run with the same settings.")
    threads: int = option(0, help="Threads, 0 for one for each core; with one, repeated runs give the same bits.")
    step_size: float = setting(0.2, allowed=(1e-06, 100.0), help="Step size of the `Sculptor`; a `Collection` has its own.")
    consistency: float = setting(0.2, allowed=(0.0, 1e6), help="Weight of normal consistency of the `Sculptor`.")
    interval: int = setting(150, allowed=STEPS, help="Steps between two doublings of the copies, see `Collection`.")
    seed: int = setting(0, allowed=SEED, help="Seed of the collection.")
    picture_size: int = setting(
        320, allowed=(16, 1024), help="Pixels along each side of animations; the still picture has twice as many."
    )
    turns: int = setting(40, allowed=(1, 1000), help="Frames of the turntable.")

    def __post_init__(self) -> None:
        check_ranges(self)
        check_threads(self.threads)
        if self.stained is not None:
            self._check_stained()
        elif not 1 <= len(self.targets) <= len(DIRECTIONS):
            raise ShadowmapError(f"{len(self.targets)} targets: give one, or two for two views.")
        if self.receiver not in RECEIVERS:
            raise ShadowmapError(
                f"no receiver {self.receiver!r}: choose from {', '.join(RECEIVERS)}.{did_you_mean(self.receiver, RECEIVERS)}"
            )
        if self.camera not in CAMERAS:
            raise ShadowmapError(
                f"no camera {self.camera!r}: choose from {', '.join(CAMERAS)}.{did_you_mean(self.camera, CAMERAS)}"
            )
        if self.mesh is not None and self.collection is not None:
            raise ShadowmapError("a mesh to deform and a collection: choose one of the two.")
        if self.remesh is not None and self.collection is not None:
            raise ShadowmapError("the copies of a collection are not deformed, and cannot be remeshed: leave one of the two out.")
        default = 200 if self.stained is not None else 400 if self.collection is None else 1100
        steps = default if self.iterations is None else self.iterations
        object.__setattr__(self, "iterations", steps)
        if self.animate is not None and self.animate not in animations.SUFFIXES:
            raise ShadowmapError(f"no animation {self.animate!r}: choose from {', '.join(animations.SUFFIXES)}.")

    def _check_stained(self) -> None:
        """ShadowmapError for settings of objects that are deformed, beside a sheet of panes."""
        of_objects = {
            "--target": self.targets, "--mesh": self.mesh, "--collection": self.collection, "--remesh": self.remesh,
            "--fill-holes": self.fill_holes, "--printable": self.printable,
            "--receiver": self.receiver != "plane", "--camera": self.camera != "orthographic",
        }  # fmt: skip
        given = [name for name, value in of_objects.items() if value]
        if given:
            raise ShadowmapError(f"a sheet of panes has no {given[0]}: leave it out, or --stained.")


def read_target(target: str) -> Array:
    """Read the figure (H, W) of a target of `ArtOptions`."""
    if target.startswith("text:"):
        return target_images.text_figure(target.removeprefix("text:"))
    return target_images.read_figure(assets.target(target))


def views_of(options: ArtOptions) -> tuple[ShadowView, ...]:
    """A view for each target."""
    return tuple(
        shadow_view(direction, size=options.resolution, receiver=options.receiver, camera=options.camera)
        for direction in DIRECTIONS[: len(options.targets)]
    )


def place(figure_list: list[Array], views: tuple[ShadowView, ...]) -> list[Array]:
    """Target images, as large as possible but of equal height in all views, which share the vertical axis."""
    fill = _FILL[views[0].camera]
    if len(views) == 1:
        return [target_images.fit(figure_list[0], views[0].seen, fill)]
    heights = [target_images.figure_height(figure, view.seen, fill) for figure, view in zip(figure_list, views, strict=True)]
    return [target_images.fit(figure, view.seen, high=min(heights)) for figure, view in zip(figure_list, views, strict=True)]


def build(options: ArtOptions) -> Maker:
    """Make the optimiser of a piece."""
    views = views_of(options)
    read = [read_target(target) for target in options.targets]
    targets = place([target_images.filled(figure) for figure in read] if options.fill_holes else read, views)
    texels = options.resolution if options.map_resolution is None else options.map_resolution
    if options.collection is not None:
        mesh = meshes.read_mesh(assets.mesh(options.collection))
        return Collection(
            *mesh, views, targets, interval=options.interval, most=options.most, seed=options.seed, map_resolution=texels,
            settings={"collection": _name(options.collection)},
        )  # fmt: skip
    mesh = even_sphere() if options.mesh is None else meshes.read_mesh(assets.mesh(options.mesh))
    arguments: dict[str, Any] = {
        "step_size": options.step_size, "smoothness": options.smoothness, "consistency": options.consistency,
        "map_resolution": texels, "settings": {"mesh": "sphere" if options.mesh is None else _name(options.mesh)},
    }  # fmt: skip
    if options.remesh is not None:
        return RemeshingSculptor(*mesh, views, targets, interval=options.remesh, **arguments)
    return Sculptor(*mesh, views, targets, **arguments)


def run_art(options: ArtOptions, *, console: Console | None = None) -> dict[str, Any]:
    """Make one piece, write all files into ``options.out``, and return the record of `art.json`."""
    assert options.iterations is not None  # `ArtOptions` replaces None
    steps = options.iterations
    if options.threads:
        dr.set_thread_count(options.threads)
    console = console or io_console.notes()
    path = files.check_output(options.out / "art.json", (".json",))
    checkpoint = options.out / "checkpoint.npz"
    if not options.resume:
        checkpoint.unlink(missing_ok=True)
    maker = build(options)
    for k in range(len(maker.views)):  # before the long part: what was understood of the pictures
        io_images.write_png(options.out / f"target-{k + 1}.png", maker.target(k))
    settings = {"targets": [_name(target) for target in options.targets], "iterations": steps, **maker.describe()}
    with io_console.progress(console) as progress:
        task = progress.add_task("steps", total=steps, note="kernels are compiled")
        trace = make(
            maker, steps, checkpoint=checkpoint, fingerprint=_fingerprint(settings, maker),
            on_step=lambda done, note: progress.update(task, completed=done, note=note),
        )  # fmt: skip
        record = records.plain({**header(settings), **_results(maker, trace)})
        written = _write(options, maker, trace, progress)
    record["files"] = written
    targets = [np.asarray(maker.target(k), np.float32) for k in range(len(maker.views))]
    record["warnings"] = warnings_of(record, targets, fill_holes=options.fill_holes)
    records.write_json(path, record)
    checkpoint.unlink(missing_ok=True)
    return record


def _name(target: str) -> str:
    return target if target.startswith("text:") else Path(target).name


def _fingerprint(settings: dict[str, Any], maker: Maker) -> str:
    images = [float(np.square(maker.target(k) - 0.3).sum(dtype=np.float64)) for k in range(len(maker.views))]
    return json.dumps([records.plain(settings), images], sort_keys=True)


def _results(maker: Maker, trace: Trace) -> dict[str, Any]:
    views = []
    for k, (view, image) in enumerate(zip(maker.views, maker.visibility(), strict=True)):
        target = maker.target(k)
        whole = 1 - target_images.filled(1 - target)
        holes = np.count_nonzero((whole < 0.5) & (target > 0.5)) / max(int(np.count_nonzero(whole < 0.5)), 1)
        views.append({
            "iou": intersection_over_union(image, target, view.seen),
            "iou_filled": intersection_over_union(image, whole, view.seen),
            "holes": holes,
            "mean_square": float(np.square(image - target)[view.seen].mean()),
        })  # fmt: skip
    return {
        "views": views,
        "mesh": exports.mesh_report(maker.vertices(), maker.faces),
        "seconds_per_iteration": trace.seconds_per_iteration,
        "seconds": float(sum(trace.seconds)),
        "iou_curve": {"step": [step for step, _ in trace.looks], "iou": [values for _, values in trace.looks]},
        "loss_curve": trace.loss[::10],
    }


def _write(options: ArtOptions, maker: Maker, trace: Trace, progress: Progress) -> list[str]:
    """Write all files except the record. Returns their names."""
    out, last = options.out, Frame(trace.iterations, maker.vertices(), maker.faces)
    images = maker.visibility()
    exports.write_meshes(out, last.vertices, last.faces, maker.views, images)
    names = ["mesh.ply", "mesh.obj", "mesh.glb"]
    for k, image in enumerate(images):
        target = maker.target(k)
        for kind, picture in (("shadow", image), ("target", target), ("error", exports.error_picture(image, target))):
            names.append(f"{kind}-{k + 1}.png")
            io_images.write_png(out / names[-1], picture)
    if options.printable:
        exports.write_printable(out / "mesh.stl", last.vertices, last.faces)
        names.append("mesh.stl")
    size = options.picture_size
    names.append("picture.png")
    art_pictures.write_picture(out / names[-1], art_pictures.Stage(last.vertices, last.faces, maker.views, 2 * size).picture())
    if options.animate is not None:
        task = progress.add_task("pictures", total=options.turns + len(trace.frames), note="")
        pictures = art_pictures.turntable(last, maker.views, size, options.turns, lambda: progress.advance(task))
        names.append("turntable" + options.animate)
        animations.write_animation(out / names[-1], pictures)
        pictures = art_pictures.history(trace.frames, maker.views, size, lambda: progress.advance(task))
        names.append("steps" + options.animate)
        animations.write_animation(out / names[-1], pictures, last_ms=art_pictures.LAST_MS)
    return names


def table(record: dict[str, Any]) -> Table:
    """Table for the terminal, a row for each view."""
    rows = []
    for name, view in zip(record["settings"]["targets"], record["views"], strict=True):
        whole = f"{view['iou_filled']:.4f}" if view["holes"] > 0 else "the same"
        rows.append([name, f"{view['iou']:.4f}", whole, f"{100 * view['holes']:.1f} %"])
    return io_console.table(
        "Shadows and targets: intersection over union", ["target", "IoU", "target without holes", "holes"], rows
    )


def summary(record: dict[str, Any]) -> str:
    """Mesh and times, in one line."""
    mesh, settings = record["mesh"], record["settings"]
    closed = "watertight" if mesh["watertight"] else "not watertight"
    return (
        f"{mesh['faces']} triangles, {closed}, {100 * mesh['inverted_triangles']:.2f} % inverted; "
        f"{settings['iterations']} steps in {record['seconds']:.1f} s ({1000 * record['seconds_per_iteration']:.1f} ms each)"
    )
