"""Corrections of images by Mitsuba's: light that bounces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import OPTIONS, box, camera, diffuse, scene_of

from shadowmap_dr import Renderer
from shadowmap_dr.fitting import FitResult, fit, prepared
from shadowmap_dr.fitting.result import Step
from shadowmap_dr.fitting.state import Run

SIZE = {"width": 64, "height": 48}
MOVED = np.array([0.06, -0.04, 0.0])


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Fits take seconds; that both backends agree is tested for images and derivatives."""
    mi.set_variant("llvm_ad_rgb")


def bouncing(x: float = 0, y: float = 0) -> dict[str, Any]:
    """A box in a bright corner, in which light bounces."""
    T = mi.ScalarTransform4f
    back = {
        "type": "rectangle",
        "to_world": T().translate([0, 0.8, 0]).rotate([1, 0, 0], 90).scale(4),
        "bsdf": diffuse(0.8, 0.4, 0.3),
    }
    place = T().translate([x, y, 0]) @ box(0)["to_world"]
    ground = {"type": "rectangle", "to_world": T().scale(4), "bsdf": diffuse(0.9, 0.8, 0.7)}
    # The file's own integrator.
    path = {"type": "path", "max_depth": 5}
    return {"integrator": path, "camera": camera(film=SIZE), "back": back, "floor": ground, "box": {**box(0), "to_world": place}}


def fitted(correct: bool) -> FitResult:
    truth = scene_of(**bouncing(*MOVED[:2]))
    picture = np.array(mi.render(truth, spp=512, seed=1), np.float32)[..., :3]
    renderer = Renderer.from_scene(scene_of(**bouncing()), **OPTIONS)
    return fit(renderer, picture, ["box:translation"], starts=1, tries=1, correct=correct)


def test_the_place_is_that_of_the_picture_when_images_are_corrected() -> None:
    """Without, shadow maps' images are nearest to the picture elsewhere."""
    results = [fitted(correct) for correct in (True, False)]
    errors = [np.linalg.norm(result.estimates[0].values - MOVED) for result in results]
    assert errors[0] < 0.002
    assert errors[1] > 3 * errors[0]
    # Mitsuba's image is shown.
    assert results[0].pictures[0].error < 0.02
    assert results[1].pictures[0].error > 4 * results[0].pictures[0].error


def test_a_scene_that_mitsuba_cannot_change_is_fitted_without() -> None:
    """Parts of an instance that move by themselves: Mitsuba has one place for all of them."""
    group = {"type": "shapegroup", "one": box(0), "other": box(0.9)}
    parts = {"box": None, "group": group, "copy": {"type": "instance", "shapegroup": {"type": "ref", "id": "group"}}}
    scene = scene_of(camera=camera(film=SIZE), **parts)
    picture = np.array(mi.render(scene, spp=64), np.float32)[..., :3]
    search = prepared(Renderer.from_scene(scene, **OPTIONS), picture, ["copy.one:translation:x"], starts=1)
    result = search.run()
    assert any(words.startswith("Images are not corrected") for words in result.words)


@pytest.mark.parametrize(("share", "step", "count"), [(0.75, 0.5, 21), (0.95, 0.5, 6), (0.95, 4, 12)])
def test_images_are_corrected_as_long_as_it_helps(monkeypatch: pytest.MonkeyPatch, share: float, step: float, count: int) -> None:
    """Steps through a long valley were ended after six corrections, a degree from the pose, and called found.

    Others were ended while each was as long as several intervals, which then were too narrow.
    """
    scene = scene_of(camera=camera(film=SIZE), box=box(0))
    picture = np.array(mi.render(scene, spp=4), np.float32)[..., :3]
    search = prepared(Renderer.from_scene(scene, **OPTIONS), picture, ["box:translation:x"], starts=1)
    losses = [share**k for k in range(20)] + [share**19] * 4
    descents: list[float] = []

    def descend(run: Run, *others: object) -> Iterator[Step]:
        run.x, run.cost = run.x + 0.01, losses[len(descents)]
        descents.append(run.cost)
        yield from ()

    monkeypatch.setattr(search, "_descend", descend)
    monkeypatch.setattr(search, "_is_to_be_corrected", lambda run: True)
    monkeypatch.setattr(search._corrections, "put", lambda x: True)
    monkeypatch.setattr(search, "_share_of_intervals", lambda *given: step)
    list(search._correct(Run(0, np.zeros(1)), last=True))
    assert len(descents) == count


def test_corrections_end_where_steps_are_short_beside_the_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(camera=camera(film=SIZE), box=box(0))
    picture = np.array(mi.render(scene, spp=4), np.float32)[..., :3]
    search = prepared(Renderer.from_scene(scene, **OPTIONS), picture, ["box:translation:x"], starts=1)
    losses, shares = [1, 0.5, 0.2, 0.19, 0.18, 0.17], iter([9, 7, 5, 3, 0.1, 0.1])
    given: list[float] = []

    def descend(run: Run, *others: object) -> Iterator[Step]:
        run.x, run.cost = run.x + 0.01, losses[len(given) - 1]
        yield from ()

    def put(x: np.ndarray[Any, Any]) -> bool:
        given.append(float(x[0]))
        return True

    monkeypatch.setattr(search, "_descend", descend)
    monkeypatch.setattr(search, "_share_of_intervals", lambda step, x: next(shares))
    monkeypatch.setattr(search, "_is_to_be_corrected", lambda run: True)
    monkeypatch.setattr(search._corrections, "put", put)
    monkeypatch.setattr(search._corrections, "keep", lambda x: None)
    list(search._correct(Run(0, np.zeros(1)), last=True))
    # The last one corrects the images of the result.
    np.testing.assert_allclose(given, [0, 0.01, 0.02, 0.03, 0.04, 0.05])


def test_corrections_that_are_kept_are_not_rendered_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of(camera=camera(film=SIZE), box=box(0))
    picture = np.array(mi.render(scene, spp=4), np.float32)[..., :3]
    corrections = prepared(Renderer.from_scene(scene, **OPTIONS), picture, ["box:translation:x"], starts=1)._corrections
    assert corrections is not None and corrections.put(np.zeros(1))
    kept = corrections._objective.corrections[0]
    corrections.keep(np.array([1e-4]))
    monkeypatch.setattr(corrections, "_reference", None)
    assert corrections.put(np.array([1e-4])) and corrections._objective.corrections[0] is kept


def test_effects_on_images_are_without_priors() -> None:
    """Secants are weighed by them: a narrow prior made a number that moves little the only one that counts."""
    effects = []
    for prior in ("", ",prior=0.001"):
        scene = scene_of(camera=camera(film=SIZE), box=box(0))
        picture = np.array(mi.render(scene, spp=4), np.float32)[..., :3]
        search = prepared(
            Renderer.from_scene(scene, **OPTIONS), picture, [f"box:translation:x{prior}", "sun:direction"], starts=1
        )
        corrections = search._corrections
        assert corrections is not None and corrections.put(np.zeros(3))
        effects.append(corrections._effect)
    np.testing.assert_allclose(effects[1], effects[0], rtol=1e-3)
    assert min(effects[0]) > 0
