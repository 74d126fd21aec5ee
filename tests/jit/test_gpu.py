"""Workarounds for Dr.Jit's faults on GPUs. Their effects are seen by all tests that run there; these see the causes anywhere."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from renderer_scenes import build

from shadowmap_dr import Renderer
from shadowmap_dr.jit.arrays import backend
from shadowmap_dr.jit.gpu import looked_up
from shadowmap_dr.raster.types import precise_rcp


def test_reciprocals_of_doubles_are_exact(variant: str) -> None:
    x = np.random.default_rng(0).uniform(1, 2, 1000)
    found = precise_rcp(backend(mi.Float(0)).Float64(x)).numpy()
    np.testing.assert_allclose(found, 1 / x, rtol=1e-15)


def test_registers_are_not_spilled_to_shared_memory_in_threads_that_render(variant: str) -> None:
    def flag_after_rendering() -> bool:
        mi.set_variant(variant)
        dr.set_flag(dr.JitFlag.SpillToSharedMemory, True)
        dr.eval(Renderer.from_scene(build(), shadow_map_resolution=16).render())
        return dr.flag(dr.JitFlag.SpillToSharedMemory)

    with ThreadPoolExecutor(1) as pool:
        assert not pool.submit(flag_after_rendering).result()


@pytest.mark.parametrize("active", [True, False])
def test_textures_are_looked_up_under_a_mask(variant: str, active: bool) -> None:
    """Or without one on a GPU; nobody can tell."""
    texture = mi.load_dict({"type": "bitmap", "data": mi.TensorXf(np.full((2, 2, 3), 0.5, np.float32)), "raw": True})
    si = dr.zeros(mi.SurfaceInteraction3f, 3)
    si.uv = mi.Point2f([0.5, np.nan, np.inf], 0.5)
    masks: list[Any] = []

    def look_up(si: Any, mask: Any) -> Any:
        masks.append(mask)
        return texture.eval(si, mask)

    found = looked_up(look_up, si, mi.Bool([active, False, False]))
    np.testing.assert_allclose(found.numpy()[0, 0], 0.5 * active)
    assert dr.all(masks[0]) == (dr.backend_v(mi.Float) == dr.JitBackend.CUDA)
