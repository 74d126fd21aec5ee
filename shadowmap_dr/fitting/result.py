"""The result of a fit: estimates with their intervals, pictures, and the course of the optimisation; its file, fit.json."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..io.machine import header
from ..io.records import plain, read_json, write_json
from .changes import FittedScene

#: First entry of fit.json. The number grows when a reader of an earlier version could misread the file.
FORMAT = "shadowmap-dr fit 1"
#: Arrays of estimates that fit.json holds. Others (vertices, textures) have files of their own.
SMALL_ARRAYS = ("matrix", "pivot", "axes", "direction", "position", "value")

Numbers = npt.NDArray[np.float64]
#: Linear colours (H, W, 3), or numbers (H, W).
Image = npt.NDArray[np.floating[Any]]


class Step(TypedDict):
    """An entry of the history: the error after a step of one start.

    ``stage`` names the resolution ("32 px"), ``step`` counts within it. ``error`` is a fraction of the picture's brightness, as
    `Picture.error`. ``seconds`` have passed since the fit began.
    """

    start: int
    stage: str
    step: int
    error: float
    seconds: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """Numbers that a fit has found: an entry of ``--vary``, or the exposure of a picture.

    Attributes:
        name: "bunny:pose", "wall.bsdf.reflectance.value", "exposure of photo.png".
        kind: of the variation (pose, direction, value, texture, vertices, ...), or exposure, white balance or vignetting.
        labels: a name for each number ("rotation x"); none for large arrays.
        units: of each number: "deg", "stops", "" for units of the scene and plain numbers.
        values: (n,), in these units.
        start: (n,), from where the fit began.
        half_width: (n,), half of the 95 % interval; inf: the pictures do not determine the number. None: not estimated.
        arrays: "matrix" (4, 4): affine map, in world space, from the place in the scene file to the fitted one; "pivot" (3,) and
            "axes" (3, 3), columns: point and axes of rotations in the scene file; "direction" (3,), "position" (3,), "value"
            (n,), "vertices" (V, 3), "texture" (H, W, C).

    Raises ShadowmapError for arrays of different lengths.
    """

    name: str
    kind: str
    labels: tuple[str, ...]
    units: tuple[str, ...]
    values: Numbers
    start: Numbers
    half_width: Numbers | None = None
    arrays: Mapping[str, npt.NDArray[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shapes = {np.shape(numbers) for numbers in (self.values, self.start, self.half_width) if numbers is not None}
        count = len(self.values) if np.ndim(self.values) else -1
        if shapes != {(count,)} or len(self.labels) not in (0, count) or (self.labels and len(self.units) != count):
            raise ShadowmapError(
                f"the estimate {self.name!r} has arrays of the shapes {sorted(shapes)}, {len(self.labels)} labels and "
                f"{len(self.units)} units: give one of each for each number."
            )


@dataclass(eq=False)
class Picture:
    """A target, and the scene seen by the target's sensor. Images are linear and have the resolution of the fit.

    Attributes:
        target, start, fit: (H, W, 3); start and fit have the exposure of the photograph.
        weight: (H, W), 0 for pixels that do not count.
        shadows: (H, W), fraction of the light that arrives in the fitted scene: 0 in shadow, 1 where lit. None: not rendered.
        frames: texts and images (h, w, 3) for the film, from coarse to fine, in the order of the optimisation.
        name: file name of the target.
        exposure: factor of the rendered colours.
        stored_error: the error, where there are no pixels: in results that were read from a file.
    """

    target: Image
    start: Image
    fit: Image
    weight: Image
    shadows: Image | None = None
    frames: Sequence[tuple[str, Image]] = ()
    name: str = ""
    exposure: float = 1.0
    stored_error: float | None = None

    @property
    def error(self) -> float:
        """Weighted RMS difference of fit and target, as a fraction of the target's RMS: 0.1 is 10 % of its brightness.

        NaN if no pixel counts.
        """
        if self.stored_error is not None:
            return self.stored_error
        return relative_error(self.fit, self.target, self.weight)


def brightness(image: Image, weight: Image) -> float:
    """Weighted RMS of an image (H, W, C); NaN if no pixel counts."""
    total = float(np.sum(weight, dtype=np.float64))
    if not total > 0:
        return float("nan")
    finite = np.nan_to_num(image).astype(np.float64, copy=False)
    squares = np.einsum("ijk,ijk,ij->", finite, finite, weight)
    return float(np.sqrt(squares / total / image.shape[2]))


def relative_error(image: Image, target: Image, weight: Image) -> float:
    """Weighted RMS difference of two images (H, W, C), as a fraction of the target's RMS; inf for a black target."""
    difference = np.nan_to_num(image).astype(np.float64) - np.nan_to_num(target)
    error, reference = brightness(difference, weight), brightness(target, weight)
    if reference == 0:
        return float("inf") if error > 0 else 0.0
    return error / reference


