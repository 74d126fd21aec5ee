"""Settings as TOML, for fit.toml."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

_BARE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")


def to_toml(settings: Mapping[str, Any]) -> str:
    """A document of settings: numbers, texts, truth values, paths, lists, mappings. Entries that are None are left out.

    Mappings in the settings become tables at the end.
    """
    single = {key: value for key, value in settings.items() if value is not None and not isinstance(value, Mapping)}
    lines = [f"{_key(key)} = {_value(value)}" for key, value in single.items()]
    for name, table in settings.items():
        if isinstance(table, Mapping):
            lines += [*([""] if lines else []), f"[{_key(name)}]"]
            lines += [f"{_key(key)} = {_value(value)}" for key, value in table.items() if value is not None]
    return "\n".join([*lines, ""]) if lines else ""


def _key(name: str) -> str:
    return name if name and _BARE.issuperset(name) else _text(name)


def _value(value: Any) -> str:  # Any: values of settings
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return _text(str(value))
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(_value(entry) for entry in value if entry is not None)}]"
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items() if entry is not None)
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, (int, float)):
        return repr(value)  # "inf" and "nan" are TOML's words as well
    raise TypeError(f"{type(value).__name__} is no value of TOML")


def _text(text: str) -> str:
    """A basic string. Its escapes are those of JSON, and that of DEL."""
    return json.dumps(text.encode(errors="replace").decode(), ensure_ascii=False).replace("\x7f", "\\u007f")
