"""Outcomes of cases: a right result, a refusal in one line, or a fault."""

from __future__ import annotations

from dataclasses import dataclass

RESULT, REFUSED, FAULT = "result", "refused", "fault"


@dataclass(frozen=True)
class Outcome:
    """Outcome of a case: one of the three above, with words about it."""

    kind: str
    text: str
    seconds: float = 0.0


class Refused(Exception):
    """A refusal that the case has found itself, such as the line of a command."""


class Wrong(Exception):
    """A result that cannot be right."""


def check(condition: object, text: str) -> None:
    """Raise Wrong with ``text`` unless a condition holds."""
    if not condition:
        raise Wrong(text)
