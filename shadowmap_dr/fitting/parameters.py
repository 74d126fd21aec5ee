"""Parameters of a scene that few numbers describe: their protocol, and colours, numbers and angles of view.

A fit's numbers are zero in the scene as it was given, and about one where much has changed: radians, shares of an extent,
logarithms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import drjit as dr
import numpy as np
import numpy.typing as npt

from ..jit.types import Float
from ..rendering.renderer import Renderer
from .scene_change import SceneChange
from .vary import Vary

Array = npt.NDArray[np.float64]
# Values between zero and one, by words of their names; other values that are positive stay positive.
_SHARES = (
    *("reflectance", "base_color", "albedo", "metallic", "specular_tint", "clearcoat", "sheen", "spec_tint", "flatness"),
    *("opacity", "weight", "spec_trans", "transmittance", "specular"),
)
_ROUGHNESS = ("alpha", "roughness")


def is_share(key: str) -> bool:
    """True if a parameter of Mitsuba's called ``key`` lies between zero and one: a reflectance, an opacity, a tint."""
    return any(word in _own_name(key) for word in _SHARES)


def is_roughness(key: str) -> bool:
    """True if a parameter of Mitsuba's called ``key`` is a roughness."""
    return any(word in _own_name(key) for word in _ROUGHNESS)


def _own_name(key: str) -> str:
    """The name that a parameter has in its material or light."""
    return next((part for part in reversed(key.split(".")) if part not in ("value", "data")), key)


@dataclass(frozen=True)
class Scale:
    """Relation between a fit's numbers x and the numbers that users read: offset + factor x, or offset exp(x).

    Attributes:
        offset: the scene's values, (n,).
        factor: units for a change of x by one, (n,).
        logarithmic: True for values that stay positive.
    """

    offset: Array
    factor: Array
    logarithmic: bool = False

    def shown(self, x: npt.ArrayLike) -> Array:
        """Values (n,) in units."""
        x = np.asarray(x, np.float64)
        return self.offset * np.exp(x) if self.logarithmic else self.offset + self.factor * x

    def widths(self, x: npt.ArrayLike, half: npt.ArrayLike) -> Array:
        """Half-widths (n,) in units of intervals about x."""
        return np.abs(self.shown(x) if self.logarithmic else self.factor) * np.asarray(half, np.float64)

    def number(self, value: float) -> Array:
        """The fit's numbers (n,) of a value in units; minus infinity for a bound of zero or less of positive values."""
        if not self.logarithmic:
            return np.asarray((value - self.offset) / self.factor)
        return np.log(np.maximum(value, 1e-300) / self.offset) if value > 0 else np.full(len(self.offset), -np.inf)


class Parameter(Protocol):
    """One entry of the list of things that vary, with n numbers.

    ``labels``, ``units``: of each number, for reports; ``scale``: units of the numbers; ``natural``: bounds (low, high) in units,
    from the meaning of the values; ``usual``: half ranges (n,) of starts, in the fit's own numbers.
    """

    @property
    def vary(self) -> Vary: ...

    @property
    def natural(self) -> tuple[float, float]: ...

    @property
    def kind(self) -> str: ...

    @property
    def labels(self) -> tuple[str, ...]: ...

    @property
    def units(self) -> tuple[str, ...]: ...

    @property
    def scale(self) -> Scale: ...

    @property
    def usual(self) -> Array: ...

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        """Write the change of numbers (Float of width 1 each, attached) into a :class:`SceneChange`."""

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        """Values for records and files, detached."""


@dataclass(frozen=True)
class FieldOfView:
    """Horizontal angle of view of a sensor; ``degrees``: the scene's."""

    vary: Vary
    sensor: int
    degrees: float
    natural: tuple[float, float] = (1.0, 170.0)
    labels: tuple[str, ...] = ("angle of view",)
    units: tuple[str, ...] = ("deg",)
    kind: str = "fov"

    @property
    def scale(self) -> Scale:
        return Scale(np.array([self.degrees]), np.array([self.degrees]), logarithmic=True)

    @property
    def usual(self) -> Array:
        return np.array([0.15])

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        record = change.camera(self.sensor)
        change.cameras[self.sensor] = replace(record, x_fov=record.x_fov * dr.exp(numbers[0]))

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        return {"value": np.array(dr.detach(change.camera(self.sensor).x_fov), np.float64)}


@dataclass(frozen=True)
class Value:
    """A colour or number: of Mitsuba's parameter ``key``, or of the ``field`` of the record of a light, if that is not "".

    ``start`` (n,); ``common``: one number, a factor of all values; ``logarithmic``: values stay positive.
    """

    vary: Vary
    key: str
    start: Array
    natural: tuple[float, float]
    logarithmic: bool
    light: str = ""
    field: str = ""
    common: bool = False
    unit: str = ""
    kind: str = "value"

    @property
    def labels(self) -> tuple[str, ...]:
        if self.common:
            return ("factor",)
        return ("red", "green", "blue") if len(self.start) == 3 else ("value",) if len(self.start) == 1 else _numbered(self.start)

    @property
    def units(self) -> tuple[str, ...]:
        return ("times",) if self.common else (self.unit,) * len(self.start)

    @property
    def scale(self) -> Scale:
        if self.common:
            return Scale(np.ones(1), np.ones(1), logarithmic=True)
        if self.logarithmic:
            return Scale(self.start, self.start, logarithmic=True)
        size = self.natural[1] - self.natural[0]
        return Scale(
            self.start, np.full(len(self.start), size if np.isfinite(size) else max(1.0, float(np.abs(self.start).max())))
        )

    @property
    def usual(self) -> Array:
        return np.full(len(self.labels), 0.5 if self.scale.logarithmic else 0.25)

    def put(self, numbers: Sequence[Float], change: SceneChange) -> None:
        scale, each = self.scale, (numbers[0],) * len(self.start) if self.common else numbers
        if self.common or self.logarithmic:
            parts = [float(start) * dr.exp(x) for start, x in zip(self.start, each, strict=True)]
        else:
            parts = [float(start) + float(factor) * x for start, factor, x in zip(self.start, scale.factor, each, strict=True)]
        if self.light:
            value = type(getattr(change.light(self.light), self.field))(*parts)
            change.lights[self.light] = replace(change.light(self.light), **{self.field: value})
        else:
            change.values[self.key] = parts

    def arrays(self, renderer: Renderer, change: SceneChange) -> dict[str, Array]:
        value = getattr(change.light(self.light), self.field) if self.light else change.values[self.key]
        if not self.light:
            return {"value": np.array([float(dr.detach(one)[0]) for one in value])}
        return {"value": np.array(dr.detach(value), np.float64).ravel()}


def _numbered(values: Array) -> tuple[str, ...]:
    return tuple(f"value {k}" for k in range(len(values)))
