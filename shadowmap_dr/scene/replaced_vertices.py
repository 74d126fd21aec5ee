"""New vertices and transformations of shapes, as users give them: checks, and their places in the buffers of all shapes."""

from __future__ import annotations

from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..jit.arrays import device_tensor, ravel
from ..jit.types import AnyArray, Float, Matrix4f, Point3f, Vector3f
from ..jit.vectors import normalize_or


def checked_positions(name: str, value: AnyArray | npt.ArrayLike, count: int) -> Float | Point3f:
    """Convert positions to Float (3Vs,) or Point3f (Vs,). Sizes are checked without evaluating arrays."""
    array: Any = value  # Any: Dr.Jit's predicates narrow no types
    if not dr.is_array_v(value):
        try:
            array = device_tensor(mi.TensorXf, np.asarray(value, np.float32))  # Dr.Jit itself hangs on a string
        except (TypeError, ValueError) as error:
            raise ShadowmapError(f"Positions of shape '{name}' are {value!r:.60}: give an array of {count} points.") from error
    if dr.is_tensor_v(array):
        if tuple(array.shape) not in ((count, 3), (3 * count,)):
            raise ShadowmapError(
                f"Positions of shape '{name}' have the tensor shape {tuple(array.shape)}, but it has {count} vertices: "
                f"give a tensor of shape ({count}, 3)."
            )
        array = array.array
    if dr.depth_v(array) == 2 and dr.size_v(array) == 3:
        if dr.width(array) not in (1, count):
            raise ShadowmapError(
                f"Positions of shape '{name}' are an array of {dr.width(array)} points, but it has {count} vertices."
            )
        return mi.Point3f(array)
    if dr.depth_v(array) != 1 or dr.width(array) != 3 * count:
        raise ShadowmapError(
            f"Positions of shape '{name}' are an array of {dr.width(array)} numbers, but {count} vertices need {3 * count}."
        )
    return mi.Float(array)


def checked_matrix(name: str, value: Matrix4f | mi.Transform4f | npt.ArrayLike) -> Matrix4f:
    """The map of a shape as Matrix4f."""
    given: Any = value.matrix if isinstance(value, (mi.Transform4f, mi.ScalarTransform4f)) else value  # Any: no stub narrows it
    try:
        if not dr.is_array_v(given) or dr.is_tensor_v(given):
            numbers = np.asarray(given, np.float64)
            if numbers.shape != (4, 4):  # a matrix of a number is a multiple of the identity
                raise ValueError("no matrix")
            given = mi.ScalarMatrix4f(numbers.tolist())
        elif not dr.is_matrix_v(given) or dr.size_v(given) != 4:
            raise TypeError("no matrix")
        matrix = mi.Matrix4f(given)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ShadowmapError(
            f"transforms['{name}'] is a {type(value).__name__}: give a Transform4f or a 4 x 4 matrix."
        ) from error
    if dr.width(matrix) != 1:
        raise ShadowmapError(f"transforms['{name}'] holds {dr.width(matrix)} transformations: give one.")
    return matrix


def moved(matrix: Matrix4f, p: Point3f) -> Point3f:
    """Points after an affine map."""
    x, y, z = (
        dr.fma(matrix[row, 0], p.x, dr.fma(matrix[row, 1], p.y, dr.fma(matrix[row, 2], p.z, matrix[row, 3]))) for row in range(3)
    )
    return mi.Point3f(x, y, z)


def turned(matrix: Matrix4f, n: Vector3f) -> Vector3f:
    """Unit normals after an affine map. Where the map mirrors faces, it mirrors normals, too."""
    a, b, c = (mi.Vector3f(matrix[0, k], matrix[1, k], matrix[2, k]) for k in range(3))
    normals = n.x * dr.cross(b, c) + n.y * dr.cross(c, a) + n.z * dr.cross(a, b)  # by the cofactors
    return normalize_or(normals, mi.Vector3f(1.0, 0.0, 0.0))


def with_vertices(target: Float, value: Float | Point3f, start: int, count: int, total: int) -> Float:
    """A copy of the flat buffer ``target`` with ``count`` vertices from ``start`` on replaced, differentiable in both."""
    points = dr.size_v(value) == 3
    if start == 0 and count == total:
        return ravel(value) if points and dr.width(value) == count else _fill(value, count)
    result = type(target)(target)
    each = 1 if points else 3
    index = dr.arange(mi.UInt32, each * count) + each * start
    # Not all shapes have a size guard: a replay with more vertices must not write behind those of its shape.
    within = index < each * (start + count) if dr.flag(dr.JitFlag.FreezingScope) else True
    # Not ``Permute``: that promises that all of the target is written, and its gradient would be dropped.
    dr.scatter(result, value, index, within, mode=dr.ReduceMode.NoConflicts)
    return result


def _fill(value: Float | Point3f, count: int) -> Float:
    if dr.size_v(value) == 3:
        return ravel(dr.gather(mi.Point3f, ravel(value), dr.zeros(mi.UInt32, count)))
    return cast(Float, value)
