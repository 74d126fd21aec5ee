"""Results handed from one computation to a second one that begins in the same way."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.jit import handover
from shadowmap_dr.jit.arrays import interleave
from shadowmap_dr.jit.frozen import take_apart
from shadowmap_dr.jit.handover import PackedResults, Results, computed, evaluated, interleaved, keeping, stored, using


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


def test_packed_results(variant: str) -> None:
    """One tuple of arrays, which recordings take at once, in the place of records; the text tells different layouts apart."""
    found, results, _ = first(mi.Float(1, 2, 3))
    packed = PackedResults.of(results)
    assert packed and not PackedResults.of([])
    text, leaves = take_apart(packed)
    assert [id(leaf) for leaf in leaves] == [id(array) for array in packed.arrays] and len(leaves) == 3
    back = packed.unpacked()
    assert [name for name, _ in back] == [name for name, _ in results]
    for (_, one), (_, two) in zip(back, results, strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(two))
    with using(back):
        np.testing.assert_array_equal(steps(mi.Float(1, 2, 3), []).numpy(), found.numpy())
    # The same layout with other arrays is the same recording, another layout is not, nor are arrays that came before.
    assert take_apart(PackedResults.of(first(mi.Float(4, 5, 6))[1]))[0] == text
    assert take_apart(PackedResults.of(results[:2]))[0] != text
    shared, again = take_apart([leaves[1], packed])
    other, apart_ = take_apart([mi.Float(0), packed])
    assert len(again) == 3 and len(apart_) == 4 and shared != other


@pytest.mark.parametrize("attached", [True, False])
def test_stored_values_are_written_with_what_is_evaluated_next(variant: str, attached: bool) -> None:
    x = mi.Float(1, 2, 3)
    dr.set_grad_enabled(x, attached)
    (square,) = stored("square", [x * x])
    assert square.state == dr.VarState.Unevaluated
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(square + 1)
        assert len(dr.kernel_history((dr.KernelType.JIT,))) == 1
    # Nothing needs the values again where there are no derivatives.
    assert square.state == (dr.VarState.Evaluated if attached else dr.VarState.Unevaluated)


def test_large_values_are_not_stored(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handover, "_MOST_STORED", 2)
    x = mi.Float(1, 2, 3)
    dr.enable_grad(x)
    with keeping() as results:
        (square,) = stored("square", [x * x])
    assert not results
    dr.eval(square + 1)
    assert square.state == dr.VarState.Unevaluated
    with using(results):
        assert stored("square", [square])[0].index_ad == square.index_ad


def test_stored_values_are_handed_over(variant: str) -> None:
    x = mi.Float(1, 2, 3)
    with keeping() as results:
        stored("square", [x * x])
    results[0][1][0] = mi.Float(100, 100, 100)  # to be seen again
    dr.enable_grad(x)
    with using(results):
        (square,) = stored("square", [x * x])
    np.testing.assert_array_equal(square.numpy(), [100, 100, 100])
    dr.backward(dr.sum(square))
    np.testing.assert_array_equal(dr.grad(x).numpy(), [2, 4, 6])
