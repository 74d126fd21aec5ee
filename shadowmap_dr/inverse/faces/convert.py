"""Import of morphable models in other formats: a folder of OBJ files (ICT-FaceKit), arrays (Basel-like)."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError, did_you_mean
from ...io.files import read_arrays
from ...io.options import option
from ...io.ranges import check_ranges
from .morphable import MorphableModel, from_arrays

FACING = ("+x", "-x", "+z", "-z")
#: File of the mean shape in ICT-FaceKit's folder; files of identity components are called `identity000.obj` and so on.
NEUTRAL, IDENTITY = "generic_neutral_mesh.obj", re.compile(r"identity\d+$")

# Arrays that `from_basel` reads.
_USED = {"triangles", *(f"{kind}_{what}" for kind in ("shape", "expression") for what in ("mean", "basis", "std", "variance"))}

Array = npt.NDArray[Any]


@dataclass(frozen=True)
class ConvertOptions:
    """Options of a conversion.

    ICT-FaceKit's expressions are full at a weight of 1. Basel-like models give standard deviations of their expressions: their
    ``expression_scale`` is 1.
    """

    facing: str = option("+z", choices=FACING, help="Axis along which the model's head looks; y is up.")
    neck: float | None = option(
        None, shown="all", allowed=(-1e30, 1e30), help="Height, in the model's units, above which vertices belong to the head."
    )
    components: int | None = option(None, shown="all", allowed=(1, 100_000), help="Identity components to keep.")
    expression_scale: float = option(
        0.5, shown="0.5 for OBJ files, 1 for arrays", help="Share of a full expression that a weight of 1 stands for."
    )

    def __post_init__(self) -> None:
        if self.facing not in FACING:
            raise ShadowmapError(
                f"a head facing {self.facing!r}: choose from {', '.join(FACING)}.{did_you_mean(self.facing, FACING)}"
            )
        check_ranges(self)
        if not (np.isfinite(self.expression_scale) and self.expression_scale > 0):
            raise ShadowmapError(f"an expression scale of {self.expression_scale}: give a positive number.")


def convert(source: str | os.PathLike[str], options: ConvertOptions) -> MorphableModel:
    """Read a folder (see `from_folder`) or an `.npz` file (see `from_basel`), turn the head to face +x and scale it into
    [-1, 1]^3. Raises ShadowmapError if the source holds no model.
    """
    path = Path(source)
    if path.is_dir():
        return from_folder(path, options)
    if path.is_file():
        return from_basel(path, options)
    raise ShadowmapError(f"no model {str(path)!r}: give a folder of OBJ files or an .npz file.")


def from_folder(folder: Path, options: ConvertOptions) -> MorphableModel:
    """Read a folder of OBJ files with the same vertices and faces, such as ICT-FaceKit's `FaceXModel`.

    `generic_neutral_mesh.obj` is the mean, `identityNNN.obj` the mean plus an identity component (weights are standard normal),
    every other file the mean plus a full expression. Polygons are cut into triangles.
    """
    files = {path.stem: path for path in sorted(folder.glob("*.obj"))}
    if Path(NEUTRAL).stem not in files:
        raise ShadowmapError(f"the folder {folder} has no {NEUTRAL}: give ICT-FaceKit's FaceXModel, or one like it.")
    mean, faces = read_obj(files.pop(Path(NEUTRAL).stem))
    identity = {name: path for name, path in files.items() if IDENTITY.match(name)}
    expression = {name: path for name, path in files.items() if name not in identity}
    if not identity:
        raise ShadowmapError(f"the folder {folder} has no identity000.obj: there is nothing to fit.")

    def offsets(paths: dict[str, Path]) -> Array:
        return np.stack([_same(path, mean) - mean for path in paths.values()]) if paths else np.zeros((0, *mean.shape))

    kept = dict(list(identity.items())[: options.components])
    moving = offsets(expression) * options.expression_scale
    return _placed(mean, faces, offsets(kept), moving, tuple(kept), tuple(expression), options)


def from_basel(path: Path, options: ConvertOptions) -> MorphableModel:
    """Read an `.npz` file with arrays as in the Basel Face Model.

    `shape_mean` (3V,) or (V, 3); `shape_basis` (3V, K), vectors of any length; `shape_std` (K,) or `shape_variance`, their
    standard deviations or variances; `triangles` (F, 3) or (3, F), counted from 0 or from 1. Optional, for expressions:
    `expression_basis`, `expression_std` (or `_variance`) and `expression_mean` likewise.
    """
    arrays = _arrays(path)
    missing = [name for name in ("shape_mean", "shape_basis", "triangles") if name not in arrays]
    if missing:
        raise ShadowmapError(f"{path} has no array {', '.join(missing)}: see the documentation of `shadowmap-dr face convert`.")
    mean = _points(arrays, "shape_mean")
    if "expression_mean" in arrays:
        offset = _points(arrays, "expression_mean")
        if offset.shape != mean.shape:
            raise ShadowmapError(f"{path}: expression_mean has {len(offset)} vertices, shape_mean {len(mean)}.")
        mean = mean + offset
    identity = _components(path, arrays, "shape", len(mean))[: options.components]
    expression = _components(path, arrays, "expression", len(mean)) * options.expression_scale
    identity_names = tuple(f"identity {k + 1}" for k in range(len(identity)))
    expression_names = tuple(f"expression {k + 1}" for k in range(len(expression)))
    faces = _triangles(path, arrays["triangles"], len(mean))
    return _placed(mean, faces, identity, expression, identity_names, expression_names, options)


def read_obj(path: Path) -> tuple[Array, npt.NDArray[np.int32]]:
    """Vertices (V, 3) and triangles (F, 3) of a Wavefront OBJ file. Polygons become fans. ShadowmapError if it is damaged."""
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for line in file:
                kind, _, rest = line.partition(" ")
                if kind == "v":
                    vertices.append([float(x) for x in rest.split()[:3]])
                elif kind == "f":
                    corners = [int(word.split("/")[0]) for word in rest.split()]
                    corners = [c - 1 if c > 0 else len(vertices) + c for c in corners]
                    faces += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
        points = np.array(vertices, np.float64).reshape(-1, 3)
        triangles = np.array(faces, np.int32)
    except (OSError, ValueError, IndexError, OverflowError) as error:
        raise ShadowmapError(f"cannot read {path}: it is no OBJ file, or it is damaged.") from error
    if not len(points) or not faces:
        raise ShadowmapError(f"cannot read {path}: it has {len(points)} vertices and {len(faces)} triangles.")
    return points, triangles


def _same(path: Path, mean: Array) -> Array:
    points, _ = read_obj(path)
    if points.shape != mean.shape:
        raise ShadowmapError(f"{path} has {len(points)} vertices, the mean {len(mean)}: all files must have the same vertices.")
    return points


def _arrays(path: Path) -> dict[str, Array]:
    arrays = read_arrays(path)
    for name, array in arrays.items():
        if name in _USED and array.dtype.kind not in "iuf":
            raise ShadowmapError(f"{path}: {name} holds {array.dtype}: give real numbers.")
    return arrays


def _points(arrays: dict[str, Array], name: str) -> Array:
    flat = arrays[name].astype(np.float64).reshape(-1)
    if len(flat) % 3:
        raise ShadowmapError(f"{name} has {len(flat)} numbers, which are no points: give (3V,) or (V, 3).")
    return flat.reshape(-1, 3)


def _components(path: Path, arrays: dict[str, Array], kind: str, vertices: int) -> Array:
    """Components (K, V, 3), scaled by their standard deviations."""
    basis = arrays.get(f"{kind}_basis")
    if basis is None:
        return np.zeros((0, vertices, 3))
    if basis.ndim != 2 or basis.shape[0] != 3 * vertices:
        raise ShadowmapError(f"{path}: {kind}_basis of shape {basis.shape} for {vertices} vertices: give ({3 * vertices}, K).")
    deviation = arrays.get(f"{kind}_std")
    if deviation is None and f"{kind}_variance" in arrays:
        variance = arrays[f"{kind}_variance"]
        deviation = np.sqrt(np.where(variance < 0, np.nan, variance))
    if deviation is not None and not (np.isfinite(deviation) & (np.asarray(deviation) >= 0)).all():
        raise ShadowmapError(f"{path}: deviations or variances of {kind}_basis are negative or not finite: repair them.")
    deviation = np.ones(basis.shape[1]) if deviation is None else np.asarray(deviation, np.float64).reshape(-1)
    if len(deviation) != basis.shape[1]:
        raise ShadowmapError(f"{path}: {kind}_basis has {basis.shape[1]} components, but there are {len(deviation)} deviations.")
    return (basis.astype(np.float64) * deviation).T.reshape(-1, vertices, 3)


def _triangles(path: Path, triangles: Array, vertices: int) -> Array:
    if triangles.ndim != 2 or 3 not in triangles.shape or triangles.dtype.kind not in "iuf":
        raise ShadowmapError(f"{path}: triangles of shape {triangles.shape}: give (F, 3) or (3, F).")
    if not (np.isfinite(triangles) & (triangles == np.floor(triangles)) & (triangles >= -1) & (triangles <= vertices)).all():
        raise ShadowmapError(
            f"{path}: triangles have corners that are no whole numbers up to {vertices}: give indices of vertices."
        )
    faces = (triangles if triangles.shape[1] == 3 else triangles.T).astype(np.int64)
    # Some of these models count from 1.
    return faces - 1 if faces.size and faces.min() == 1 and faces.max() == vertices else faces


def _placed(
    mean: Array,
    faces: Array,
    identity: Array,
    expression: Array,
    identity_names: tuple[str, ...],
    expression_names: tuple[str, ...],
    options: ConvertOptions,
) -> MorphableModel:
    mask = np.ones(len(mean), bool) if options.neck is None else mean[:, 1] > options.neck
    if not mask.any():
        low, high = mean[:, 1].min(), mean[:, 1].max()
        raise ShadowmapError(f"no vertex lies above {options.neck}: heights of this model go from {low:.4g} to {high:.4g}.")
    low, high = mean[mask].min(0), mean[mask].max(0)
    with np.errstate(over="ignore", invalid="ignore"):
        extent = float((high - low).max())
    if not (np.isfinite(extent) and extent > 0):
        raise ShadowmapError("the model's mean has no finite extent: check its vertices.")
    scale = 2 / extent

    def turned(points: Array) -> Array:
        x, y, z = np.moveaxis(points, -1, 0)
        return np.stack({"+x": (x, y, z), "-x": (-x, y, -z), "+z": (z, y, -x), "-z": (-z, y, x)}[options.facing], -1)

    return from_arrays(
        mean=turned((mean - 0.5 * (low + high)) * scale),
        faces=faces,
        identity=turned(identity * scale),
        expression=turned(expression * scale),
        identity_names=identity_names,
        expression_names=expression_names,
        mask=mask,
    )
