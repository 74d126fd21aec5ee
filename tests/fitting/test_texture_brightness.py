"""Textures in pictures of unknown exposure: a bright texture in a dark exposure looks almost like a dark one in a bright one."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import OPTIONS, box, camera, floor, scene_of

from shadowmap_dr import Renderer
from shadowmap_dr.fitting import fit, prepared

EXPOSURE = 1.4


def textured(values: np.ndarray) -> Renderer:
    """A floor with a texture, most of the picture, below a box whose colour is known."""
    bitmap = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(values.astype(np.float32)),
        "raw": True,
        "filter_type": "nearest",
        "format": "variant",
    }
    bsdf = {"type": "diffuse", "reflectance": bitmap}
    seen = camera(film={"type": "hdrfilm", "width": 48, "height": 36, "rfilter": {"type": "box"}})
    return Renderer.from_scene(scene_of(floor={**floor(), "bsdf": bsdf}, box=box(0.2), camera=seen), **OPTIONS)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    mi.set_variant("llvm_ad_rgb")
    return np.random.default_rng(1).uniform(0.35, 0.75, (4, 4, 3))


@pytest.fixture(scope="module")
def picture(truth: np.ndarray) -> np.ndarray:
    image = textured(truth).render(spp=16)
    return np.minimum(EXPOSURE * np.array(image, np.float32).reshape(36, 48, 3), 0.999)


def test_texture_and_exposure_are_found_together(truth: np.ndarray, picture: np.ndarray) -> None:
    """In a third of the usual steps: without a step of both, the exposure is one per cent off then."""
    start = textured(np.full((4, 4, 3), 0.5))
    result = fit(start, picture, "floor:texture", exposure=True, resolution=48, correct=False, steps=60)
    texture, exposure = result.estimates
    assert 2 ** exposure.values[0] == pytest.approx(EXPOSURE, rel=0.003)
    inside = np.abs(texture.arrays["texture"] - truth) < 0.02
    assert inside.mean() > 0.8  # three of sixteen texels are behind the box, or beyond the picture
    assert result.names[0] == "floor:texture"
    assert np.isfinite(exposure.half_width[0])


def test_derivatives_by_the_brightness_are_those_of_differences(truth: np.ndarray, picture: np.ndarray) -> None:
    made = prepared(textured(truth), picture, "floor:texture", exposure=True, resolution=48, correct=False)
    view = made.stages[-1].objective.views[0]
    assert view.count == 1
    step = 0.01
    _, derivative = view.derivative(np.zeros(1), 0)
    derivative = derivative.copy()
    ahead, behind = (view.image(np.array([sign * step])).copy() for sign in (1, -1))
    np.testing.assert_allclose(derivative, (ahead - behind) / (2 * step), atol=2e-3)
    assert np.abs(derivative).max() > 0.1
