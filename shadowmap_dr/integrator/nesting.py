"""Integrators of Mitsuba's that contain the plug-in."""

from __future__ import annotations

import sys
from types import FrameType

# Number of arguments that Mitsuba's own integrators pass to nested integrators, all by position.
_ALL_ARGUMENTS = 6


class Nesting:
    """Distinction of ``aov``, which renders nested integrators as a whole, from integrators that only sample rays of them.

    Both sample rays, but ``aov`` renders before. It is remembered as the integrator that ``mi.render`` was called with, if known.
    """

    def __init__(self) -> None:
        self._nested = False
        self._outer: set[int] = set()

    def note(self, arguments: tuple[object, ...], named: dict[str, object]) -> None:
        """Register a call of ``render``. Calls from ``mi.render`` and from users pass arguments by name, or fewer of them."""
        if len(arguments) == _ALL_ARGUMENTS and not named:
            self._nested = True
            outer = _outer(sys._getframe(2))
            if outer is not None:
                self._outer.add(outer)

    def allows(self) -> bool:
        """True if rays may be sampled. Called by ``sample``."""
        outer = _outer(sys._getframe(2))
        return self._nested and (outer is None or outer in self._outer)


def _outer(frame: FrameType) -> int | None:
    """Identity of the integrator that ``mi.render`` renders with, if ``frame`` is its frame."""
    integrator = getattr(frame.f_locals.get("self"), "integrator", None)
    return None if integrator is None else id(integrator)
