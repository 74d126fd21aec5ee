"""Names of arrays for annotations, in Mitsuba's words. At run time all of them are ``Any``.

``Point3f``, ``Vector3f``, ``Normal3f`` and ``Color3f`` are Dr.Jit's ``Array3f``: its stubs know that components are ``Float``,
Mitsuba's do not. A name stands for the arrays of all backends, with and without derivatives: ``Float`` is a
``drjit.llvm.ad.Float`` as well as a ``drjit.cuda.Float``. To make an array, use ``mi.Float`` or the module that
``arrays.backend`` returns.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

#: An array, or a structure of arrays, of the type that a function was given.
ArrayT = TypeVar("ArrayT")

if TYPE_CHECKING:
    import drjit
    from drjit.auto import ad

    #: Any array of Dr.Jit's, of any depth.
    AnyArray: TypeAlias = drjit.AnyArray
    #: A nested structure (lists, dictionaries, dataclasses) of arrays, as Dr.Jit traverses it. No type says that.
    PyTree: TypeAlias = Any
    Bool: TypeAlias = ad.Bool
    Float: TypeAlias = ad.Float
    Float64: TypeAlias = ad.Float64
    Int32: TypeAlias = ad.Int
    Int64: TypeAlias = ad.Int64
    UInt32: TypeAlias = ad.UInt
    UInt64: TypeAlias = ad.UInt64
    Point2f: TypeAlias = ad.Array2f
    Vector2f: TypeAlias = ad.Array2f
    Vector2i: TypeAlias = ad.Array2i
    Vector2u: TypeAlias = ad.Array2u
    Point3f: TypeAlias = ad.Array3f
    Vector3f: TypeAlias = ad.Array3f
    Normal3f: TypeAlias = ad.Array3f
    Color3f: TypeAlias = ad.Array3f
    Vector3i: TypeAlias = ad.Array3i
    Vector3u: TypeAlias = ad.Array3u
    Vector4f: TypeAlias = ad.Array4f
    Matrix3f: TypeAlias = ad.Matrix3f
    Matrix4f: TypeAlias = ad.Matrix4f
    ArrayXf: TypeAlias = ad.ArrayXf
    TensorXb: TypeAlias = ad.TensorXb
    TensorXf: TypeAlias = ad.TensorXf
    TensorXi: TypeAlias = ad.TensorXi
    TensorXu: TypeAlias = ad.TensorXu
    Texture2f: TypeAlias = ad.Texture2f
else:

    def __getattr__(name: str) -> Any:  # Any: all names at run time
        if name.startswith("_"):
            raise AttributeError(name)
        return Any
