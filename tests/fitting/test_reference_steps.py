"""Last steps of fits, by differences between Mitsuba's own images."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import OPTIONS, box, diffuse, scene_of

from shadowmap_dr import Renderer
from shadowmap_dr.fitting import Fit, prepared
from shadowmap_dr.fitting.levenberg_marquardt import Limits
from shadowmap_dr.fitting.reference_steps import reference_steps

TRUTH = np.array([0.6, 0.36, -0.72]) / np.linalg.norm([0.6, 0.36, -0.72])


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Fits take seconds; that both backends agree is tested for images and derivatives."""
    mi.set_variant("llvm_ad_rgb")


def village(direction: np.ndarray) -> dict[str, Any]:
    """324 houses from the air, each of a few pixels."""
    T, rng, across = mi.ScalarTransform4f, np.random.default_rng(3), 18
    film = {"type": "hdrfilm", "width": 96, "height": 96, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = T().look_at([-60, -60, 90], [0, 0, 0], [0, 0, 1])
    parts: dict[str, Any] = {
        "camera": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "floor": {"type": "rectangle", "to_world": T().scale(200), "bsdf": diffuse(0.5)},
        "sun": {"type": "directional", "direction": direction.tolist(), "irradiance": 3.0},
        "box": None,
    }
    for k in range(across**2):
        x, y = (6 * (np.array(divmod(k, across)) - across / 2) + rng.uniform(-1, 1, 2)).tolist()
        turn, (width, depth, height) = float(rng.uniform(0, 90)), rng.uniform(0.6, 1.6, 3).tolist()
        place = T().translate([x, y, height]).rotate([0, 0, 1], turn).scale([width, depth, height])
        parts[f"house {k}"] = {"type": "cube", "to_world": place}
    return parts


def turned(degrees: float) -> np.ndarray:
    axis = np.cross(TRUTH, [0.3, -0.5, 0.1])
    axis /= np.linalg.norm(axis)
    angle = np.radians(degrees)
    return TRUTH * np.cos(angle) + np.cross(axis, TRUTH) * np.sin(angle)


def test_the_sun_of_small_houses_is_found_to_a_hundredth_of_a_degree() -> None:
    """Shadow maps see houses of a few pixels by one sample of each: 0.1 degrees were left, whatever the picture told."""
    picture = mi.render(scene_of(**village(TRUTH)), spp=256, seed=9)
    result = prepared(scene_of(**village(turned(3))), picture, ["sun:direction"], starts=1, tries=1).run()
    found = result.estimates[0].arrays["direction"].ravel()
    assert result.found
    assert np.degrees(np.arccos(min(1.0, float(found @ TRUTH)))) < 0.03


def box_fit(**options: Any) -> Fit:
    """A box whose picture shows it displaced."""
    place = {**box(0), "to_world": mi.ScalarTransform4f().translate([0.03, 0, 0]) @ box(0)["to_world"]}
    scene = scene_of(box=place)
    picture = np.array(mi.render(scene, spp=2048, seed=5), np.float32)[..., :3]
    return prepared(Renderer.from_scene(scene_of(), **OPTIONS), picture, starts=1, tries=1, **options)


def test_steps_go_to_where_mitsubas_image_is_best() -> None:
    """The derivative is that of Mitsuba's images; bounds hold."""
    search = box_fit(vary=["box:translation:x"])
    objective, corrections = search.stages[-1].objective, search._corrections
    assert corrections is not None
    scale = float(search.parameters[0].scale.factor[0])
    points = list(reference_steps(corrections, objective, np.zeros(1), Limits(np.full(1, -1.0), np.full(1, 1.0))))
    assert [b.cost < a.cost for a, b in zip(points, points[1:], strict=False)] == [True] * (len(points) - 1)
    assert abs(points[-1].x[0] * scale - 0.03) < 0.001
    narrow = Limits(np.zeros(1), np.full(1, 0.01 / scale))
    assert list(reference_steps(corrections, objective, np.zeros(1), narrow))[-1].x[0] * scale == pytest.approx(0.01)


def test_derivatives_are_those_of_mitsubas_images() -> None:
    search = box_fit(vary=["box:translation:x", "floor.bsdf.reflectance"])
    corrections = search._corrections
    assert corrections is not None
    low, high = np.zeros(search.stages[-1].objective.count), np.zeros(search.stages[-1].objective.count)
    low[1], high[1] = -0.1, 0.1
    found = corrections.derivatives([(low, high)], [1])
    assert found is not None and not found[0][0].any()
    # The floor's red value goes from 0 to 1 with the number: from 0.5, light that it reflects grows by twice itself.
    here = corrections._rendered(np.zeros_like(low))
    assert here is not None
    assert found[0][1][-1, 0, 0] == pytest.approx(2 * here[0][-1, 0, 0], rel=0.01)


def test_there_are_no_steps_where_mitsuba_cannot_render(monkeypatch: pytest.MonkeyPatch) -> None:
    search = box_fit(vary=["box:translation:x"])
    objective, corrections = search.stages[-1].objective, search._corrections
    assert corrections is not None
    monkeypatch.setattr(corrections, "_rendered", lambda x, most_passes=None: None)
    assert not list(reference_steps(corrections, objective, np.zeros(1), Limits(np.full(1, -1.0), np.full(1, 1.0))))


@pytest.mark.parametrize(("vary", "taken"), [("box:translation:xy", True), ("box:pose", False)])
def test_few_numbers_have_such_steps(monkeypatch: pytest.MonkeyPatch, vary: str, taken: bool) -> None:
    calls = list[int]()
    monkeypatch.setattr("shadowmap_dr.fitting.search.reference_steps", lambda *_: calls.append(1) or iter(()))
    box_fit(vary=[vary], resolution=16).run()
    assert bool(calls) == taken
