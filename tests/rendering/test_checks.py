"""Checks of arrays and numbers that users give."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.rendering.receivers.checks import index_array, is_real, is_whole, real_array


def test_numbers_of_all_kinds_become_arrays(variant: str) -> None:
    values: list[Any] = [[1, 2.5], (True, False), np.array([1, 2], np.uint8), mi.Float(1, 2), mi.TensorXf([[1.0, 2.0]])]
    for given in values:
        found = real_array("a", given)
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, np.asarray(given))
    assert np.isinf(real_array("a", 1e300)) and real_array("a", 1e300, np.float64) == 1e300
    assert index_array("b", [[0, 1, 2]], 3).dtype == np.uint32


@pytest.mark.parametrize(
    "given", [None, "x", ["1", "2"], {}, object(), [[1], [2, 3]], np.ones(2, complex), np.array([None, 1.0])]
)
def test_other_values_are_named(given: Any) -> None:
    with pytest.raises(ShadowmapError, match=r"^vertices: .*(must be an array of real numbers|no array of numbers)\.$"):
        real_array("vertices", given)
    with pytest.raises(ShadowmapError, match=r"^faces: .*(must be an array of integers|no array of numbers)\.$"):
        index_array("faces", given, 3)


@pytest.mark.parametrize("given", [[0, 3], [-1], np.array([2**40])])
def test_indices_have_a_range(given: Any) -> None:
    with pytest.raises(ShadowmapError, match="faces: indices from .* to .*, but there are 3 vertices, counted from 0"):
        index_array("faces", given, 3)


def test_kinds_of_numbers() -> None:
    assert is_real(1.5) and is_real(np.float32(2)) and is_whole(np.int64(3)) and is_real(3)
    for value in (None, "1", True, float("nan"), float("inf"), 1j, [1]):
        assert not is_real(value)
    assert not is_whole(1.0) and not is_whole(True)
