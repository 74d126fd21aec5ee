"""Statements of the things that a fit varies: names, kinds, bounds, priors and ranges of starts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from ..errors import ShadowmapError, did_you_mean, quoted, shortened

#: Kinds of variation -> what varies.
KINDS = {
    "pose": "rotation and translation of a shape, a light or a camera",
    "rotation": "rotation about axes of the world through the middle of a shape; cameras and lights turn about their own axes",
    "translation": "offset along axes of the world",
    "scale": "size of a shape, about its middle",
    "direction": "direction of a directional light or a spot light",
    "position": "place of a light or a shape: the same as translation",
    "value": "colour or number of a material or a light",
    "brightness": "common factor of a light's or a material's colour",
    "fov": "angle of view of a camera",
    "sky": "brightness of an environment",
    "texture": "all values of a texture or another array",
    "vertices": "all vertices of a mesh",
}
_WITH_AXES = ("rotation", "translation", "position")
_OPTIONS = {"min": "low", "max": "high", "prior": "prior", "spread": "spread"}
_PUNCTUATION = "A name with a colon or a comma goes into fit.toml, as name = ..."
# Largest size of numbers: squares of such colours are numbers in single precision.
_LARGEST = 1e12


def _is_finite(value: object) -> bool:
    """True for finite numbers; False for integers beyond the largest float, too."""
    try:
        return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:
        return False


@dataclass(frozen=True)
class Vary:
    """One entry of the list of things that vary.

    Attributes:
        name: id of a shape, a light or a sensor, a pattern of ids (``car_*``) of shapes that move together, or a name of
            ``mi.traverse(scene)``, whose last part ``.value`` may be left out.
        kind: one of :data:`KINDS`, or "" for the usual one of the object.
        axes: axes of a rotation or a translation; all three if empty.
        low, high: bounds of the fitted values, in the units of the report (degrees, scene units, the value's own).
        prior: standard deviation of a Gaussian prior about the scene's value, same units; None for none.
        spread: half of the range of starts about the scene's value, same units (a factor where values are logarithmic).
    """

    name: str
    kind: str = ""
    axes: str = ""
    low: float | None = None
    high: float | None = None
    prior: float | None = None
    spread: float | None = None

    def __post_init__(self) -> None:
        if not self.name:
            raise ShadowmapError(f"vary {quoted(self.label)}: the name is missing; write NAME:KIND, for instance bunny:pose.")
        if self.kind and self.kind not in KINDS:
            known = ", ".join(KINDS)
            raise ShadowmapError(
                f"{self.named}: there is no kind {quoted(self.kind)}: choose from {known}.{did_you_mean(self.kind, KINDS)}"
            )
        if self.axes and self.kind not in _WITH_AXES:
            raise ShadowmapError(f"{self.named}: only {', '.join(_WITH_AXES)} have axes.")
        if set(self.axes) - set("xyz") or len(set(self.axes)) != len(self.axes):
            raise ShadowmapError(f"{self.named}: axes are letters out of xyz, for instance x or xz.")
        for name in ("low", "high", "prior", "spread"):
            value = getattr(self, name)
            if value is not None and not _is_finite(value):
                raise ShadowmapError(f"{self.named}: {name} is {quoted(value)}; give a finite number.")
            if value is not None and abs(value) > _LARGEST:
                raise ShadowmapError(f"{self.named}: {name} is {value:g}; give a number of a size up to {_LARGEST:g}.")
        for name in ("prior", "spread"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ShadowmapError(f"{self.named}: {name} is {value:g}; give a positive number.")
        if self.low is not None and self.high is not None and self.low >= self.high:
            raise ShadowmapError(f"{self.named}: min is {self.low:g} and max is {self.high:g}; give min below max.")

    @property
    def label(self) -> str:
        """The entry as users write it, without options."""
        return ":".join(part for part in (self.name, self.kind, self.axes) if part)

    @property
    def named(self) -> str:
        """The entry in messages, shortened."""
        return f"vary {shortened(self.label)}"

    @classmethod
    def parse(cls, text: str) -> Vary:
        """Parse ``NAME[:KIND[:AXES]][,min=NUMBER][,max=NUMBER][,prior=NUMBER][,spread=NUMBER]``.

        Raises:
            ShadowmapError: The text has another form, with the part that was not understood.
        """
        head, *options = text.split(",")
        name, _, rest = head.strip().partition(":")
        kind, _, axes = rest.partition(":")
        values: dict[str, Any] = {}
        for option in options:
            key, equals, value = option.strip().partition("=")
            if key not in _OPTIONS or not equals:
                raise ShadowmapError(
                    f"vary {shortened(text)}: {quoted(option.strip())} is not understood: write {', '.join(_OPTIONS)} = a "
                    f"number. {_PUNCTUATION}"
                )
            try:
                values[_OPTIONS[key]] = float(value)
            except ValueError:
                raise ShadowmapError(f"vary {shortened(text)}: {key} is {quoted(value)}; give a number.") from None
        try:
            return cls(name, kind, axes, **values)
        except ShadowmapError as error:
            if not kind or kind in KINDS:
                raise
            raise ShadowmapError(f"{error} {_PUNCTUATION}") from None

    @classmethod
    def of(cls, entry: str | Mapping[str, Any] | Vary) -> Vary:
        """An entry given as text, as a mapping of the fields (``min`` and ``max`` for ``low`` and ``high``), or as a record."""
        if isinstance(entry, Vary):
            return entry
        if isinstance(entry, str):
            return cls.parse(entry)
        if not isinstance(entry, Mapping):
            raise ShadowmapError(
                f"vary: {quoted(entry)} is a {type(entry).__name__}; give text such as 'bunny:pose', or a mapping."
            )
        known = [field.name for field in fields(cls)]
        values = {_OPTIONS.get(key, key): value for key, value in entry.items()}
        for key in values:
            if key not in known:
                raise ShadowmapError(f"vary: there is no key {quoted(key)}: there are name, kind, axes, {', '.join(_OPTIONS)}.")
        for key in ("name", "kind", "axes"):
            if not isinstance(values.get(key, ""), str):
                raise ShadowmapError(f"vary: {key} is {quoted(values[key])}; give text.")
        return cls(**{"name": "", **values})

    def plain(self) -> dict[str, Any]:
        """The fields that are set, with the names of files: ``min`` and ``max``."""
        names = {field: key for key, field in _OPTIONS.items()}
        return {names.get(f.name, f.name): getattr(self, f.name) for f in fields(self) if getattr(self, f.name) not in (None, "")}
