"""Branches whose sides read attached arrays, also in graphs that are traversed several times in forward mode."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import drjit as dr

from .kernel_inputs import with_current_inputs
from .types import Bool

_AGAIN: ContextVar[bool] = ContextVar("_AGAIN", default=False)


@contextmanager
def traversed_again() -> Iterator[None]:
    """Context in which branches suit graphs that are traversed in forward mode for one tangent after the other.

    Dr.Jit 1.5 refuses the second traversal of a symbolic branch that reads attached arrays which are not among its arguments.
    """
    token = _AGAIN.set(True)
    try:
        yield
    finally:
        _AGAIN.reset(token)


def branch(
    active: Bool,
    function: Callable[..., Any],  # Any: an array, or a tuple of arrays
    other: Callable[..., Any],
    arguments: Sequence[Any],
    label: str,
) -> Any:
    """``function(*arguments)`` where ``active``, ``other(*arguments)`` elsewhere. Attached, also to arrays that they read.

    A symbolic branch: groups of inactive lanes cost nothing. Within :func:`traversed_again` all lanes compute both; there
    ``function`` gets zeros for arguments of inactive lanes, and must allow for those.
    """
    if not _AGAIN.get():
        function, other = with_current_inputs(function), with_current_inputs(other)
        return dr.if_stmt(tuple(arguments), active, function, other, mode="symbolic", label=label)
    found = function(*(dr.select(active, argument, dr.zeros(type(argument))) for argument in arguments))
    rest = other(*arguments)
    if not isinstance(found, tuple):
        return dr.select(active, found, rest)
    return tuple(dr.select(active, one, two) for one, two in zip(found, rest, strict=True))
