"""Arrays that lie interleaved, or one after the other, in flat ones: values and derivatives against NumPy."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.jit.packets import apart, packed, sections

WIDTH = 37


def arrays(count: int, width: int = WIDTH) -> list[np.ndarray]:
    return list(np.random.default_rng(1).standard_normal((count, width)).astype(np.float32))


@pytest.mark.parametrize(("count", "parts"), [(4, 1), (8, 1), (8, 2), (24, 3)])
def test_interleaved_arrays_and_back(variant: str, count: int, parts: int) -> None:
    values = arrays(count)
    flat = packed([mi.Float(value) for value in values], parts)
    each = count // parts
    expected = np.concatenate([np.stack(values[k * each : (k + 1) * each], axis=1).ravel() for k in range(parts)])
    assert np.array_equal(flat.numpy(), expected)
    back = [array for part in apart(flat, each, parts) for array in part]
    assert all(np.array_equal(array.numpy(), value) for array, value in zip(back, values, strict=True))


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_sections(variant: str, parts: int) -> None:
    values, weights = arrays(2, parts * WIDTH), arrays(2 * parts)
    whole = [mi.Float(value) for value in values]
    dr.enable_grad(whole)
    cut = sections(whole, parts)
    for k, part in enumerate(cut):
        for array, value in zip(part, values, strict=True):
            assert np.array_equal(array.numpy(), value[k * WIDTH : (k + 1) * WIDTH])
    total = sum(mi.Float(weights[2 * k + n]) * cut[k][n] for k in range(parts) for n in range(2))
    dr.backward(dr.sum(total))
    for n, array in enumerate(whole):
        expected = np.concatenate([weights[2 * k + n] for k in range(parts)])
        assert np.array_equal(dr.grad(array).numpy(), expected)


def test_sections_forward(variant: str) -> None:
    (value,) = arrays(1, 2 * WIDTH)
    whole, scale = mi.Float(value), mi.Float(1)
    dr.enable_grad(scale)
    ((first,), (second,)) = sections([whole * scale], 2)
    total = first + 2 * second
    dr.forward(scale)
    assert np.allclose(dr.grad(total).numpy(), value[:WIDTH] + 2 * value[WIDTH:])


def test_a_section_without_gradient(variant: str) -> None:
    """One of the parts is not used: its share of the gradient is zero."""
    (value,) = arrays(1, 2 * WIDTH)
    whole = mi.Float(value)
    dr.enable_grad(whole)
    ((_,), (second,)) = sections([whole], 2)
    dr.backward(dr.sum(second))
    assert np.array_equal(dr.grad(whole).numpy(), np.repeat([0, 1], WIDTH))
