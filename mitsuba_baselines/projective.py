"""Derivative images by Mitsuba's projective integrator, which differentiates shadow boundaries of area lights only."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.jit.arrays import device_array
from shadowmap_dr.scene.mitsuba_meshes import positions_in, set_positions

from .derivatives import agreement
from .reference import Reference


def projective_derivative(
    scene: mi.Scene,
    shape: str,
    rate: npt.ArrayLike,
    *,
    sppi: int,
    passes: int,
    guiding: str = "none",
    seed: int = 0,
    on_pass: Callable[[], None] | None = None,
) -> Reference:
    """Derivative image of a shadow by `direct_projective` in forward mode, as the mean over passes.

    Only silhouettes seen from the light are sampled: visible surfaces must not move, and their shading must not change.

    Args:
        scene: With area lights and a perspective sensor (the integrator refuses orthographic ones).
        shape: Id of the mesh that moves.
        rate: (V, 3) derivative of its vertices by the parameter.
        sppi: Samples per pixel and pass.
        passes: Number of passes, at least 2.
        guiding: "none", "grid" or "octree".
        seed: Seed of the first pass.
        on_pass: Called after each pass.

    Returns:
        (H, W, C) float32 with settings; `halves_cosine` is the agreement of the means of even and odd passes after a blur of 5
        pixels: the effect of noise alone.

    Raises:
        ShadowmapError: There are less than two passes.
    """
    if passes < 2:
        raise ShadowmapError(f"{passes} passes: give at least 2, so that the noise can be measured.")
    params = mi.traverse(scene)
    rest = dr.detach(positions_in(params, shape))
    halves: list[np.ndarray] = [np.zeros(()), np.zeros(())]
    for index in range(passes):
        integrator = mi.load_dict({"type": "direct_projective", "sppc": 0, "sppp": 0, "sppi": sppi, "guiding": guiding})
        moved = mi.Float(rest)
        dr.enable_grad(moved)
        dr.set_grad(moved, device_array(mi.Float, rate))
        set_positions(params, moved, shape)
        params.update()
        image = integrator.render_forward(scene, params, sensor=scene.sensors()[0], seed=seed + index, spp=0)
        halves[index % 2] = halves[index % 2] + np.array(image, np.float64)
        if on_pass is not None:
            on_pass()
    set_positions(params, rest, shape)
    params.update()
    counts = (passes - passes // 2, passes // 2)
    even, odd = (half / count for half, count in zip(halves, counts, strict=True))
    noise = agreement(even, odd).cosine if np.any(odd) else 0.0
    settings = {
        "kind": "projective",
        "sppi": sppi,
        "passes": passes,
        "guiding": guiding,
        "seed": seed,
        "mitsuba": mi.__version__,
        "halves_cosine": noise,
    }
    return Reference(((halves[0] + halves[1]) / passes).astype(np.float32), settings)
