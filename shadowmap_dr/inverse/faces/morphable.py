"""Morphable models: a mean shape and its changes by identity and expression. The file format and its checks."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io.files import atomic, no_file, read_arrays

#: Arrays that every model file holds, and optional arrays.
REQUIRED, OPTIONAL = ("mean", "faces", "identity"), ("expression", "identity_names", "expression_names", "mask")


@dataclass(frozen=True)
class MorphableModel:
    """vertices = mean + sum of identity weights times ``identity`` + sum of expression weights times ``expression``.

    The weights have mean zero and variance one over the population that a model describes. The head faces +x, y is up; heads of
    the package fit into [-1, 1]^3. The constructor checks and converts the arrays.

    Attributes:
        mean: (V, 3) float32, vertices of the mean shape.
        faces: (F, 3) int32, triangles.
        identity: (K, V, 3) float32, change of the vertices by each weight, K >= 1.
        expression: (E, V, 3) float32 likewise, E >= 0.
        identity_names, expression_names: K and E names.
        mask: (V,) bool, vertices above the neck: the shadow image shows them, and errors are measured on them.

    Raises ShadowmapError if shapes do not match, numbers are not finite, or faces name vertices that do not exist.
    """

    mean: npt.NDArray[np.float32]
    faces: npt.NDArray[np.int32]
    identity: npt.NDArray[np.float32]
    expression: npt.NDArray[np.float32]
    identity_names: tuple[str, ...]
    expression_names: tuple[str, ...]
    mask: npt.NDArray[np.bool_]

    def __post_init__(self) -> None:
        mean = _numbers("mean", self.mean)
        if mean.ndim != 2 or mean.shape[1] != 3 or len(mean) < 3:
            raise ShadowmapError(f"a morphable model's mean of shape {mean.shape}: give (V, 3) with at least 3 vertices.")
        if not np.ptp(mean, axis=0).any():
            raise ShadowmapError("a morphable model's mean has all vertices in one place: give vertices of a surface.")
        values: dict[str, Any] = {
            "mean": mean,
            "faces": _faces(self.faces, len(mean)),
            "identity": _basis("identity", self.identity, mean.shape),
            "expression": _basis("expression", self.expression, mean.shape),
            "mask": _mask(self.mask, len(mean)),
        }
        if not len(values["identity"]):
            raise ShadowmapError("a morphable model without identity components: give at least one, as an array (K, V, 3).")
        if not values["mask"][values["faces"]].all(1).any():
            raise ShadowmapError("a morphable model whose mask holds no triangle: mark the vertices above the neck.")
        for kind in ("identity", "expression"):
            names = tuple(map(str, getattr(self, f"{kind}_names")))
            if len(names) != len(values[kind]):
                raise ShadowmapError(f"a morphable model has {len(values[kind])} {kind} components, but {len(names)} names.")
            values[f"{kind}_names"] = names
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def basis(self, kind: str) -> npt.NDArray[np.float32]:
        """(N, V, 3) components of a kind: ``identity``, ``expression``, or ``both`` (identity first)."""
        if kind == "both":
            return np.concatenate([self.identity, self.expression])
        return {"identity": self.identity, "expression": self.expression}[kind]

    def vertices(self, identity: npt.ArrayLike = (), expression: npt.ArrayLike = ()) -> npt.NDArray[np.float32]:
        """(V, 3) vertices for at most K and at most E weights. Missing weights are zero. ShadowmapError for too many."""
        result = self.mean.astype(np.float64)
        for kind, weights in (("identity", identity), ("expression", expression)):
            w = np.asarray(weights, np.float64).reshape(-1)
            basis = self.basis(kind)
            if len(w) > len(basis):
                raise ShadowmapError(f"{len(w)} {kind} weights for a model with {len(basis)}.")
            result += np.tensordot(w, basis[: len(w)].astype(np.float64), 1)
        return result.astype(np.float32)

    def describe(self) -> str:
        """Size of the model, in one line."""
        return (
            f"{len(self.mean)} vertices, {len(self.faces)} triangles, {len(self.identity)} identity and {len(self.expression)} "
            "expression components"
        )


def load_model(path: str | os.PathLike[str]) -> MorphableModel:
    """Read a model from an `.npz` file.

    Arrays are `mean`, `faces` and `identity`, optionally `expression`, `identity_names`, `expression_names` and `mask` (see
    MorphableModel). Default names are numbered, the default mask holds all vertices.

    Raises ShadowmapError, which names file and fault, for a file that holds no model.
    """
    path = Path(path)
    if not path.is_file():
        raise no_file("morphable model", path)
    arrays = read_arrays(path, (*REQUIRED, *OPTIONAL))
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise ShadowmapError(f"cannot read the morphable model {path}: it has no array {', '.join(missing)}.")
    try:
        return from_arrays(**arrays)
    except ShadowmapError as error:
        raise ShadowmapError(f"{path}: {error}") from None


def from_arrays(
    mean: npt.ArrayLike,
    faces: npt.ArrayLike,
    identity: npt.ArrayLike,
    expression: npt.ArrayLike | None = None,
    identity_names: npt.ArrayLike | None = None,
    expression_names: npt.ArrayLike | None = None,
    mask: npt.ArrayLike | None = None,
) -> MorphableModel:
    """Make a model from arrays. Optional arrays and their defaults: see `load_model`."""
    vertices = np.shape(mean)[0] if np.ndim(mean) else 0

    def names(kind: str, given: npt.ArrayLike | None, basis: npt.ArrayLike) -> tuple[str, ...]:
        count = np.shape(basis)[0] if np.ndim(basis) else 0
        return tuple(f"{kind} {k + 1}" for k in range(count)) if given is None else tuple(map(str, np.ravel(given)))

    moving = np.zeros((0, vertices, 3), np.float32) if expression is None else expression
    return MorphableModel(
        mean=np.asarray(mean),
        faces=np.asarray(faces),
        identity=np.asarray(identity),
        expression=np.asarray(moving),
        identity_names=names("identity", identity_names, identity),
        expression_names=names("expression", expression_names, moving),
        mask=np.ones(vertices, bool) if mask is None else np.asarray(mask),
    )


def save_model(path: str | os.PathLike[str], model: MorphableModel, *, half: bool = False) -> None:
    """Write a model as `.npz`. `half` stores the bases in half precision: half the size, relative error 5e-4."""
    precision = np.float16 if half else np.float32
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            mean=model.mean,
            faces=model.faces,
            identity=model.identity.astype(precision),
            expression=model.expression.astype(precision),
            identity_names=np.array(model.identity_names, dtype=np.str_),
            expression_names=np.array(model.expression_names, dtype=np.str_),
            mask=model.mask,
        )


def _numbers(name: str, value: npt.ArrayLike) -> npt.NDArray[np.float32]:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ShadowmapError(f"a morphable model's {name} holds {array.dtype} instead of numbers.")
    bad = int(np.count_nonzero(~np.isfinite(array)))
    if bad:
        raise ShadowmapError(f"a morphable model's {name} has {bad} numbers that are not finite: remove NaN and inf.")
    with np.errstate(over="ignore"):
        single = np.ascontiguousarray(array, np.float32)
    if not np.isfinite(single).all():
        raise ShadowmapError(f"a morphable model's {name} has numbers beyond single precision: scale it down.")
    return single


def _basis(name: str, value: npt.ArrayLike, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    array = _numbers(name, value)
    if array.ndim != 3 or array.shape[1:] != shape:
        raise ShadowmapError(
            f"a morphable model's {name} basis of shape {array.shape} for a mean of shape {shape}: give (components, V, 3)."
        )
    return array


def _faces(value: npt.ArrayLike, vertices: int) -> npt.NDArray[np.int32]:
    array = np.asarray(value)
    if array.dtype.kind not in "iu" or array.ndim != 2 or array.shape[1] != 3 or not len(array):
        raise ShadowmapError(f"a morphable model's faces of shape {array.shape} and type {array.dtype}: give integers (F, 3).")
    low, high = int(array.min()), int(array.max())
    if low < 0 or high >= vertices:
        raise ShadowmapError(f"a morphable model's faces name vertices {low} to {high}, but they go from 0 to {vertices - 1}.")
    return np.ascontiguousarray(array, np.int32)


def _mask(value: npt.ArrayLike, vertices: int) -> npt.NDArray[np.bool_]:
    array = np.asarray(value)
    if array.dtype != np.bool_ or array.shape != (vertices,):
        raise ShadowmapError(f"a morphable model's mask of shape {array.shape} and type {array.dtype}: give {vertices} booleans.")
    return np.ascontiguousarray(array)
