"""Results handed from one computation to a second one that begins in the same way."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.jit.arrays import interleave
from shadowmap_dr.jit.handover import Results, computed, evaluated, interleaved, keeping, using


def steps(x: Any, calls: list[str]) -> Any:
    """Some detached integers, a value, and interleaved values, all of ``x``."""

    def whole() -> Any:
        calls.append("whole")
        return mi.UInt32(dr.detach(x))

    number = computed("whole", whole)
    (square,) = evaluated("square", [x * x])
    return interleaved("both", [square * 2, square + mi.Float(number)])


def first(x: Any) -> tuple[Any, Results, list[str]]:
    calls: list[str] = []
    with keeping() as results:
        found = steps(x, calls)
    return found, results, calls


def test_nothing_changes_without(variant: str) -> None:
    x, calls = mi.Float(1, 2, 3), []
    found = steps(x, calls)
    kept, results, _ = first(x)
    np.testing.assert_array_equal(found.numpy(), [2, 2, 8, 6, 18, 12])
    np.testing.assert_array_equal(kept.numpy(), found.numpy())
    assert calls == ["whole"] and [name for name, _ in results] == ["whole", "square", "both"]


def test_the_second_computation_takes_over_values_and_has_derivatives_of_its_own(variant: str) -> None:
    x, calls = mi.Float(1, 2, 3), []
    _, results, _ = first(x)
    results[2][1][0] = 100.0  # to be seen again
    dr.enable_grad(x)
    with using(results):
        found = steps(x, calls)
    assert not calls
    np.testing.assert_array_equal(found.numpy(), [100, 2, 8, 6, 18, 12])
    weight = np.arange(1, 7, dtype=np.float32)
    dr.backward(dr.sum(found * mi.Float(weight)))
    np.testing.assert_allclose(dr.grad(x).numpy(), 2 * np.array([1, 2, 3]) * (2 * weight[::2] + weight[1::2]))


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_derivatives_of_interleaved_values(variant: str, count: int) -> None:
    rng = np.random.default_rng(count)
    values = rng.uniform(size=(count, 5)).astype(np.float32)
    weight = mi.Float(rng.uniform(size=5 * count).astype(np.float32))

    def gradients(function: Any) -> np.ndarray:
        channels = [mi.Float(row) for row in values]
        dr.enable_grad(channels)
        dr.backward(dr.sum(function(channels) * weight))
        return np.array([dr.grad(channel).numpy() for channel in channels])

    with keeping() as results:
        made = interleaved("values", [mi.Float(row) for row in values])
    np.testing.assert_array_equal(made.numpy(), values.T.ravel())

    def given(channels: Any) -> Any:
        with using(results):
            return interleaved("values", channels)

    np.testing.assert_array_equal(gradients(given), gradients(interleave))


def test_other_steps_are_an_error(variant: str) -> None:
    _, results, _ = first(mi.Float(1))
    with using(results), pytest.raises(RuntimeError, match="needs square where the first one has whole"):
        evaluated("square", mi.Float(1))
    with using(results[:1]), pytest.raises(RuntimeError, match="nothing"):
        computed("whole", list)
        evaluated("square", mi.Float(1))
    with using([]):
        assert float(evaluated("square", mi.Float(1))[0]) == 1


def test_results_are_kept_for_one_computation(variant: str) -> None:
    with keeping() as outer, keeping() as inner:
        evaluated("value", mi.Float(1))
    evaluated("value", mi.Float(2))
    assert not outer and [float(value[0]) for _, value in inner] == [1]
