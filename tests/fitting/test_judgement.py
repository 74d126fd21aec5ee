"""Verdicts on edges at their places, elsewhere, blurred, noisy, masked."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from shadowmap_dr.fitting.comparison import Colours, Observation
from shadowmap_dr.fitting.gains import Gain
from shadowmap_dr.fitting.judgement import EXPLAINED, EXPLAINED_CORRECTED, Unexplained, unexplained

SIDE = 128


def disc(x: float, y: float, softness: float = 1.0) -> np.ndarray:
    """A dark disc on bright ground, (SIDE, SIDE, 3)."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    inside = 0.5 - 0.5 * np.tanh((np.hypot(columns - x, rows - y) - 25) / softness)
    return np.repeat((1 - 0.8 * inside)[..., None], 3, 2).astype(np.float32)


def judged(image: np.ndarray, picture: np.ndarray, weight: np.ndarray | None = None, *, moves: bool = True) -> float:
    """The whole share for one number that moves the image sideways, by 20 pixels for a change by one, or that moves nothing."""
    weight = np.ones((SIDE, SIDE), np.float32) if weight is None else weight
    slope = 20 * moves * np.gradient(image, axis=1).reshape(1, -1)
    objective: Any = SimpleNamespace(
        views=[SimpleNamespace(count=1)], comparisons=[Colours(Observation(picture, weight, Gain()))]
    )
    point: Any = SimpleNamespace(columns=lambda: [slope], recorded=[image], residuals=[objective.comparisons[0].residuals(image)])
    return unexplained(point, objective).whole


def test_equal_images_are_explained() -> None:
    assert judged(disc(60, 60), disc(60, 60)) == 0


def test_edges_elsewhere_are_not_explained() -> None:
    assert judged(disc(60, 60), disc(63, 60)) > EXPLAINED
    assert judged(disc(40, 60), disc(95, 60)) == pytest.approx(1, abs=0.15)
    assert judged(np.ones((SIDE, SIDE, 3), np.float32), disc(60, 60)) == pytest.approx(1, abs=0.05)


def test_noise_blur_and_smooth_light_are_no_matter() -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, (SIDE, SIDE, 3)).astype(np.float32)
    ramp = np.linspace(0, 0.2, SIDE, dtype=np.float32)[None, :, None]
    for picture in (disc(60, 60) + noise, disc(60, 60, softness=2), disc(60, 60) + ramp, disc(60.3, 60)):
        assert judged(disc(60, 60), picture) < 0.6 * EXPLAINED


def test_noise_of_single_pixels_hides_no_displacement() -> None:
    """Strong noise, as of few samples: its part is left out, and no more."""
    noise = np.random.default_rng(0).normal(0, 0.1, (SIDE, SIDE, 3)).astype(np.float32)
    assert judged(disc(60, 60), disc(60, 60) + noise) < 0.25 * EXPLAINED_CORRECTED
    clean, noisy = (judged(disc(60, 60), disc(63, 60) + scale * noise) for scale in (0, 1))
    assert noisy == pytest.approx(clean, rel=0.2)
    # A picture of noise alone is explained by nothing.
    assert judged(disc(60, 60), 8 * noise) > EXPLAINED


@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize("background", [0.0, 0.4, 0.65])
def test_backgrounds_without_noise_hide_no_noise(background: float, moves: bool) -> None:
    """A path tracer's sky is constant. Residuals that noise makes here and there are no edges, also where no number moves any."""
    noise = np.random.default_rng(0).normal(0, 0.12, (SIDE, SIDE, 3)).astype(np.float32)
    noise[: round(background * SIDE)] = 0
    row = 64 + background * 32
    right, elsewhere = (judged(disc(60, row), disc(x, row) + noise, moves=moves) for x in (60, 66))
    assert right < EXPLAINED_CORRECTED and elsewhere > 3 * EXPLAINED_CORRECTED


def test_masked_parts_count_for_nothing() -> None:
    """A masked picture is black."""
    weight = np.ones((SIDE, SIDE), np.float32)
    weight[:, 70:] = 0
    picture = disc(60, 60) * weight[..., None]
    assert judged(disc(60, 60), picture) > EXPLAINED
    assert judged(disc(60, 60), picture, weight) == 0
    assert judged(disc(60, 60), np.zeros((SIDE, SIDE, 3), np.float32), 0 * weight) == 0


def test_a_small_object_elsewhere_is_no_small_matter() -> None:
    """A brightness moves all edges of a large picture, of which those of the object are few."""
    rows, columns = np.mgrid[:SIDE, :SIDE]
    ground = (1 + 0.5 * np.sin(columns / 9) * np.sin(rows / 7))[..., None].astype(np.float32)

    def spot(x: float) -> np.ndarray:
        return 0.3 * np.exp(-((columns - x) ** 2 + (rows - 64) ** 2) / 60)[..., None].astype(np.float32)

    image, picture = (np.repeat(ground + spot(x), 3, 2) for x in (60, 72))
    slopes = np.stack([60 * np.repeat(np.gradient(spot(60), axis=1), 3, 2), image]).reshape(2, -1)
    observation = Observation(picture, np.ones((SIDE, SIDE), np.float32), Gain())
    objective: Any = SimpleNamespace(views=[SimpleNamespace(count=2)], comparisons=[Colours(observation)])
    residuals = [objective.comparisons[0].residuals(image)]
    shares = unexplained(SimpleNamespace(columns=lambda: [slopes], recorded=[image], residuals=residuals), objective)  # type: ignore[arg-type]
    assert shares.whole < EXPLAINED_CORRECTED and shares.numbers[1] < EXPLAINED_CORRECTED
    assert shares.largest == shares.numbers[0] > 5 * EXPLAINED_CORRECTED
    assert shares.wrong(EXPLAINED_CORRECTED).tolist() == [True, False]
    assert not shares.is_small(EXPLAINED_CORRECTED)


def test_a_number_may_leave_twice_the_share_of_the_whole() -> None:
    assert Unexplained(0.04, np.array([0.08, 0.0]), np.zeros(2, bool)).is_small(0.04)
    assert not Unexplained(0.04, np.array([0.081]), np.zeros(1, bool)).is_small(0.04)
    assert not Unexplained(0.041, np.zeros(1), np.zeros(1, bool)).is_small(0.04)
