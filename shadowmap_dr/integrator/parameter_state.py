"""Parameters of a Mitsuba object at one moment: whether they are still the same, and which carry gradients."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.pytree import cached_by_type
from ..jit.types import AnyArray
from ..scene.changes import leaves
from ..scene.mitsuba_objects import parameters
from ..scene.transforms import is_transform

# Bits of the number of a variable, above which that of its AD variable lies.
_AD = 32
# Roles of parameters: Python's numbers and other objects, transformations, other arrays.
_VALUE, _TRANSFORM, _ARRAY = range(3)


@cached_by_type
def _role_of(kind: type) -> int:
    if is_transform(kind):
        return _TRANSFORM
    return _ARRAY if dr.is_array_v(kind) else _VALUE


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
        return cls._of_values(parameters(node))

    @classmethod
    def _of_values(cls, values: dict[str, Any]) -> ParameterState:  # Any: parameters have values of all kinds
        numbers: dict[str, tuple[Any, ...]] = {}
        attached: list[str] = []
        held: list[AnyArray] = []
        array = mi.Float
        for name, value in values.items():
            kind = type(value)
            if kind is array:  # most are: these few lines are the fastest way
                if not value.index_ad:
                    held.append(array(value))
                    numbers[name] = (value.index,)
                    continue
                held.append(array(dr.detach(value)))
                if dr.grad_enabled(value):
                    attached.append(name)
                    numbers[name] = (value.index, True)
                else:
                    numbers[name] = (value.index,)
                continue
            role = _role_of(kind)
            if role == _VALUE:
                numbers[name] = (value,)
                continue
            if role == _TRANSFORM:
                value = value.matrix
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

    def with_values(self, values: dict[str, Any]) -> ParameterState:  # Any: as above
        """The same state with other values of some parameters."""
        new = self._of_values(values)
        attached = tuple(name for name in self.numbers if name in (new.attached if name in values else self.attached))
        return ParameterState(self.numbers | new.numbers, attached, self.held + new.held)

    def same_but_for(self, other: ParameterState, names: frozenset[str]) -> bool:
        """True if at most the parameters in ``names`` differ."""
        return self.numbers == other.numbers or (
            self.numbers.keys() == other.numbers.keys()
            and all(keys == other.numbers[name] for name, keys in self.numbers.items() if name not in names)
        )

    def same(self, other: ParameterState, names: Iterable[str] | None = None) -> bool:
        """True if parameters (all, or those in ``names``) are the same in both."""
        if names is None:
            return self.numbers == other.numbers
        return all(self.numbers.get(name) == other.numbers.get(name) for name in names)
