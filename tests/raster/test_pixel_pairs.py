"""Lists of pairs of pixels are worked off evenly and completely."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.raster.antialiasing.pixel_pairs import each_number


@pytest.mark.parametrize("lanes", [16, 40, 4096])
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 300, 4095, 4096, 20_001])
def test_each_number_is_visited_once(variant: str, count: int, lanes: int) -> None:
    visits = dr.zeros(mi.UInt32, count + 100)
    each_number(mi.UInt32(count), lanes, lambda number: dr.scatter_add(visits, mi.UInt32(1), number))
    assert visits.numpy().tolist() == [1] * count + [0] * 100


def test_a_short_list_keeps_all_parts_of_the_lanes_busy(variant: str) -> None:
    """Threads get lanes run by run: each quarter of them has about a quarter of the numbers."""
    lanes, count = 4096, 1000
    owner = dr.zeros(mi.UInt32, count)
    each_number(mi.UInt32(count), lanes, lambda number: dr.scatter(owner, dr.arange(mi.UInt32, lanes), number))
    shares = np.bincount(owner.numpy() // (lanes // 4), minlength=4)
    assert shares.min() > 200
