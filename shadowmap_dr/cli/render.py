"""The command `shadowmap-dr render`: an image of a scene file."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import mitsuba as mi
import numpy as np
import typer

from .. import __version__
from ..errors import ShadowmapError, did_you_mean, shortened
from ..io import files, images
from ..rendering.film.aovs import AOVS
from ..variants import ANY, DEFAULT_VARIANT, set_variant
from .options import Variant
from .scene_argument import definitions, load, one_line, scene_file

# Mitsuba's plug-ins that make images, and ours.
_INTEGRATORS = ("shadowmap", "scene", "direct", "path", "volpath", "volpathmis", "ptracer", "depth", "direct_projective", "prb")


def render(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Mitsuba XML file, or the name of a scene of this package.")],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="IMAGE", help="Image to write: .exr (all channels) or .png (sRGB).")
    ],
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="Value of the parameter $NAME of the scene; repeatable.")
    ] = None,
    integrator: Annotated[
        str, typer.Option(metavar="NAME", help="Integrator plug-in, or 'scene' for the scene's own.")
    ] = "shadowmap",
    size: Annotated[str | None, typer.Option(metavar="WxH", help="Image size in pixels.")] = None,
    spp: Annotated[
        int | None, typer.Option(metavar="INTEGER", min=1, max=1 << 24, help="Samples per pixel [default: the integrator's].")
    ] = None,
    seed: Annotated[int, typer.Option(metavar="INTEGER", min=0, max=2**32 - 1, help="Seed of the sampler.")] = 0,
    aovs: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help=f"Further channels of an .exr file, separated by commas: {', '.join(AOVS)}; or LABEL:NAME. With other "
            "integrators the pairs of Mitsuba's aov, for instance d:depth,n:sh_normal.",
        ),
    ] = None,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Render a Mitsuba scene."""
    files.check_output(output)
    if aovs is not None and output.suffix.lower() != ".exr":
        raise ShadowmapError(f"--aovs {aovs}: {output.suffix} files hold colours only, choose an .exr file.")
    values = definitions(define or [])
    path = scene_file(scene)
    set_variant(variant, ANY)
    loaded = load(path, values)
    if size is not None:
        loaded = _resized(loaded, *_size(size))
    width, height = loaded.sensors()[0].film().crop_size()
    if width * height == 0:
        raise ShadowmapError(f"the film of {scene} has {width} x {height} pixels: it needs at least one.")

    method = _integrator(loaded, integrator, aovs)
    try:
        image = np.array(mi.render(loaded, integrator=method, spp=spp or 0, seed=seed))
    except RuntimeError as error:
        raise ShadowmapError(f"cannot render {scene}: {one_line(_root(error))}") from error
    names = _channel_names(method, image.shape[2])
    bad = int(np.count_nonzero(~np.isfinite(image[..., : _colours(names)]).all(axis=-1)))
    if bad:
        raise ShadowmapError(f"{scene} renders to {bad} pixels that are not finite: check its parameters for NaN or inf.")

    if output.suffix.lower() == ".png":
        images.write_png(output, image[..., : _colours(names)])
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
        images.write_exr(output, {name: pixels[..., i] for i, name in enumerate(names)}, metadata)
    typer.echo(f"{output}: {width} x {height}, {', '.join(names)}")


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX](\d+)", text)
    if match is None:
        raise ShadowmapError(f"--size {text}: write it as WxH, for instance 512x256.")
    width, height = int(match[1]), int(match[2])
    if not (1 <= width <= 16384 and 1 <= height <= 16384):
        raise ShadowmapError(f"--size {text}: both sides must lie between 1 and 16384 pixels.")
    return width, height


def _resized(scene: mi.Scene, width: int, height: int) -> mi.Scene:
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


def _integrator(scene: mi.Scene, name: str, aovs: str | None) -> mi.Integrator:
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
        if "not found" in str(error):
            near = did_you_mean(name, _INTEGRATORS)
            raise ShadowmapError(f"--integrator {shortened(name)}: there is no such plug-in.{near}") from error
        raise ShadowmapError(f"--integrator {shortened(name)}: {one_line(error)}") from error


def _channel_names(integrator: mi.Integrator, count: int) -> list[str]:
    """OpenEXR names of the channels of an image, colours first."""
    # Mitsuba's `aov` lists the nested image's channels as img.R, img.G, ... although it returns them as colours.
    further = [name for name in integrator.aov_names() if not name.startswith("img.")]
    colours = images.colour_channels(count - len(further))
    return [*colours, *further]


def _colours(names: list[str]) -> int:
    return sum(name in ("R", "G", "B", "Y", "A") for name in names)


def _root(error: BaseException) -> BaseException:
    """First exception of a chain: Dr.Jit wraps the exceptions of integrators."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    return error
