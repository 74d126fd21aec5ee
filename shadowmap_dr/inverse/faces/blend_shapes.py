"""Weighted sums of many shapes (blend shapes, morphable models): a matrix product with a fast backward pass."""

from __future__ import annotations

from typing import cast

import drjit as dr

from ...jit.arrays import backend
from ...jit.types import Bool, Float, UInt32

# Lanes that share the backward pass's sum over all coordinates for one weight: enough to occupy the device.
_LANES = 64


def blend(rest: Float, basis: Float, weights: Float) -> Float:
    """``rest + weights @ basis``: positions as a linear function of weights.

    Args:
        rest: ``Float`` (N,), for instance N = 3V flat vertex positions, any space and unit. Attached.
        basis: ``Float`` (K * N,), row-major: the change of coordinate i by weight k is entry ``k * N + i``. Detached.
        weights: ``Float`` (K,), K >= 1. Attached.

    Returns:
        ``Float`` (N,). Gradients flow to ``rest`` and ``weights``.

    Raises:
        ValueError: ``basis`` does not have K * N numbers.
    """
    rows, count = dr.width(rest), dr.width(weights)
    if dr.width(basis) != rows * count:
        raise ValueError(f"a basis of {dr.width(basis)} numbers for {rows} coordinates and {count} weights; give {rows * count}")
    return rest + dr.custom(_Product, weights, dr.detach(basis))


class _Product(dr.CustomOp):
    """``basis @ weights`` for a constant matrix. The backward pass of built-in gathers would add up derivatives by atomics."""

    def eval(self, weights: Float, basis: Float) -> Float:
        self.basis, self.count = basis, dr.width(weights)
        return _apply(basis, weights)

    def forward(self) -> None:
        self.set_grad_out(_apply(self.basis, cast(Float, self.grad_in("weights"))))

    def backward(self) -> None:
        self.set_grad_in("weights", _apply_transposed(self.basis, cast(Float, self.grad_out()), self.count))


def _apply(basis: Float, weights: Float) -> Float:
    """(K * N,) times (K,): the lane of each coordinate adds up K products."""
    module = backend(basis)
    count = dr.width(weights)
    rows = dr.width(basis) // count
    dr.eval(weights)
    row = dr.arange(module.UInt32, rows)

    def unfinished(k: UInt32, _: Float) -> Bool:
        return k < count

    def add(k: UInt32, total: Float) -> tuple[UInt32, Float]:
        return k + 1, dr.fma(dr.gather(module.Float, basis, k * rows + row), dr.gather(module.Float, weights, k), total)

    return dr.while_loop((module.UInt32(0), dr.zeros(module.Float, rows)), unfinished, add, mode="symbolic")[1]


def _apply_transposed(basis: Float, gradient: Float, count: int) -> Float:
    """Transposed (K * N,) times (N,): some lanes of each weight share the coordinates, then their partial sums are added up."""
    module = backend(basis)
    rows = dr.width(gradient)
    dr.eval(gradient)
    lane = dr.arange(module.UInt32, count * _LANES)
    weight = lane // _LANES
    # Neighbouring lanes read neighbouring numbers.
    first = lane - weight * _LANES

    def unfinished(row: UInt32, _: Float) -> Bool:
        return row < rows

    def add(row: UInt32, total: Float) -> tuple[UInt32, Float]:
        return row + _LANES, dr.fma(
            dr.gather(module.Float, basis, weight * rows + row), dr.gather(module.Float, gradient, row), total
        )

    state = (first, dr.zeros(module.Float, count * _LANES))
    return dr.block_sum(dr.while_loop(state, unfinished, add, mode="symbolic")[1], _LANES)
