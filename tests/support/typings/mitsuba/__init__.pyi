# Mitsuba for mypy. Its own stubs have arrays that are not Dr.Jit's: a `mi.Float` is no component of a `mi.Point3f` there. Here
# arrays have Dr.Jit's types, as in `shadowmap_dr.jit.types`; objects are not checked.
from typing import Any, TypeAlias

from drjit.auto import ad as _arrays

ArrayXf: TypeAlias = _arrays.ArrayXf
Bool: TypeAlias = _arrays.Bool
Color3f: TypeAlias = _arrays.Array3f
Float: TypeAlias = _arrays.Float
Float32: TypeAlias = _arrays.Float32
Float64: TypeAlias = _arrays.Float64
Int32: TypeAlias = _arrays.Int
Int64: TypeAlias = _arrays.Int64
Mask: TypeAlias = _arrays.Bool
Matrix3f: TypeAlias = _arrays.Matrix3f
Matrix4f: TypeAlias = _arrays.Matrix4f
Normal3f: TypeAlias = _arrays.Array3f
Point2f: TypeAlias = _arrays.Array2f
Point2i: TypeAlias = _arrays.Array2i
Point2u: TypeAlias = _arrays.Array2u
Point3f: TypeAlias = _arrays.Array3f
Point3i: TypeAlias = _arrays.Array3i
Point3u: TypeAlias = _arrays.Array3u
Point4f: TypeAlias = _arrays.Array4f
Spectrum: TypeAlias = _arrays.Array3f
TensorXb: TypeAlias = _arrays.TensorXb
TensorXf: TypeAlias = _arrays.TensorXf
TensorXi: TypeAlias = _arrays.TensorXi
TensorXu: TypeAlias = _arrays.TensorXu
UInt32: TypeAlias = _arrays.UInt
UInt64: TypeAlias = _arrays.UInt64
UnpolarizedSpectrum: TypeAlias = _arrays.Array3f
Vector2f: TypeAlias = _arrays.Array2f
Vector2i: TypeAlias = _arrays.Array2i
Vector2u: TypeAlias = _arrays.Array2u
Vector3f: TypeAlias = _arrays.Array3f
Vector3i: TypeAlias = _arrays.Array3i
Vector3u: TypeAlias = _arrays.Array3u
Vector4f: TypeAlias = _arrays.Array4f

__version__: str
ad: Any

def __getattr__(name: str) -> Any: ...
