"""Descriptions of options, kept with the fields of option records: a command makes its parameters from them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, TypeVar

_T = TypeVar("_T")
#: Least and largest value, both included; whole numbers if both are.
Range = tuple[float, float]
# No default. Any: takes the place of a value of the field's type.
_NONE: Any = MISSING
# Place of a description in a field's metadata.
_KEY = "option"


@dataclass(frozen=True)
class Option:
    """Description of a field of an option record.

    Attributes:
        help: text of the help, without the default.
        full: default with ``--full``; MISSING: the same as without.
        names: names on the command line; (): made from the field's name.
        metavar: word for the value in the help; None: by the field's type.
        shown: the default in the help; None: as Python prints it.
        parse: function from a value of the command line to one of the field, for each value of a tuple. The command line takes
            values of the type of its parameter.
        allowed: range of the number, or of each of a tuple, on the command line and in Python (`io.ranges.check_ranges`).
        listed: False for fields that only Python sets.
    """

    help: str
    full: object
    names: tuple[str, ...] = ()
    metavar: str | None = None
    shown: str | None = None
    parse: Callable[[Any], Any] | None = None
    allowed: Range | None = None
    listed: bool = True


def option(
    default: _T = _NONE,
    *,
    help: str,
    names: Iterable[str] = (),
    choices: Iterable[str] = (),
    metavar: str | None = None,
    shown: str | None = None,
    full: _T = _NONE,
    parse: Callable[[Any], Any] | None = None,
    allowed: Range | None = None,
) -> _T:
    """A field of a record that is an option of a command, see :class:`Option`. Without a default, the field needs a value.

    ``choices`` are shown in the help in place of ``metavar``; those of a ``Literal`` are known. The record checks them.
    """
    metavar = "|".join(choices) or metavar
    return _described(default, Option(help, full, tuple(names), metavar, shown, parse, allowed))


def setting(default: _T = _NONE, *, help: str, allowed: Range | None = None) -> _T:
    """A field of a record that has no option: only Python sets it."""
    return _described(default, Option(help, MISSING, allowed=allowed, listed=False))


def description(of: Field[Any]) -> Option:
    """Description of a field, empty if it was made by neither `option` nor `setting`."""
    return of.metadata.get(_KEY, Option("", MISSING, listed=False))


def described(record: type[Any]) -> dict[str, tuple[Field[Any], Option]]:
    """Fields of a record that are options, by name, with their descriptions."""
    return {f.name: (f, description(f)) for f in fields(record) if description(f).listed}


def _described(default: Any, of: Option) -> Any:  # Any: to type checkers, a value of the field's type
    return field(default=default, metadata={_KEY: of})
