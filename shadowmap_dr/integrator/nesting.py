"""Integrators of Mitsuba's that hold one of this package."""

from __future__ import annotations

import sys
from types import FrameType
from typing import Any

# Arguments that Mitsuba's own integrators hand over to those that they hold, all by position.
_ALL_ARGUMENTS = 6


class Nesting:
    """Tells ``aov``, which renders nested integrators as a whole, from integrators that only ask them for single rays.

    Both ask for rays; ``aov`` renders before. It is remembered by the object that ``mi.render`` was called with, as far as known.
    """

    def __init__(self) -> None:
        self._nested = False
        self._outer: set[int] = set()

    def note(self, arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
        """Tell of a call of ``render``. Mitsuba's ``mi.render`` and people give arguments by name, or not all of them."""
        if len(arguments) == _ALL_ARGUMENTS and not named:
            self._nested = True
            outer = _outer(sys._getframe(2))
            if outer is not None:
                self._outer.add(outer)

    def allows(self) -> bool:
        """True if rays may be asked for. Called by ``sample``."""
        outer = _outer(sys._getframe(2))
        return self._nested and (outer is None or outer in self._outer)


def _outer(frame: FrameType) -> int | None:
    """Identity of the integrator that ``mi.render`` works for, if it is what called."""
    integrator = getattr(frame.f_locals.get("self"), "integrator", None)
    return None if integrator is None else id(integrator)
