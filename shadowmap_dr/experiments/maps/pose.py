"""Value of a shadow map for optimisation: the share of poses found from shadows alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...inverse import PoseFit
from ...rendering.renderer import Renderer
from ..pose.methods import BETAS, STEP_SIZE
from ..pose.record import RECOVERED_DEG, RECOVERED_X100
from ..pose.scene import PoseProblem, make_problem, path_traced_reference, pose_errors, start_pose

RESOLUTION, ITERATIONS, OBJECT = 128, 150, "spot"


def shadow_problem(work: Path) -> tuple[PoseProblem, npt.NDArray[np.float32]]:
    """The problem, with Spot's shadow but not Spot in view, and the path-traced image (H, W, 3) of the target pose."""
    problem = make_problem(OBJECT, RESOLUTION, shadow_only=True, work=work)
    return problem, path_traced_reference(problem, work / f"{problem.folder}.exr")


def poses_found(
    problem: PoseProblem,
    reference: npt.NDArray[np.float32],
    settings: Mapping[str, Any],
    runs: int,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Fit the pose from ``runs`` starts (seed 0) with a `Renderer` of these settings; ``advance`` is called after each run.

    Returns the numbers of all and of successful runs, and the median errors of all runs: degrees, 100 x offset.
    """
    renderer = Renderer.from_scene(problem.scene, **settings)
    fit = PoseFit(renderer, "object", problem.p_rest, reference, step_size=STEP_SIZE, betas=BETAS, shift_z=problem.shift_z)
    final = []
    for run in range(runs):
        fit.reset(start_pose(0, run))
        for _ in range(ITERATIONS):
            fit.step()
        final.append(np.array(fit.parameters()))
        advance()
    rotation, translation = pose_errors(final)
    found = (rotation < RECOVERED_DEG) & (translation < RECOVERED_X100)
    return {
        "runs": runs,
        "found": int(found.sum()),
        "median_rotation_deg": float(np.median(rotation)),
        "median_offset_x100": float(np.median(translation)),
    }
