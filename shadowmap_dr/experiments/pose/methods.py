"""The three methods of pose estimation: ours, ours without shadows, and Mitsuba's."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...inverse import Method, PoseFit
from ...io import assets
from .scene import NormalKind, PoseProblem
from .search import Search

if TYPE_CHECKING:
    from mitsuba_baselines.pose import ProjectiveSetting

METHODS = ("shadows", "rasterizer", "mitsuba")
STEP_SIZE = 0.01
BETAS = (0.9, 0.999)

Image = npt.NDArray[np.float32]
Builder = Callable[[str, PoseProblem, Image], Method]


def usual_normals(file: str) -> NormalKind:
    """The default shading of an object that the user calls ``file``.

    Meshes of this package are shaded smoothly: Mitsuba's integrator then needs a third of the time and finds more poses. Files
    keep flat shading, with which the defaults of their search were measured (`search.choose`).
    """
    return "vertex" if file in assets.mesh_names() else "face"


def usual_methods(shadow_only: bool = False, normals: str = "face") -> tuple[str, ...]:
    """The default methods: Mitsuba's only where it can find a pose."""
    if shadow_only:
        # Mitsuba's integrator hardly ever samples silhouettes of shadows this sharp: the camera must see the object.
        return METHODS[:2]
    from mitsuba_baselines.fair_settings import is_searched

    return METHODS if is_searched(normals) else METHODS[:2]


def build_method(
    name: str,
    problem: PoseProblem,
    reference: Image,
    samples: int = 1,
    setting: ProjectiveSetting | None = None,
    *,
    blur: float = 0.0,
    blur_steps: int = 0,
    tries: int = 1,
    optimiser: str = "adam",
) -> Method:
    """One of the three methods for a problem and its reference image.

    Args:
        samples: samples per pixel of our own methods.
        setting: sample counts of Mitsuba's; None: the result of `fair_setting`.
        blur, blur_steps: see `PoseFit`; of our own methods.
        tries: most descents of a run with our own methods, for its record.
        optimiser: ``adam``, or ``lm`` for Levenberg and Marquardt's method; of our own methods.
    """
    if name == "mitsuba":
        from mitsuba_baselines.fair_settings import fair_setting
        from mitsuba_baselines.pose import MitsubaPose
        from mitsuba_baselines.proxy import calibrate

        setting = setting or fair_setting(problem.resolution, problem.normals)
        return MitsubaPose(
            assets.scene("pose"),
            problem.mesh,
            problem.resolution,
            setting,
            reference,
            step_size=STEP_SIZE,
            betas=BETAS,
            shift_z=problem.shift_z,
            normals=problem.normals,
            proxy=calibrate(problem.scene),
        )
    from ...rendering.renderer import Renderer

    settings = shadow_settings(name)
    renderer = Renderer.from_scene(problem.scene, **settings)
    if samples != 1:
        settings["samples_per_pixel"] = samples
    if blur:
        settings |= {"blur": blur, "blur_steps": blur_steps}
    if tries != 1:
        settings["tries"] = tries
    if optimiser == "lm":
        from .gauss_newton import GaussNewtonPose

        for name in ("blur", "blur_steps"):
            settings.pop(name, None)
        return GaussNewtonPose(renderer, "object", reference, spp=samples, shift_z=problem.shift_z, settings=settings)
    return PoseFit(
        renderer,
        "object",
        problem.p_rest,
        reference,
        step_size=STEP_SIZE,
        betas=BETAS,
        shift_z=problem.shift_z,
        spp=samples,
        blur=blur,
        blur_steps=blur_steps,
        settings=settings,
    )


def searching(search: Search, iterations: int) -> Builder:
    """`build_method` with the settings of a search."""
    return functools.partial(
        build_method,
        samples=search.samples,
        blur=search.blur,
        blur_steps=search.blur_steps(iterations),
        tries=search.tries,
        optimiser=search.optimiser,
    )


def shadow_settings(method: str) -> dict[str, Any]:
    """Options of the `Renderer` that the methods `shadows` and `rasterizer` use."""
    if method == "rasterizer":
        return {"shadow_method": "none"}
    return {"shadow_method": "vsm", "shadow_map_resolution": 256, "shadow_filter": "gaussian", "shadow_filter_size": 3}


def described(method: Method, problem: PoseProblem, iterations: int) -> str:
    """The setting of Mitsuba's method for readers, and an estimate of its seconds; "" for other methods."""
    setting = getattr(method, "setting", None)
    if setting is None:
        return ""
    from mitsuba_baselines.fair_settings import seconds_of_step

    known = seconds_of_step(setting, problem.resolution, problem.normals)
    if known is None:
        return f"{setting_text(method, problem)}; its time is not known, and is estimated after a few steps"
    seconds, threads = known
    return (
        f"{setting_text(method, problem)}; {iterations} steps take about {seconds * iterations:.0f} s, if one takes "
        f"{seconds:.2g} s, as when it was measured with {threads} threads"
    )


def setting_text(method: Method, problem: PoseProblem) -> str:
    """Integrator and samples of Mitsuba's method, and whether a search found them."""
    setting: ProjectiveSetting = getattr(method, "setting")  # noqa: B009
    counts = f"{setting.sppc}/{setting.sppp}/{setting.sppi}"
    guiding = "no guiding" if setting.guiding == "none" else f"guiding {setting.guiding}"
    found = (
        "the cheapest setting with which a search found three of three starts"
        if fairness(method, problem)["fair"]
        else "not shown to converge here"
    )
    return f"direct_projective, sppc/sppp/sppi {counts}, {setting.spp} samples for the loss, {guiding}: {found}"


def fairness(method: Method, problem: PoseProblem) -> dict[str, bool]:
    """For Mitsuba's method: ``fair`` is True if a search found its sample counts to be the cheapest that converge."""
    setting = getattr(method, "setting", None)
    if setting is None:
        return {}
    from mitsuba_baselines.fair_settings import is_fair

    searched = is_fair(setting, problem.resolution, problem.normals, problem.name)
    return {"fair": searched and not problem.shadow_only}
