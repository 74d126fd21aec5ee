"""Branches that read attached arrays: values, derivatives, and graphs that are traversed several times."""

from __future__ import annotations

from contextlib import nullcontext

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.jit.branches import branch, traversed_again


def graph(number: mi.Float) -> mi.Float:
    """An array that reads another one within a branch. Indices of inactive lanes are beyond its end."""
    table = dr.arange(mi.Float, 4) * number
    lane = dr.arange(mi.UInt32, 8)
    active = lane < 4

    def inside(index: mi.UInt32, own: mi.Float) -> tuple[mi.Float, mi.Float]:
        return dr.gather(mi.Float, table, index) + own, own * own

    def outside(index: mi.UInt32, own: mi.Float) -> tuple[mi.Float, mi.Float]:
        return own, mi.Float(0)

    arguments = (dr.select(active, lane, 1 << 30), dr.arange(mi.Float, 8) + number)
    first, second = branch(active, inside, outside, arguments, "test")
    return first + second


@pytest.mark.parametrize("again", [False, True])
def test_values_and_derivatives(again: bool) -> None:
    mi.set_variant("llvm_ad_rgb")
    number = mi.Float(2)
    dr.enable_grad(number)
    with traversed_again() if again else nullcontext():
        result = graph(number)
    dr.set_grad(number, 1)
    dr.forward_to(result)
    k, inside = np.arange(8.0), np.arange(8) < 4
    np.testing.assert_allclose(dr.detach(result).numpy(), np.where(inside, 2 * k + (k + 2) + (k + 2) ** 2, k + 2))
    np.testing.assert_allclose(dr.grad(result).numpy(), np.where(inside, k + 1 + 2 * (k + 2), 1))


def test_graphs_are_traversed_for_one_tangent_after_the_other() -> None:
    mi.set_variant("llvm_ad_rgb")
    numbers = [mi.Float(2), mi.Float(3)]
    dr.enable_grad(numbers)
    with traversed_again():
        result = graph(numbers[0] * numbers[1])
        found = []
        for k in range(2):
            for j, number in enumerate(numbers):
                dr.set_grad(number, float(j == k))
            dr.forward_to(result, flags=dr.ADFlag.ClearVertices if k == 0 else dr.ADFlag.ClearEdges)
            found.append(dr.grad(result))
            dr.clear_grad(result)
    by_product = np.where(np.arange(8) < 4, np.arange(8) + 1 + 2 * (np.arange(8) + 6), 1)
    np.testing.assert_allclose(found[0].numpy(), 3 * by_product)
    np.testing.assert_allclose(found[1].numpy(), 2 * by_product)
