"""The command line program `shadowmap-dr`."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import sys
from pathlib import Path
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
import typer
from rich.console import Console

from . import __version__, _llvm, assets, cli_art, cli_face, cli_gradients, cli_lights, cli_model, cli_soft, io
from .cli_options import ANY, COLOURED, DEFAULT_VARIANT, Scheduler, SchedulerThreads, Variant, set_variant
from .errors import ShadowmapError, is_interrupt
from .experiments.bench import common as bench_common
from .experiments.bench import experiment as bench_experiment
from .experiments.bench import report as bench_report
from .experiments.maps import experiment as maps_experiment
from .experiments.maps import scenes as maps_scenes
from .experiments.pose import experiment as pose_experiment
from .experiments.pose.methods import usual_methods

app = typer.Typer(
    name="shadowmap-dr",
    help="Differentiable shadow mapping for Mitsuba 3.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.add_typer(cli_gradients.app, name="gradients")
app.add_typer(cli_face.app, name="face")
app.command()(cli_soft.soft)
app.command()(cli_lights.lights)
app.command("lights-times")(cli_lights.lights_times)
app.command()(cli_art.art)
app.command()(cli_model.model)


def main() -> None:
    """Entry point: every expected failure is one line on the standard error stream and a non-zero exit status."""
    try:
        status = typer.main.get_command(app)(standalone_mode=False)
        sys.stdout.flush()  # here, where a failure is still one line
    except ShadowmapError as error:
        _fail(str(error), 1)
    except KeyboardInterrupt:
        _fail("interrupted", 130)
    except BrokenPipeError:  # the reader of our output has gone
        _drop_output()
        sys.exit(1)
    except OSError as error:  # for instance a full disk behind the standard output
        _drop_output()
        _fail(str(error), 1)
    except Exception as error:
        if hasattr(error, "format_message"):  # wrong usage, reported by the option parser
            message = error.format_message()
            _fail(message, 2) if message else sys.exit(2)  # without any argument the help has been shown
        if type(error).__name__ == "Abort" or is_interrupt(error):
            _fail("interrupted", 130)
        raise
    sys.exit(status if isinstance(status, int) else 0)


def _drop_output() -> None:
    """What is still buffered and cannot be written goes nowhere: the interpreter would try again at exit, and complain."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@app.command()
def info() -> None:
    """Show versions, the LLVM library, variants, threads and the GPU."""
    llvm = _llvm.loaded_version()
    gpu = dr.has_backend(dr.JitBackend.CUDA)
    rows = [
        ("shadowmap_dr", __version__),
        ("mitsuba", mi.__version__),
        ("drjit", dr.__version__),
        *((name, _version(name)) for name in ("numpy", "OpenEXR")),
        ("python", platform.python_version()),
        ("LLVM version", ".".join(map(str, llvm)) if llvm else "none"),
        ("LLVM library", str(_llvm.loaded_library() or "none")),
        ("variants", ", ".join(mi.variants())),
        ("threads", str(dr.thread_count())),
        ("GPU", f"CUDA {dr.detail.cuda_version()}" if gpu else "none"),
        ("scenes", ", ".join(assets.scene_names())),
        ("meshes", ", ".join(assets.mesh_names())),
        ("targets", ", ".join(assets.target_names())),
    ]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:<{width}}  {value}")


