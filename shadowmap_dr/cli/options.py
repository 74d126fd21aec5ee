"""Parameters of commands, made from the fields of the option records that experiments define."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Generic, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import typer

from ..io.options import Option, described

Variant = Annotated[str, typer.Option(metavar="NAME", help="Mitsuba variant; the cuda ones need an NVIDIA GPU.")]

# Any: these make types of parameters from those of fields; type checkers want types in annotations to be spelled out.
_ANNOTATED: Any = Annotated
_LIST: Any = list

# Words for values in the help, by type. Typer's own depend on its version, and name Python's types.
_METAVARS: dict[Any, str] = {int: "INTEGER", float: "NUMBER", str: "TEXT", Path: "PATH"}

R = TypeVar("R")
Command = Callable[..., None]


@dataclass(frozen=True)
class After:
    """Place of an option that belongs to no field, in the annotation of its parameter: after the option of this field."""

    field: str


@dataclass(frozen=True)
class Given(Generic[R]):
    """Values from the command line, for a command that makes its record itself.

    Attributes:
        record: class of the record.
        chosen: values of the fields whose options were given.
        full: defaults with ``--full``; empty without.
    """

    record: type[R]
    chosen: Mapping[str, Any]
    full: Mapping[str, Any]

    def __contains__(self, name: str) -> bool:
        """True if the option of a field was given."""
        return name in self.chosen

    def __getitem__(self, name: str) -> Any:  # Any: the record states the type
        """Value of a field: given, or the default."""
        return self.chosen.get(name, self.full.get(name, described(self.record)[name][0].default))

    def make(self, **changes: Any) -> R:  # Any: as above
        """The record. ``changes`` come before given values."""
        return self.record(**{**self.full, **self.chosen, **changes})


def from_record(*, first: Sequence[str] = (), full: str | None = None) -> Callable[[Command], Command]:
    """Decorate the function of a command, one of whose parameters is an option record or the `Given` of one.

    The command gets an option for each field that :func:`shadowmap_dr.io.options.option` describes, in the order of the fields,
    with those of ``first`` first. Parameters of the function before the record come before them, those after it after them or
    where `After` says.

    Args:
        full: help text of ``--full``, which comes before ``--out`` and replaces the defaults that have a value for it.
    """

    def decorate(function: Command) -> Command:
        hints = get_type_hints(function, include_extras=True)
        holder, record = next((name, kind) for name, hint in hints.items() if (kind := _record(hint)))
        options = described(record)
        presets = {name: option.full for name, (_, option) in options.items() if option.full is not MISSING}
        signature = _signature(function, holder, record, first, full)

        def command(*arguments: object, **named: object) -> None:
            bound = signature.bind(*arguments, **named)
            bound.apply_defaults()
            values = bound.arguments
            chosen = {name: _value(values.pop(name), *options[name]) for name in options}
            chosen = {name: value for name, value in chosen.items() if value is not MISSING}
            given = Given(record, chosen, presets if full is not None and values.pop("full") else {})
            function(**values, **{holder: given if get_origin(hints[holder]) is Given else given.make()})

        command.__name__, command.__doc__, command.__module__ = function.__name__, function.__doc__, function.__module__
        # Typer reads both.
        command.__signature__ = signature  # type: ignore[attr-defined]
        command.__annotations__ = {name: parameter.annotation for name, parameter in signature.parameters.items()}
        return command

    return decorate


def _signature(function: Command, holder: str, record: type[Any], first: Sequence[str], full: str | None) -> inspect.Signature:
    """Parameters of a command: those of its function, with those of the record's fields in place of ``holder``."""
    hints, types, options = get_type_hints(function, include_extras=True), get_type_hints(record), described(record)
    names = list(inspect.signature(function).parameters)
    own = {name: of.replace(annotation=hints[name]) for name, of in inspect.signature(function).parameters.items()}
    del own[holder]
    parameters = {**own, **{name: _parameter(*entry, types[name]) for name, entry in options.items()}}
    if full is not None:
        parameters["full"] = _flag("full", full)
    order = names[: names.index(holder)]
    for name in (*first, *(name for name in options if name not in first)):
        order += ["full"] if name == "out" and full is not None else []
        order += [name, *(other for other, of in own.items() if _after(of) == name)]
    order += [name for name in own if name not in order]
    kind = inspect.Parameter.POSITIONAL_OR_KEYWORD
    return inspect.Signature([parameters[name].replace(kind=kind) for name in order])


def _record(hint: object) -> type[Any] | None:
    """The record of a parameter that is a record or `Given` one."""
    kind = get_args(hint)[0] if get_origin(hint) is Given else hint
    return kind if isinstance(kind, type) and is_dataclass(kind) else None


def _after(parameter: inspect.Parameter) -> str | None:
    marks = getattr(parameter.annotation, "__metadata__", ())
    return next((mark.field for mark in marks if isinstance(mark, After)), None)


def _parameter(field: Field[Any], option: Option, kind: object) -> inspect.Parameter:
    """The parameter of a field. Its default is None, so that the record's default is in force."""
    name = field.name.replace("_", "-")
    if kind is bool and field.default is False:
        return _flag(field.name, option.help, option.names)
    names = option.names or (f"--{name}/--no-{name}" if kind is bool else f"--{name}",)
    repeated = get_origin(kind) is tuple
    single = _single(get_args(kind)[0] if repeated else kind)
    metavar = option.metavar
    if get_origin(single) is Literal:
        metavar = metavar or "|".join(map(str, get_args(single)))
        single = type(get_args(single)[0])
    if option.parse is not None:
        single = next(kind for name, kind in get_type_hints(option.parse).items() if name != "return")
    metavar = metavar or _METAVARS.get(single)
    info = typer.Option(*names, help=_help(field, option, names), metavar=metavar, show_default=False)
    annotation = _ANNOTATED[(_LIST[single] if repeated else single) | None, info]
    return inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _flag(name: str, help: str, names: Sequence[str] = ()) -> inspect.Parameter:
    annotation = Annotated[bool, typer.Option(*(names or (f"--{name.replace('_', '-')}",)), help=help)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=annotation)


def _single(kind: Any) -> Any:  # Any: a type
    """A type without None."""
    if get_origin(kind) in (Union, UnionType):
        return next(one for one in get_args(kind) if one is not NoneType)
    return kind


def _help(field: Field[Any], option: Option, names: Sequence[str]) -> str:
    shown = option.shown
    if shown is None and field.default is True:
        shown = names[0].partition("/")[0].lstrip("-")
    if shown is None and field.default not in (MISSING, None):
        values = field.default if isinstance(field.default, tuple) else (field.default,)
        shown = ", ".join(map(str, values))
    return f"{option.help}  [default: {shown}]" if shown else option.help


def _value(value: object, field: Field[Any], option: Option) -> object:
    """A field's value from that of its parameter; MISSING if the option was not given."""
    if value is None or (isinstance(value, list) and not value) or (value is False and field.default is False):
        return MISSING
    parse = option.parse or (lambda one: one)
    return tuple(parse(one) for one in value) if isinstance(value, list) else parse(value)
