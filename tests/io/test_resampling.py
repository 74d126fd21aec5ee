"""Area averages, against brute force: pixels repeated until sides divide."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from shadowmap_dr.io import resampling
from shadowmap_dr.io.resampling import area_average

SIZES = [
    ((12, 20), (3, 5)),
    ((7, 11), (3, 4)),
    ((5, 9), (5, 2)),
    ((8, 3), (5, 3)),
    ((6, 4), (9, 10)),
    ((1, 17), (1, 5)),
    ((4, 4), (1, 1)),
]


def brute_force(image: np.ndarray, to: tuple[int, int]) -> np.ndarray:
    for axis, count in enumerate(to):
        length = image.shape[axis]
        common = math.lcm(length, count)
        fine = np.repeat(image.astype(np.float64), common // length, axis=axis)
        parts = (*image.shape[:axis], count, common // count, *image.shape[axis + 1 :])
        image = fine.reshape(parts).mean(axis + 1)
    return image


@pytest.mark.parametrize(("size", "to"), SIZES)
@pytest.mark.parametrize("at_once", [1, 1 << 22])
def test_any_ratio(size: tuple[int, int], to: tuple[int, int], at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(resampling, "_AT_ONCE", at_once)
    image = np.random.default_rng(1).random((*size, 4), np.float32)
    seen: list[int] = []

    def rows(at: slice) -> np.ndarray:
        seen.extend(range(size[0])[at])
        return image[at]

    found = area_average(rows, size, to)
    assert found.dtype == np.float32 and seen == list(range(size[0]))
    np.testing.assert_allclose(found, brute_force(image, to), rtol=1e-6)


def test_as_opencv_averages() -> None:
    image = np.random.default_rng(2).random((90, 120, 3), np.float32)
    np.testing.assert_allclose(
        area_average(lambda at: image[at], (90, 120), (27, 36)),
        cv2.resize(image, (36, 27), interpolation=cv2.INTER_AREA),
        rtol=1e-5,
    )


def test_bright_pixels_do_not_spoil_others() -> None:
    image = np.full((4, 9, 1), 1e-3, np.float32)
    image[:, 0] = 1e30
    np.testing.assert_allclose(area_average(lambda at: image[at], (4, 9), (2, 4))[:, 1:], 1e-3, rtol=1e-6)
