"""Parameters of a Mitsuba object at one moment: whether they are still the same, and which carry gradients."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.types import AnyArray
from ..scene.changes import leaves
from ..scene.mitsuba_objects import parameters

# Bits of the number of a variable, above which that of its AD variable lies.
_AD = 32


@dataclass(frozen=True)
class ParameterState:
    """Parameters of a Mitsuba object and its children, by their relative names.

    Attributes:
        numbers: keys of the parameters. A parameter's keys at two moments are equal only if it was given no other value in
            between. Arrays count by identity and by whether they are attached.
        attached: names of the parameters through which gradients flow.
        held: the arrays, detached. Holding them keeps their variables' numbers from being used again. No AD variable is held:
            Mitsuba's integrators, which clear the AD graph in forward mode, would fail on it.
    """

    numbers: dict[str, tuple[Any, ...]]
    attached: tuple[str, ...]
    held: list[AnyArray]

    @classmethod
    def of(cls, node: mi.Object) -> ParameterState:
        """The current parameters."""
        numbers: dict[str, tuple[Any, ...]] = {}
        attached: list[str] = []
        held: list[AnyArray] = []
        array = mi.Float
        for name, value in parameters(node).items():
            if isinstance(value, array):  # most are: these few lines are the fastest way
                held.append(array(dr.detach(value) if value.index_ad else value))
                if dr.grad_enabled(value):
                    attached.append(name)
                    numbers[name] = (value.index, bool(value.index_ad))
                else:
                    numbers[name] = (value.index,)
                continue
            value = getattr(value, "matrix", value)
            if not dr.is_array_v(value):
                numbers[name] = (value,)
                continue
            if not dr.is_jit_v(value):
                numbers[name] = tuple(map(tuple, leaves(type(value)(value))))
                continue
            which = dr.detail.collect_indices(value)  # of all variables, each with the number of its AD variable above it
            if max(which, default=0) >> _AD == 0:
                held.append(type(value)(value))
                numbers[name] = tuple(which)
                continue
            held.append(type(value)(dr.detach(value)))
            attached.append(name)
            numbers[name] = (*(number & ((1 << _AD) - 1) for number in which), *(number >> _AD > 0 for number in which))
        return cls(numbers, tuple(attached), held)

    def same(self, other: ParameterState, names: Iterable[str] | None = None) -> bool:
        """True if parameters (all, or those in ``names``) are the same in both."""
        if names is None:
            return self.numbers == other.numbers
        return all(self.numbers.get(name) == other.numbers.get(name) for name in names)
