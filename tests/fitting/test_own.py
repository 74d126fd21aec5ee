"""Parametrisations of users, against finite differences and in a fit."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import box, camera, renderer_of, scene_of

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import Own, SceneChange, fit
from shadowmap_dr.fitting.stages import qualities
from shadowmap_dr.fitting.views import View
from shadowmap_dr.jit.types import Float
from shadowmap_dr.scene.sensor import ImageSize

GREY = "floor.bsdf.reflectance.value"


def on_a_circle(numbers: list[Float], change: SceneChange) -> None:
    """The box on a circle about the origin, at an angle; the floor as bright as the angle is far from zero."""
    angle, grey = numbers
    s, c = dr.sincos(angle)
    change.move(["box"], mi.Matrix4f([1, 0, 0, c - 1], [0, 1, 0, s], [0, 0, 1, 0], [0, 0, 0, 1]))
    change.values[GREY] = [grey, grey, grey]


def own(**changes: object) -> Own:
    return Own(**{"name": "circle", "function": on_a_circle, "start": [0.0, 0.5], "spread": [0.8, 0.3], **changes})  # type: ignore[arg-type]


def test_derivatives_are_those_of_differences() -> None:
    mi.set_variant("llvm_ad_rgb")
    renderer = renderer_of(box=box(1))
    view = View(renderer, [own()], [], 0, ImageSize(64, 48), qualities(64, 4, 256)[-1])
    x, image = np.array([0.1, 0.2]), View.image
    for number, step in ((0, 0.02), (1, 0.05)):
        ends = [image(view, x + sign * step * np.eye(2)[number]).astype(np.float64) for sign in (1, -1)]
        expected = ((ends[0] - ends[1]) / (2 * step)).reshape(12, 4, 16, 4, 3).mean((1, 3))
        found = view.derivative(x, number)[1].astype(np.float64).reshape(12, 4, 16, 4, 3).mean((1, 3))
        assert (found * expected).sum() / np.square(expected).sum() == pytest.approx(1, abs=0.1)
        assert (found * expected).sum() / np.sqrt(np.square(found).sum() * np.square(expected).sum()) > 0.97
    np.testing.assert_allclose(np.array(mi.traverse(renderer.data.scene)[GREY]).ravel(), 0.5)


def test_a_parametrisation_is_fitted() -> None:
    mi.set_variant("llvm_ad_rgb")
    angle, film = 0.6, {"width": 48, "height": 36}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4)}
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.4] * 3}}
    true = scene_of(camera=camera(film=film), box=box(np.cos(angle), np.sin(angle)), floor={**floor, "bsdf": grey})
    picture = np.array(mi.render(true, spp=64, integrator=mi.load_dict({"type": "direct"})))[..., :3]
    varied = own(labels=("angle", "grey"), units=("rad", ""), low=-1.0, high=1.0)
    result = fit(renderer_of(camera=camera(film=film), box=box(1)), picture, varied, starts=4)
    (found,) = result.estimates
    assert result.found and found.kind == "own" and found.labels == ("angle", "grey") and found.units == ("rad", "")
    np.testing.assert_allclose(found.values, [angle, 0.4], atol=0.02)
    np.testing.assert_array_equal(found.start, [0, 0.5])


def test_bad_records_are_refused() -> None:
    for changes, words in (
        ({"start": []}, "give finite numbers"),
        ({"start": [np.nan, 0]}, "give finite numbers"),
        ({"spread": 0.0}, "positive ones as spread"),
        ({"labels": ("one",)}, "1 labels for 2 numbers"),
    ):
        with pytest.raises(ShadowmapError, match=words):
            own(**changes)
