"""Fits to pictures with alpha: renderings of objects with nothing behind them, and pictures that were cut out."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import box, camera, diffuse, renderer_of, rgb, scene_of

from shadowmap_dr.fitting import FitResult, fit, make_target
from shadowmap_dr.fitting.sensor_pictures import as_rendered

Image = npt.NDArray[np.float32]
FILM = {"pixel_format": "rgba"}
PLACE = np.array([0.5, 0.4, 0.9])


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Mitsuba renders: both backends have the same objects."""
    mi.set_variant("llvm_ad_rgb")


def rendered(**parts: Any) -> Image:
    """A picture (48, 64, 4) of objects alone."""
    scene = scene_of(**{"floor": None, "camera": camera(64, 48, film=FILM), **parts})
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "volpath", "max_depth": 3}), spp=1024), np.float32)


def found(picture: Image, vary: str, **parts: Any) -> FitResult:
    return fit(scene_of(**{"floor": None, "camera": camera(64, 48), **parts}), picture, [vary], starts=2)


def pane(opacity: float) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at((PLACE * [1, -1, 1]).tolist(), [2, -3, 4], [0, 0, 1]).scale(0.5)
    nested = {"type": "twosided", "nested": diffuse(0.2, 0.3, 0.8)}
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "mask", "opacity": opacity, "nested": nested}}


def test_renderings_of_objects_alone_are_over_black() -> None:
    """Their outlines tell where the object is, as in the picture without alpha."""
    picture = rendered(box=box(0.15))
    both = [found(one, "box:pose", box=box(0)) for one in (picture, np.ascontiguousarray(picture[..., :3]))]
    first, second = (result.estimates[0].values for result in both)
    assert both[0].found
    np.testing.assert_allclose(first, second, atol=1e-3)
    np.testing.assert_allclose(first[3:], [0.15, 0, 0], atol=0.01)
    assert np.abs(first[:3]).max() < 0.5


def test_a_pane_before_nothing() -> None:
    """Its alpha is its opacity."""
    picture = rendered(pane=pane(0.3))
    assert 0.25 < np.median(picture[(picture[..., 3] > 0.01) & (picture[..., 3] < 0.9), 3]) < 0.35
    result = found(picture, "pane.bsdf.opacity", pane=pane(0.6))
    assert result.found
    np.testing.assert_allclose(result.estimates[0].values, 0.3, atol=0.01)


def test_pictures_that_were_cut_out_stay_as_they_are() -> None:
    """The scene has a floor where they are transparent."""
    alone = make_target(rendered())
    assert alone.opaque is not None and 0 < alone.weight.mean() < 0.9
    floored = as_rendered(renderer_of(camera=camera(64, 48)), alone)
    assert floored is alone
    without = as_rendered(renderer_of(camera=camera(64, 48), floor=None), alone)
    assert without is not alone and (without.weight == 1).all()
    # A sky is behind everything, but not in the picture.
    sky = {"type": "constant", "radiance": rgb(0.2)}
    assert as_rendered(renderer_of(camera=camera(64, 48), floor=None, sky=sky), alone) is alone


def test_skies_that_count_as_transparent() -> None:
    """Those of Mitsuba's ``direct``. ``path`` says that they are opaque."""
    sky = {"type": "constant", "radiance": rgb(0.2)}
    scene = scene_of(floor=None, camera=camera(64, 48, film=FILM), sky=sky)
    direct, path = (np.array(mi.render(scene, integrator=mi.load_dict({"type": name}), spp=16)) for name in ("direct", "path"))
    assert direct[0, 0, 3] == 0 and path[0, 0, 3] == 1
    seen = as_rendered(renderer_of(camera=camera(64, 48), floor=None, sky=sky), make_target(direct))
    np.testing.assert_allclose(seen.image, direct[..., :3], rtol=1e-6)
    assert (seen.weight == 1).all()


def test_pictures_of_other_sizes() -> None:
    picture = rendered()
    small = make_target(picture, longer_side=20)
    seen = as_rendered(renderer_of(camera=camera(64, 48), floor=None), small)
    expected = make_target(np.ascontiguousarray(picture[..., :3]), longer_side=20)
    np.testing.assert_allclose(seen.image, expected.image, atol=1e-5)
