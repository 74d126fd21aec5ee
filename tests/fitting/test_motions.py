"""Rotations of few numbers, against SciPy's and against finite differences in double precision."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowmap_dr.fitting.motions import host_matrix, rotation, scaling, tangents, translation

Rotation = pytest.importorskip("scipy.spatial.transform", reason="SciPy is not installed").Rotation

AXES = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
ANGLES = (0.0, 1e-7, 1e-4, 1e-2, 0.3, 1.0, 2.0, 3.0)


@pytest.fixture(autouse=True)
def variant_is_set(variant: str) -> None:
    """All tests run once for each backend."""


def opaque(vector: Any) -> Any:
    value = mi.Vector3f(*(float(number) for number in vector))
    dr.make_opaque(value)
    return value


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("axis", AXES, ids=str)
def test_rotations_are_those_of_scipy(axis: np.ndarray, angle: float) -> None:
    found = host_matrix(rotation(opaque(angle * axis)))
    expected = Rotation.from_rotvec(angle * axis).as_matrix()
    np.testing.assert_allclose(found[:3, :3], expected, atol=1e-6)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])
    np.testing.assert_array_equal(found[:3, 3], 0)


@pytest.mark.parametrize("angle", [1e-3, 1e-5])
def test_small_rotations_keep_their_digits(angle: float) -> None:
    """Also the difference from one, of the second order."""
    found = host_matrix(rotation(opaque([angle, 2 * angle, 0])))
    assert found[2, 0] == pytest.approx(-2 * angle, rel=1e-5) and found[2, 1] == pytest.approx(angle, rel=1e-5)
    assert found[0, 1] == pytest.approx(angle * angle, rel=1e-5)


def difference(vector: np.ndarray, number: int) -> np.ndarray:
    """Central difference of SciPy's matrix by one number, in double precision."""
    step = np.eye(3)[number] * 1e-5
    after, before = (Rotation.from_rotvec(vector + sign * step).as_matrix() for sign in (1, -1))
    return np.asarray((after - before) / 2e-5)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("vector", [(0, 0, 0), (1e-4, 0, 0), (0.6e-4, -0.8e-4, 0), (1e-9, 0, 0), (0.3, 1, -2)], ids=str)
def test_derivatives_are_those_of_differences(vector: tuple[float, ...], number: int) -> None:
    numbers = opaque(vector)
    dr.enable_grad(numbers)
    tangent = mi.Vector3f(0)
    tangent[number] = 1
    dr.set_grad(numbers, tangent)
    matrix = rotation(numbers)
    dr.forward_to(matrix)
    forward = host_matrix(dr.grad(matrix))
    np.testing.assert_allclose(forward[:3, :3], difference(np.array(vector), number), atol=2e-6)
    np.testing.assert_array_equal(forward[3], 0)


@pytest.mark.parametrize("vector", [(0, 0, 0), (1e-4, 0, 0), (0.3, 1, -2)], ids=str)
def test_reverse_derivatives_are_the_forward_ones(vector: tuple[float, ...]) -> None:
    weights = np.random.default_rng(1).normal(size=(3, 3))
    numbers = opaque(vector)
    dr.enable_grad(numbers)
    matrix = rotation(numbers)
    dr.backward(sum(float(weights[i, j]) * matrix[i, j] for i in range(3) for j in range(3)))
    expected = [(weights * difference(np.array(vector), number)).sum() for number in range(3)]
    np.testing.assert_allclose(np.array(dr.grad(numbers)).ravel(), expected, atol=1e-5)


def test_translation_and_scale() -> None:
    point = np.array([1, 2, 3, 1.0])
    np.testing.assert_allclose(host_matrix(translation(opaque([0.5, -1, 2]))) @ point, [1.5, 1, 5, 1])
    np.testing.assert_allclose(host_matrix(scaling(dr.opaque(mi.Float, 2))) @ point, [2, 4, 6, 1])


def test_host_matrices() -> None:
    """Rows and columns stay, for matrices and transformations, of width one or of the host, attached or not."""
    numbers = np.arange(16.0).reshape(4, 4) + 0.5
    scalar = mi.ScalarTransform4f(numbers.tolist())
    attached = mi.Matrix4f(scalar.matrix)
    dr.enable_grad(attached)
    for value in (scalar, mi.Transform4f(scalar), mi.Matrix4f(scalar.matrix), attached):
        found = host_matrix(value)
        assert found.dtype == np.float64 and found.shape == (4, 4)
        np.testing.assert_array_equal(found, numbers)


@given(direction=st.tuples(*[st.floats(-1e3, 1e3)] * 3).filter(lambda d: np.linalg.norm(d) > 1e-6))
def test_tangents_are_a_frame(direction: tuple[float, float, float]) -> None:
    unit = np.array(direction) / np.linalg.norm(direction)
    frame = np.stack([*tangents(direction), unit])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1)
