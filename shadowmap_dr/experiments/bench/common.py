"""Parts of the benchmark that its sections share: options, sizes, and the units of measurement."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError, did_you_mean
from ...io.options import option, setting

SECTIONS = ("steps", "raster", "scaling", "breakdown", "sums", "loops", "first", "plug-in", "torch", "fits")


@dataclass(frozen=True)
class Sizes:
    """Sizes and counts of measurements.

    Attributes:
        resolutions: of steps, times to pose and breakdowns.
        rounds: measured steps of each of our contenders; `mitsuba_rounds` those of Mitsuba's.
        default_steps: steps of Mitsuba's default setting for each resolution.
        starts, iterations: of the times to pose.
        path_traced: reference images are path-traced; False: rendered with this library, which is faster.
        meshes, raster_resolutions: of rasterization alone, see `common.meshes.make`.
        worst: worst cases -> the well-behaved mesh to compare each with; see `common.meshes`.
        full_raster: mesh and resolutions for the forward and backward pass through the raster functions.
        call_seconds: a rasterization that is predicted to take longer than this is left out.
        series: quantity -> values; see `bench.scaling`.
        light_resolutions: image sizes, beside that of the series, at which numbers of lights are compared.
        passes: runs through each series.
        large: mesh and resolution of the largest step.
        batch, batch_resolution: number and size of small images.
        sums: (pixels along each side, samples per pixel) over which derivatives are summed; see `bench.sums`.
        loop_size: pixels along each side of images in the loops of `bench.loops`.
        loop_steps: steps over which their memory is measured, 0 for none.
        crowds: scenes of many shapes; see `bench.first.Crowd`.
        cold: scenes of the first derivatives with no kernels on disk; see `bench.first`. `cold_rounds`: processes of each.
        plugin_kinds, plugin_resolutions: kinds of parameters, and sizes of images; see `bench.plugin`.
        plugin_samples, plugin_lights: samples per pixel, at each size; (number, "suns" or "points") at the first.
        torch_resolutions: sizes of images of steps through PyTorch.
        fits: problems for the command `fit`; None: all that are scored. `fit_starts`: starts of each.
    """

    resolutions: tuple[int, ...] = (128, 512, 1024)
    rounds: int = 50
    mitsuba_rounds: int = 10
    default_steps: Mapping[int, int] = field(default_factory=lambda: {128: 5, 512: 3, 1024: 2})
    starts: int = 10
    iterations: int = 150
    path_traced: bool = True
    meshes: tuple[str, ...] = ("teapot-1k", "spot-6k", "torus-48k", "spot-94k", "spot-375k", "spot-1.5M")
    raster_resolutions: tuple[int, ...] = (128, 512, 1024, 2048)
    worst: Mapping[str, str] = field(default_factory=lambda: {"slivers-100k": "even-100k", "screen-filling-10k": "spot-6k"})
    full_raster: tuple[str, tuple[int, ...]] = ("spot-6k", (128, 512, 1024))
    call_seconds: float = 20.0
    series: Mapping[str, tuple[Any, ...]] = field(
        default_factory=lambda: {
            "triangles": ("teapot-1k", "spot-6k", "spot-23k", "spot-94k", "spot-375k", "spot-1.5M"),
            "resolution": (64, 128, 256, 512, 1024, 2048),
            "map_resolution": (64, 128, 256, 512, 1024, 2048),
            "filter_size": (3, 5, 9, 17, 33),
            "lights": (1, 2, 4, 8),
        }
    )
    light_resolutions: tuple[int, ...] = (512, 1024)
    passes: int = 2
    large: tuple[str, int] | None = ("spot-1.5M", 1024)
    batch: tuple[int, ...] = (1, 4, 8, 16, 32)
    batch_resolution: int = 64
    sums: tuple[tuple[int, int], ...] = ((1024, 16), (4096, 1))
    loop_size: int = 128
    loop_steps: int = 1000
    crowds: tuple[Mapping[str, Any], ...] = (
        {"instances": 30, "groups": 6},
        {"instances": 60, "groups": 12},
        {"instances": 1000, "groups": 50},
        {"shapes": 200, "kinds": ("sphere",)},
        {"shapes": 400, "kinds": ("sphere",)},
        {"shapes": 5000},
        {"shapes": 200, "lights": 40},
    )
    cold: tuple[str, ...] = ("pose", "pavilion")
    cold_rounds: int = 5
    plugin_kinds: tuple[str, ...] = ("vertices", "to_world", "light", "camera", "colour of the light", "reflectance", "texture")
    plugin_resolutions: tuple[int, ...] = (128, 512)
    plugin_samples: tuple[int, ...] = (4, 16)
    plugin_lights: tuple[tuple[int, str], ...] = ((8, "suns"), (64, "points"))
    torch_resolutions: tuple[int, ...] = (128, 512)
    fits: tuple[str, ...] | None = None
    fit_starts: int = 4


FULL = Sizes()
QUICK = Sizes(
    resolutions=(128,),
    rounds=15,
    mitsuba_rounds=3,
    default_steps={128: 1},
    starts=2,
    path_traced=False,
    meshes=("teapot-1k", "spot-6k", "torus-48k"),
    raster_resolutions=(128, 512),
    worst={},
    full_raster=("spot-6k", (128, 512)),
    call_seconds=2.0,
    series={
        "triangles": ("teapot-1k", "spot-6k", "spot-23k"),
        "resolution": (64, 128, 256),
        "map_resolution": (128, 256, 512),
        "filter_size": (3, 9),
        "lights": (1, 8),
    },
    light_resolutions=(),
    passes=1,
    large=None,
    batch=(1, 8),
    sums=((512, 4),),
    loop_size=64,
    loop_steps=0,
    crowds=({"instances": 30, "groups": 6}, {"shapes": 50, "lights": 6}),
    cold=("pose",),
    cold_rounds=1,
    plugin_kinds=("vertices", "reflectance"),
    plugin_resolutions=(128,),
    plugin_samples=(4,),
    plugin_lights=((8, "suns"),),
    torch_resolutions=(128,),
    fits=("bunny-pose", "house-pose-sun", "teapot-colours", "spot-aim", "panel-place", "camera-pose"),
    fit_starts=1,
)


@dataclass(frozen=True)
class BenchOptions:
    """Options of a run.

    Results in ``out`` of sections that ``only`` does not name are kept. Files that the benchmark works with lie beside it.
    """

    quick: bool = option(False, help="Small sizes and few steps: minutes instead of hours.")
    out: Path = option(Path("bench.json"), help="JSON file to write; a plot is written beside it.")
    only: tuple[str, ...] = option(SECTIONS, choices=SECTIONS, shown="all", help="Section to measure; repeatable.")
    resume: bool = option(False, help="Keep the measurements of a killed run with the same options.")
    mitsuba_seconds: float = option(
        900.0, help="Time limit of each part that runs Mitsuba's integrator; the record names parts that it cut off."
    )
    meshes: Path | None = option(None, metavar="FOLDER", help="Folder of meshes, for further problems of the section fits.")
    sizes: Sizes | None = setting(None, help="Sizes of the measurements; None: those for `quick`.")

    def __post_init__(self) -> None:
        for name in self.only:
            if name not in SECTIONS:
                raise ShadowmapError(f"no section {name!r}: choose from {', '.join(SECTIONS)}.{did_you_mean(name, SECTIONS)}")
        if not self.only:
            raise ShadowmapError(f"no section given: choose from {', '.join(SECTIONS)}.")
        if self.meshes is not None and not self.meshes.is_dir():
            raise ShadowmapError(f"--meshes {self.meshes}: there is no such folder.")
        if not 0 < self.mitsuba_seconds < float("inf"):
            raise ShadowmapError(f"--mitsuba-seconds {self.mitsuba_seconds}: give a positive number of seconds.")

    @property
    def what(self) -> Sizes:
        """The sizes in force."""
        return self.sizes or (QUICK if self.quick else FULL)

    @property
    def work(self) -> Path:
        """Folder of meshes and reference images, which stay for the next run."""
        return self.out.parent / f"{self.out.stem}-files"


#: Callback for progress: number of finished parts, total, note.
Update = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Unit:
    """A part of a section, measured in one go and stored when complete.

    `run` gets the results of the section's complete units so far, and an `Update`. It returns a JSON value.
    """

    name: str
    run: Callable[[Mapping[str, Any], Update], dict[str, Any]]


def run_child(function: str, arguments: Mapping[str, Any], seconds: float) -> dict[str, Any]:
    """Call a function in a process of its own: its memory is measured alone, and a crash ends nothing else.

    Args:
        function: `module:name` within `shadowmap_dr.experiments`; it takes the arguments and `emit`, which stores a
            preliminary result, and returns a dictionary.
        arguments: JSON values.
        seconds: after this time the process is ended.

    Returns:
        The result. If the process failed: the last preliminary result with the entry `failed`, the reason in one line.
    """
    package = str(Path(__file__).resolve().parents[3])
    paths = filter(None, (package, os.environ.get("PYTHONPATH")))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    task = {"function": function, "arguments": arguments, "variant": mi.variant(), "threads": dr.thread_count()}
    command = [sys.executable, "-m", "shadowmap_dr.experiments.bench.child"]
    try:
        process = subprocess.run(
            command, input=json.dumps(task).encode(), capture_output=True, env=environment, timeout=seconds, check=False
        )
        output, failure = process.stdout, None
        if process.returncode:
            lines = process.stderr.decode(errors="replace").strip().splitlines()
            failure = f"status {process.returncode}: {lines[-1] if lines else 'no message'}"
    except subprocess.TimeoutExpired as error:
        output, failure = error.stdout or b"", f"ended after {seconds:.0f} s"
    results = [line for line in output.decode(errors="replace").splitlines() if line.startswith("{") and line.endswith("}")]
    result: dict[str, Any] = json.loads(results[-1]) if results else {}
    return result if failure is None else {**result, "failed": failure}
