"""The picture at the top of the README: two optimisations on their way to their targets, with the seconds that they took.

    python docs/examples/hero.py [--out docs/hero.png] [--size 320] [--resolution 256]

Above, the pose of the dragon from one path-traced image; below, a sphere that takes the shadow of a hand. Both optimisations run
twice: the first run records the step, the second one is timed and drawn.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mitsuba_baselines.reference import path_traced
from shadowmap_dr import Renderer
from shadowmap_dr.experiments.art.experiment import ArtOptions, build
from shadowmap_dr.experiments.art.pictures import Stage
from shadowmap_dr.experiments.pose.methods import shadow_settings
from shadowmap_dr.experiments.pose.scene import make_problem
from shadowmap_dr.inverse import PoseFit
from shadowmap_dr.io.images import to_srgb

# isort: split
import drjit as dr  # after shadowmap_dr, which chooses the LLVM library
import mitsuba as mi

#: Steps after which an optimisation is drawn.
SHOWN = {"pose": (0, 15, 30, 50, 150), "shape": (0, 10, 30, 80, 400)}
START = (np.radians(-30), 0.25, -0.2)  # rotation, x, y
COLOURS = {"wall.bsdf.reflectance.value": (0.72, 0.7, 0.66), "object.bsdf.reflectance.value": (0.66, 0.28, 0.18)}
_AMBIENT, _FIELD_OF_VIEW = 0.12, 34.0
# Part of the pictures of shadow art that is shown: left, upper, side.
_CROP = (0.2, 0.1, 0.78)
_INK, _PAPER = (40, 40, 40), (255, 255, 255)


def timed(step: Callable[[], Any], draw: Callable[[], Any], shown: Sequence[int]) -> list[tuple[float, Any]]:
    """(seconds, picture) after each of the numbers of steps. Drawing is not timed."""
    seconds, found = 0.0, []
    for count in range(shown[-1] + 1):
        if count in shown:
            found.append((seconds, draw()))
        began = time.perf_counter()
        step()
        dr.sync_thread()
        seconds += time.perf_counter() - began
    return found


def pose_row(folder: Path, size: int, resolution: int) -> tuple[Any, list[tuple[float, Any]]]:
    """Target and pictures of the pose."""

    def scene_of(pixels: int) -> Any:
        problem = make_problem("dragon", pixels, normals="vertex", work=folder)
        parameters = mi.traverse(problem.scene)
        for name, colour in COLOURS.items():
            parameters[name] = mi.Color3f(*colour)
        parameters["camera.x_fov"] = _FIELD_OF_VIEW
        parameters["wall.to_world"] = mi.Transform4f().translate([0, 0, -1.5]).scale(12)
        parameters.update()
        return problem

    problem, large = scene_of(resolution), scene_of(size)

    def fit_of(problem: Any, reference: Any, spp: int, **settings: Any) -> PoseFit:
        renderer = Renderer.from_scene(problem.scene, **settings)
        return PoseFit(renderer, "object", problem.p_rest, reference, spp=spp)

    fit = fit_of(problem, path_traced(problem.scene, spp=512).image, 1, **shadow_settings("shadows"))
    target = np.asarray(path_traced(large.scene, spp=512).image)
    # Shown with a little light from everywhere.
    shown, dark = (fit_of(large, target, 4, shadow_map_resolution=1024, ambient=ambient) for ambient in (_AMBIENT, 0.0))
    target = to_srgb(target + shown.render(np.zeros(3)) - dark.render(np.zeros(3)))

    def run() -> list[tuple[float, Any]]:
        fit.reset(START)
        return timed(fit.step, lambda: to_srgb(shown.render(np.array(fit.parameters()))), SHOWN["pose"])

    run()
    return target, run()


def shape_row(size: int) -> tuple[Any, list[tuple[float, Any]]]:
    """Target and pictures of the sphere that takes the shadow of a hand."""
    target: Any = None

    def run() -> list[tuple[float, Any]]:
        nonlocal target
        maker = build(ArtOptions(targets=("palm",)))
        target = maker.target(0)
        whole = round(size / _CROP[2])
        stage = Stage(maker.vertices(), maker.faces, maker.views, whole)
        x, y = round(_CROP[0] * whole), round(_CROP[1] * whole)
        return timed(maker.step, lambda: stage.picture(maker.vertices())[y : y + size, x : x + size] / 255, SHOWN["shape"])

    run()
    found = run()
    grey = np.repeat(np.asarray(target, np.float32)[..., None], 3, 2)
    return np.asarray(Image.fromarray(np.uint8(255 * (0.45 + 0.48 * grey))).resize((size, size))) / 255, found


def sheet(rows: Sequence[tuple[str, Any, list[tuple[float, Any]]]], size: int) -> np.ndarray:
    """All pictures with captions, (H, W, 3), sRGB."""
    import matplotlib

    font_file = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
    font, gap, line = ImageFont.truetype(str(font_file), size // 16), size // 40, size // 9
    across = 1 + max(len(pictures) for _, _, pictures in rows)
    picture = Image.new("RGB", (across * size + (across - 1) * gap, len(rows) * (size + line)), _PAPER)
    pen = ImageDraw.Draw(picture)
    for j, (title, target, pictures) in enumerate(rows):
        for i, (caption, values) in enumerate([(title, target), *((f"{seconds:.2f} s", each) for seconds, each in pictures)]):
            place = (i * (size + gap), j * (size + line))
            picture.paste(Image.fromarray(np.uint8(np.clip(255 * np.asarray(values) + 0.5, 0, 255))), place)
            pen.text((place[0] + size // 2, place[1] + size + line // 2), caption, _INK, font, anchor="mm")
    return np.asarray(picture) / 255


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/hero.png"))
    parser.add_argument("--size", type=int, default=320, help="pixels along each side of a picture")
    parser.add_argument("--resolution", type=int, default=256, help="pixels along each side of the images that are compared")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            ("target", *pose_row(Path(folder), options.size, options.resolution)),
            ("target", *shape_row(options.size)),
        ]
    Image.fromarray(np.uint8(255 * sheet(rows, options.size) + 0.5)).save(options.out)
    print(f"{options.out}: " + "; ".join(f"{row[2][-1][0]:.2f} s" for row in rows))


if __name__ == "__main__":
    main()