@dataclass(eq=False)
class FitResult:
    """The estimates of a fit, and how it came to them.

    Attributes:
        found: True if the scene explains the pictures.
        words: plain sentences: numbers that are not determined, what went wrong, what to try.
        unexplained: share of the pictures' edges that the scene does not explain: of all that matter, or of those that one number
            moves, if that is larger.
        estimates: in the order of the command line.
        correlations: (n, n) over all labelled numbers, in order.
        names: of these n numbers.
        pictures: one a target.
        history: errors of all starts, for curves.
        seconds: of the whole fit.
        command: to reproduce it, quoted for a shell.
        settings: all options.
        made: version and machine of a result that was read from a file; empty: this version, on this machine.
        scene: the fitted scene, for :func:`~shadowmap_dr.fitting.write_fit`. None if the result was read from a file.
    """

    found: bool
    words: list[str]
    unexplained: float
    estimates: list[Estimate]
    correlations: Numbers
    names: list[str]
    pictures: list[Picture]
    history: list[Step]
    seconds: float
    command: str
    settings: dict[str, Any]
    made: dict[str, Any] = field(default_factory=dict)
    scene: FittedScene | None = None

    def to_json(self) -> dict[str, Any]:
        """The result as JSON values, as they stand in fit.json. Numbers that are not finite are None."""
        return {
            "format": FORMAT,
            **header(self.settings),
            **self.made,
            "found": bool(self.found),
            "words": list(self.words),
            "unexplained": plain(self.unexplained),
            "estimates": [_estimate_json(estimate) for estimate in self.estimates],
            "correlations": plain(self.correlations),
            "names": list(self.names),
            "pictures": [plain({"name": p.name, "exposure": p.exposure, "error": p.error}) for p in self.pictures],
            "history": plain(self.history),
            "seconds": plain(self.seconds),
            "command": self.command,
        }

    def write_json(self, path: str | os.PathLike[str]) -> None:
        """Write fit.json. Raises OutputError if it cannot be written."""
        write_json(path, self.to_json())


def _estimate_json(estimate: Estimate) -> dict[str, Any]:
    small = {name: estimate.arrays[name] for name in SMALL_ARRAYS if name in estimate.arrays}
    parts = ("name", "kind", "labels", "units", "values", "start", "half_width")
    entries: dict[str, Any] = plain({**{part: getattr(estimate, part) for part in parts}, **small})
    return entries


def read_fit(path: str | os.PathLike[str]) -> FitResult:
    """The result in a file fit.json. Its pictures have no pixels, and its estimates no large arrays.

    Raises ShadowmapError, which names the file, if it cannot be read or is none of this version.
    """
    record = read_json(path)
    found = record.get("format") if isinstance(record, dict) else None
    if found != FORMAT:
        kind = "it is no result of shadowmap-dr fit" if not str(found).startswith(FORMAT[:-1]) else f"its format is {found!r}"
        raise ShadowmapError(f"cannot read {path}: {kind}; give a fit.json of the format {FORMAT!r}.")
    try:
        return _result(record)
    except KeyError as error:
        raise ShadowmapError(f"cannot read {path}: the entry {error} is missing; write the file again.") from error
    except (TypeError, ValueError, AttributeError, ShadowmapError) as error:
        raise ShadowmapError(f"cannot read {path}: {' '.join(str(error).split()).rstrip('.')}; write it again.") from error


def _result(record: Mapping[str, Any]) -> FitResult:
    names = _texts(record["names"])
    correlations = _numbers(record["correlations"]) if names else np.zeros((0, 0))
    if correlations.shape != (len(names), len(names)):
        raise ValueError(f"there are correlations of the shape {correlations.shape} for {len(names)} numbers")
    return FitResult(
        found=_checked(record["found"], bool, "found"),
        words=list(_texts(record["words"])),
        unexplained=_number(record["unexplained"]),
        estimates=[_estimate(entry) for entry in record["estimates"]],
        correlations=correlations,
        names=list(names),
        pictures=[_picture(entry) for entry in record["pictures"]],
        history=[_step(entry) for entry in record["history"]],
        seconds=_number(record["seconds"]),
        command=_checked(record["command"], str, "command"),
        settings=_checked(record["settings"], dict, "settings"),
        made={key: record[key] for key in ("shadowmap_dr", "machine")},
    )


def _estimate(entry: Mapping[str, Any]) -> Estimate:
    half_width = entry["half_width"]
    return Estimate(
        _checked(entry["name"], str, "name"),
        _checked(entry["kind"], str, "kind"),
        _texts(entry["labels"]),
        _texts(entry["units"]),
        _numbers(entry["values"]),
        _numbers(entry["start"]),
        None if half_width is None else _numbers(half_width, missing=np.inf),
        {name: _numbers(entry[name]) for name in SMALL_ARRAYS if name in entry},
    )


def _picture(entry: Mapping[str, Any]) -> Picture:
    none = np.zeros((0, 0, 3), np.float32)
    return Picture(
        *(none, none, none, none[..., 0]),
        name=_checked(entry["name"], str, "name"),
        exposure=_number(entry["exposure"]),
        stored_error=_number(entry["error"]),
    )


def _step(entry: Mapping[str, Any]) -> Step:
    return {
        "start": _checked(entry["start"], int, "start"),
        "stage": _checked(entry["stage"], str, "stage"),
        "step": _checked(entry["step"], int, "step"),
        "error": _number(entry["error"]),
        "seconds": _number(entry["seconds"]),
    }


def _checked(value: Any, kind: type, name: str) -> Any:  # Any: JSON
    if not isinstance(value, kind):
        raise TypeError(f"{name} is {str(value)[:40]!r}")
    return value


def _texts(values: Any) -> tuple[str, ...]:  # Any: JSON
    return tuple(_checked(value, str, "an entry of a list of names") for value in _checked(values, list, "a list of names"))


def _number(value: Any, missing: float = np.nan) -> float:  # Any: JSON
    return missing if value is None else float(value)


def _numbers(values: Any, missing: float = np.nan) -> Numbers:  # Any: JSON
    """An array of nested lists, with a number for each null."""
    array = np.array(_checked(values, list, "a list of numbers"), dtype=np.float64)  # null becomes NaN
    return np.where(np.isnan(array), missing, array)
