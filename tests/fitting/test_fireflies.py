"""Fireflies: single pixels of linear pictures that are far too bright."""

from __future__ import annotations

import numpy as np
import pytest

from shadowmap_dr.fitting.comparison import Observation
from shadowmap_dr.fitting.fireflies import fireflies
from shadowmap_dr.fitting.gains import Gain
from shadowmap_dr.fitting.targets import make_target


def picture() -> np.ndarray:
    """A dim picture with a lamp and its glint."""
    image = np.random.default_rng(0).uniform(0.05, 0.4, (48, 64, 3)).astype(np.float32)
    image[10:16, 20:28] = 40.0
    image[30, 40] = 8.0
    return image


def test_lamps_and_glints_are_none() -> None:
    assert not fireflies(picture()).any()
    assert not fireflies(np.zeros((8, 8, 3), np.float32)).any()


@pytest.mark.parametrize("places", [[(5, 5)], [(0, 0), (47, 63), (20, 60)], [(30, 10), (30, 11)]])
@pytest.mark.parametrize("value", [1e4, 1e6, 1e30])
def test_fireflies_do_not_count(places: list[tuple[int, int]], value: float) -> None:
    """One of 1e6 was nearly all of the brightness, of which errors are shares: any fit was called found."""
    image = picture()
    rows, columns = np.array(places).T
    image[rows, columns, 1] = value
    found = fireflies(image)
    assert found[rows, columns].all() and found.sum() == len(places)
    clean, target = make_target(picture()), make_target(image)
    assert (target.weight[rows, columns] == 0).all() and target.weight.sum() == clean.weight.sum() - len(places)
    brightness = [Observation(one.image, one.weight, Gain(0, False, 1.0)).brightness for one in (clean, target)]
    assert brightness[1] == pytest.approx(brightness[0], rel=0.01)
    # Beside a mask of the user's.
    mask = np.ones(image.shape[:2])
    mask[:24] = 0
    assert make_target(image, mask).weight[:24].max() == 0 and (make_target(image, mask).weight[rows, columns] == 0).all()
