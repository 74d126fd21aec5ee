"""The scenes of the package with leaves, panes and cloth against stored references of `volpath` (`references/make.py`)."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from references import cases

from mitsuba_baselines import reference
from shadowmap_dr.io import assets
from shadowmap_dr.rendering.renderer import Renderer

#: Relative RMSE that a scene may have, over the whole image. Outlines of leaves are narrower than pixels.
BARS = {"leafy_tree": 0.022, "stained_window": 0.01, "curtain": 0.015}


def load(name: str, resolution: int = cases.TRANSLUCENT_RESOLUTION) -> mi.Scene:
    return mi.load_file(str(assets.scene(name)), optimize=False, resolution=resolution)


def stored(name: str) -> np.ndarray:
    return reference.load(cases.FOLDER / f"{name}_volpath.exr").image


def relative_rmse(image: np.ndarray, target: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image - target) ** 2) / np.mean(target**2)))


@pytest.mark.parametrize("name", cases.TRANSLUCENT)
def test_images(variant: str, name: str) -> None:
    image = np.array(Renderer.from_scene(load(name)).render(spp=16))
    error = relative_rmse(image, stored(name))
    assert error <= BARS[name], f"relative RMSE {error:.2%}"


def test_the_reference_is_what_mitsuba_renders(variant: str) -> None:
    again = reference.path_traced(load("stained_window"), spp=64, integrator="volpath", seed=7).image
    assert relative_rmse(again, stored("stained_window")) < 0.04
    assert again.mean() == pytest.approx(stored("stained_window").mean(), rel=2e-3)
