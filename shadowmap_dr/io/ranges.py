"""Ranges of numbers in option records: declared with the fields, checked in one place for commands and Python alike."""

from __future__ import annotations

from dataclasses import fields
from numbers import Integral, Real
from typing import Any

from ..errors import ShadowmapError, quoted
from .options import Range, description

#: Usual ranges: sides of images and of shadow maps, sides of filters, samples per pixel, steps, runs, and seeds.
SIDE, MAP_SIDE, FILTER_SIDE, SAMPLES, STEPS, RUNS, SEED = (
    *((16, 4096), (8, 4096), (1, 255), (1, 65_536), (1, 1_000_000), (1, 1_000_000), (0, 2**31 - 1)),
)


def check_ranges(record: Any) -> None:  # Any: a dataclass
    """ShadowmapError, with option, value and range, for the first number of a record that lies outside of its range."""
    for declared in fields(record):
        of = description(declared)
        if of.allowed is not None:
            value = getattr(record, declared.name)
            option = of.names[0].split("/")[0] if of.names else f"--{declared.name.replace('_', '-')}"
            for number in value if isinstance(value, tuple) else () if value is None else (value,):
                check_range(f"{declared.name} ({option})", number, of.allowed)


def check_range(name: str, value: Any, allowed: Range) -> None:  # Any: what users give
    """ShadowmapError if a number is no (whole) number between two others, both included. NaN lies between none."""
    low, high = allowed
    whole = isinstance(low, int) and isinstance(high, int)
    kind = Integral if whole else Real
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:
        raise ShadowmapError(f"{name} is {quoted(value)}: give a {'whole ' if whole else ''}number from {low} to {high}.")