@app.command()
def render(
    scene: Annotated[str, typer.Argument(help="Mitsuba XML file, or the name of a scene of this package.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Image to write: .exr (all channels) or .png (sRGB).")],
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Value of a $NAME in the scene; repeatable.")
    ] = None,
    integrator: Annotated[str, typer.Option(help="Integrator plug-in, or 'scene' for the scene's own.")] = "shadowmap",
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size in pixels.")] = None,
    spp: Annotated[int | None, typer.Option(min=1, max=1 << 24, help="Samples per pixel [default: the integrator's].")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the sampler.")] = 0,
    aovs: Annotated[
        str | None,
        typer.Option(help="Further channels, separated by commas, as the integrator (or Mitsuba's aov) names them."),
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Render a Mitsuba scene."""
    io.check_output(output)
    if aovs is not None and output.suffix.lower() != ".exr":
        raise ShadowmapError(f"--aovs {aovs}: {output.suffix} files hold colours only, choose an .exr file.")
    values = _definitions(define or [])
    set_variant(variant, ANY)
    loaded = _load(assets.scene(scene), values)
    if size is not None:
        loaded = _resized(loaded, *_size(size))
    width, height = loaded.sensors()[0].film().crop_size()
    if width * height == 0:
        raise ShadowmapError(f"the film of {scene} has {width} x {height} pixels: it needs at least one.")

    method = _integrator(loaded, integrator, aovs)
    try:
        image = np.array(mi.render(loaded, integrator=method, spp=spp or 0, seed=seed))
    except RuntimeError as error:
        raise ShadowmapError(f"cannot render {scene}: {_one_line(_root(error))}") from error
    names = _channel_names(method, image.shape[2])
    bad = int(np.count_nonzero(~np.isfinite(image[..., : _colours(names)]).all(axis=-1)))
    if bad:
        raise ShadowmapError(f"{scene} renders to {bad} pixels that are not finite: check its parameters for NaN or inf.")

    if output.suffix.lower() == ".png":
        io.write_png(output, image[..., : _colours(names)])
    else:
        metadata = {
            "shadowmap_dr:version": __version__,
            "shadowmap_dr:mitsuba": mi.__version__,
            "shadowmap_dr:scene": scene,
            "shadowmap_dr:definitions": ", ".join(f"{k}={v}" for k, v in values.items()),
            "shadowmap_dr:integrator": integrator,
            "shadowmap_dr:spp": "default" if spp is None else str(spp),
            "shadowmap_dr:seed": str(seed),
        }
        pixels = np.asarray(image, dtype=np.float32)
        io.write_exr(output, {name: pixels[..., i] for i, name in enumerate(names)}, metadata)
    typer.echo(f"{output}: {width} x {height}, {', '.join(names)}")


@app.command()
def pose(
    object_: Annotated[
        list[str] | None, typer.Option("--object", metavar="NAME|FILE", help="Mesh of this package, .ply or .obj; repeatable.")
    ] = None,
    resolution: Annotated[list[int] | None, typer.Option(help="Image width and height in pixels; repeatable.")] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            metavar="|".join(pose_experiment.METHODS),
            help="Method; repeatable [default: all; the first two with --shadow-only or --normals vertex].",
        ),
    ] = None,
    runs: Annotated[int, typer.Option(help="Runs with different starts.")] = 1,
    seed: Annotated[int, typer.Option(help="Run r starts from the random numbers of seed + r.")] = 0,
    iterations: Annotated[int, typer.Option(help="Steps of the optimiser.")] = 150,
    reference: Annotated[
        str, typer.Option(metavar="mitsuba|own", help="Reference image: path-traced, or made with this library.")
    ] = "mitsuba",
    shadow_only: Annotated[bool, typer.Option("--shadow-only", help="The camera sees the shadow but not the object.")] = False,
    normals: Annotated[
        str, typer.Option(metavar="face|vertex", help="Shade the object flat, with the normals of its faces, or smoothly.")
    ] = "face",
    samples: Annotated[int, typer.Option(help="Samples per pixel of our own methods.")] = 1,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("pose"),
    resume: Annotated[bool, typer.Option("--resume", help="Keep finished runs, go on with killed ones.")] = False,
    scheduler: Scheduler = "local",
    threads: SchedulerThreads = 0,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Find an object's pose from an image of it and its shadow, with three methods side by side.

    Spot at 128 x 128 pixels unless told otherwise. Writes OUT/pose.json, images and a convergence plot.
    """
    set_variant(variant)
    options = pose_experiment.PoseOptions(
        objects=tuple(object_ or ["spot"]),
        resolutions=tuple(resolution or [128]),
        methods=tuple(method or usual_methods(shadow_only, normals)),
        runs=runs,
        seed=seed,
        iterations=iterations,
        reference=reference,
        shadow_only=shadow_only,
        normals=normals,
        samples=samples,
        out=out,
        resume=resume,
        scheduler=scheduler,
        threads=threads,
    )
    records = pose_experiment.run_pose(options)
    Console().print(pose_experiment.table(records))
    typer.echo(f"Records, images and plots: {out}")


@app.command()
def maps(
    scene: Annotated[
        list[str] | None, typer.Option(metavar="|".join(maps_scenes.SCENES), help="Scene; repeatable [default: all].")
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(metavar="|".join(maps_experiment.CANDIDATES), help="Shadow map; repeatable [default: all]."),
    ] = None,
    resolution: Annotated[int, typer.Option(help="Image width and height in pixels.")] = 512,
    map_resolution: Annotated[int, typer.Option(help="Texels along each side of a shadow map.")] = 256,
    filter_size: Annotated[int, typer.Option(help="Texels along each side of the filter.")] = 3,
    spp: Annotated[int, typer.Option(help="Samples per pixel of the path-traced images.")] = 1024,
    pose_runs: Annotated[int, typer.Option(help="Poses to be found with each shadow map, from shadows alone.")] = 10,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("maps"),
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Compare all shadow maps on scenes that are hard for them, against path tracing.

    Writes OUT/maps.json and a sheet of pictures, OUT/maps.png.
    """
    options = maps_experiment.MapsOptions(
        scenes=tuple(scene or maps_scenes.SCENES),
        candidates=tuple(method or maps_experiment.CANDIDATES),
        resolution=resolution,
        map_resolution=map_resolution,
        filter_size=filter_size,
        reference_spp=spp,
        pose_runs=pose_runs,
        out=out,
    )
    set_variant(variant, COLOURED)
    Console().print(maps_experiment.table(maps_experiment.run_maps(options)))
    typer.echo(f"Record and pictures: {out}")


@app.command()
def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Small sizes and few steps: some minutes instead of hours.")] = False,
    out: Annotated[Path, typer.Option(help="JSON file to write; a plot lies beside it.")] = Path("bench.json"),
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="|".join(bench_common.SECTIONS), help="Section to measure; repeatable [default: all]."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Keep what a killed run with the same options has measured.")] = False,
    mitsuba_seconds: Annotated[
        float, typer.Option(help="Limit for each part that waits for Mitsuba's integrator; what it cuts off is recorded.")
    ] = 900.0,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Measure steps, rasterization, how costs grow, and where the time goes, beside Mitsuba and Embree.

    Writes a JSON file, a plot, and a folder of meshes and reference images. Sections that are not measured stay as they are.
    """
    options = bench_common.BenchOptions(
        quick=quick,
        out=out,
        only=tuple(dict.fromkeys(only or bench_common.SECTIONS)),
        resume=resume,
        mitsuba_seconds=mitsuba_seconds,
    )
    set_variant(variant, COLOURED)
    record = bench_experiment.run_bench(options)
    Console().print(bench_report.table(record))
    typer.echo(f"Record: {out}, plot: {out.with_suffix('.png')}")
    failed = bench_experiment.failures(record, options.only)
    if failed:
        raise ShadowmapError(f"{len(failed)} part(s) could not be measured; the first: {failed[0]}")


def _definitions(entries: list[str]) -> dict[str, str]:
    values = {}
    for entry in entries:
        match = re.fullmatch(r"([A-Za-z_]\w*)=(.*)", entry)
        if match is None:
            raise ShadowmapError(f"-D {entry}: write it as NAME=VALUE, for instance -D resolution=256.")
        name, value = match.groups()
        if name in values:
            raise ShadowmapError(f"-D {entry}: {name} has a value already, {values[name]!r}.")
        if value.strip().lower() in ("nan", "-nan", "inf", "-inf", "+inf", "infinity", "-infinity"):
            raise ShadowmapError(f"-D {entry}: {value} is no finite number.")
        values[name] = value
    return values


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX](\d+)", text)
    if match is None:
        raise ShadowmapError(f"--size {text}: write it as WxH, for instance 512x256.")
    width, height = int(match[1]), int(match[2])
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise ShadowmapError(f"--size {text}: both sides must lie between 1 and 16384 pixels.")
    return width, height


def _load(path: Path, values: dict[str, str]) -> Any:
    try:
        loaded = mi.load_file(str(path), **values)
    except RuntimeError as error:
        raise ShadowmapError(f"cannot load {path}: {_one_line(error)}") from error
    if not isinstance(loaded, mi.Scene):
        raise ShadowmapError(f"cannot load {path}: its root is a {type(loaded).__name__}, not a scene.")
    if not loaded.sensors():
        raise ShadowmapError(f"cannot render {path}: the scene has no sensor.")
    return loaded


def _resized(scene: Any, width: int, height: int) -> Any:
    parameters = mi.traverse(scene)
    names = [name for name in parameters.keys() if re.search(r"(^|\.)film\.size$", name)]  # noqa: SIM118
    if not names:
        raise ShadowmapError("--size: no film of this scene has a size that can be changed.")
    for name in names:
        parameters[name] = [width, height]
        parameters[name.replace("film.size", "film.crop_size")] = [width, height]
        parameters[name.replace("film.size", "film.crop_offset")] = [0, 0]
    parameters.update()
    return scene


def _integrator(scene: Any, name: str, aovs: str | None) -> Any:
    if aovs is not None and name != "shadowmap" and not re.fullmatch(r"[\w.]+:\w+(,[\w.]+:\w+)*", aovs):
        # Mitsuba ends the process on some of these instead of raising an error.
        raise ShadowmapError(f"--aovs {aovs}: the integrator {name} takes NAME:TYPE pairs, for instance d:depth,n:sh_normal.")
    try:
        if name == "scene":
            method = scene.integrator()
            if method is None:
                raise ShadowmapError("--integrator scene: the scene has no integrator of its own.")
            return method if aovs is None else mi.load_dict({"type": "aov", "aovs": aovs, "img": method})
        if aovs is None:
            return mi.load_dict({"type": name})
        if name == "shadowmap":
            return mi.load_dict({"type": name, "aovs": aovs})
        return mi.load_dict({"type": "aov", "aovs": aovs, "img": {"type": name}})
    except RuntimeError as error:
        raise ShadowmapError(f"--integrator {name}: {_one_line(error)}") from error


def _channel_names(integrator: Any, count: int) -> list[str]:
    """OpenEXR names of the channels of an image, colours first."""
    # Mitsuba's `aov` lists the nested image's channels as img.R, img.G, ... although it returns them as colours.
    further = [name for name in integrator.aov_names() if not name.startswith("img.")]
    colours = io.colour_channels(count - len(further))
    return [*colours, *further]


def _colours(names: list[str]) -> int:
    return sum(name in ("R", "G", "B", "Y", "A") for name in names)


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _root(error: BaseException) -> BaseException:
    """The exception that started a chain: Dr.Jit wraps what an integrator raises."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    return error


def _one_line(error: BaseException) -> str:
    """Message of a Mitsuba exception without line breaks and without the position in Mitsuba's own source."""
    text = str(error)
    if "Traceback (most recent call last)" in text:  # raised by a plug-in written in Python: its own message comes last
        return re.sub(r"^[\w.]*(?:Error|Exception): ", "", text.strip().splitlines()[-1])
    return re.sub(r"\[\w+\.(?:cpp|h):\d+\] ?", "", " ".join(text.split()))


def _fail(message: str, status: int) -> None:
    Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print(f"error: {' '.join(message.split())}")
    sys.exit(status)
