"""Lists of pairs of pixels are worked off evenly and completely."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.raster.antialiasing.pixel_pairs import differing_pairs, each_number
from shadowmap_dr.raster.types import RasterOutput


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


@pytest.mark.parametrize(
    ("batch", "height", "width"), [(1, 1, 1), (1, 40, 30), (1, 128, 128), (1, 129, 127), (3, 90, 111), (1, 517, 300)]
)
@pytest.mark.parametrize("triangles", [1, 2, 5000])
def test_all_pairs_that_differ_are_listed_once(variant: str, batch: int, height: int, width: int, triangles: int) -> None:
    """Small and large images, of one block of pixels and of several, some of which have no pairs."""
    seen = np.random.default_rng(triangles).integers(0, triangles, (batch, height, width)).astype(np.uint32)
    seen[:, height // 3 : height // 2] = 7
    none = mi.Float(0)
    raster = RasterOutput(
        mi.UInt32(seen.ravel()), *[none] * 4, records=(), face_count=triangles, batch=batch, height=height, width=width
    )
    found, keys = differing_pairs(raster)
    pixel = np.arange(seen.size).reshape(seen.shape)
    right = 2 * pixel[:, :, :-1][seen[:, :, 1:] != seen[:, :, :-1]]
    below = 2 * pixel[:, :-1][seen[:, 1:] != seen[:, :-1]] + 1
    front, back, pairs = (array.numpy() for array in (found.front, found.back, found.pairs))
    assert (front[0], back[0]) == (len(right), len(below)) and len(pairs) == 2 * seen.size
    np.testing.assert_array_equal(np.sort(pairs[: len(right)]), np.sort(right))
    np.testing.assert_array_equal(np.sort(pairs[len(pairs) - len(below) :]), np.sort(below))
    np.testing.assert_array_equal(keys.numpy()[np.concatenate([right, below])], 0)
    # All slots, without gaps.
    visited = dr.zeros(mi.UInt32, 2 * seen.size)
    found.for_each(lambda slot, pair: dr.scatter_add(visited, mi.UInt32(1), pair))
    np.testing.assert_array_equal(np.flatnonzero(visited.numpy()), np.sort(np.concatenate([right, below])))
    assert visited.numpy().max(initial=0) <= 1
