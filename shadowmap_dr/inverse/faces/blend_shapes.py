"""Weighted sums of many shapes (blend shapes, morphable models), as a matrix product that is cheap in both directions."""

from __future__ import annotations

from typing import Any

import drjit as dr

from ...jit.arrays import backend

# Lanes that share the adjoint's sum over all coordinates for one weight: enough to keep a vector machine busy.
_LANES = 64


def blend(rest: Any, basis: Any, weights: Any) -> Any:
    """``rest + weights @ basis``: positions as a linear function of weights.

    Args:
        rest: ``Float`` (N,), for instance N = 3V flat vertex positions, any space and unit. Attached.
        basis: ``Float`` (K * N,), row-major: the change of coordinate i by weight k is entry ``k * N + i``. Taken as constant.
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
    """``basis @ weights`` for a fixed matrix. Built-in gathers would add the derivatives up one atomic operation at a time."""

    def eval(self, weights: Any, basis: Any) -> Any:
        self.basis, self.count = basis, dr.width(weights)
        return _apply(basis, weights)

    def forward(self) -> None:
        self.set_grad_out(_apply(self.basis, self.grad_in("weights")))

    def backward(self) -> None:
        self.set_grad_in("weights", _apply_transposed(self.basis, self.grad_out(), self.count))


def _apply(basis: Any, weights: Any) -> Any:
    """(K * N,) times (K,): a lane for each coordinate, which adds up K numbers."""
    module = backend(basis)
    count = dr.width(weights)
    rows = dr.width(basis) // count
    dr.eval(weights)
    row = dr.arange(module.UInt32, rows)

    def add(k: Any, total: Any) -> tuple[Any, Any]:
        return k + 1, dr.fma(dr.gather(module.Float, basis, k * rows + row), dr.gather(module.Float, weights, k), total)

    return dr.while_loop((module.UInt32(0), dr.zeros(module.Float, rows)), lambda k, _: k < count, add, mode="symbolic")[1]


def _apply_transposed(basis: Any, gradient: Any, count: int) -> Any:
    """(K * N,) times (N,): some lanes for each weight share the coordinates; then their sums are added up."""
    module = backend(basis)
    rows = dr.width(gradient)
    dr.eval(gradient)
    lane = dr.arange(module.UInt32, count * _LANES)
    weight = lane // _LANES
    # Neighbouring lanes read neighbouring numbers.
    first = lane - weight * _LANES

    def add(row: Any, total: Any) -> tuple[Any, Any]:
        return row + _LANES, dr.fma(
            dr.gather(module.Float, basis, weight * rows + row), dr.gather(module.Float, gradient, row), total
        )

    state = (first, dr.zeros(module.Float, count * _LANES))
    return dr.block_sum(dr.while_loop(state, lambda row, _: row < rows, add, mode="symbolic")[1], _LANES)
