"""Settings as TOML, for fit.toml."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from ..io.records import plain

_BARE = frozenset("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")


def to_toml(settings: Mapping[str, Any]) -> str:
    """A document of settings: numbers, texts, truth values, paths, lists, mappings. Entries that are None are left out.

    Mappings in the settings become tables at the end.
    """
    finite = {key: value if isinstance(value, float) else plain(value) for key, value in settings.items()}
    lines = [f"{_key(key)} = {_value(value)}" for key, value in finite.items() if not isinstance(value, (dict, type(None)))]
    for name, table in finite.items():
        if isinstance(table, dict):
            lines += ["", f"[{_key(name)}]"] if lines else [f"[{_key(name)}]"]
            lines += [f"{_key(key)} = {_value(value)}" for key, value in table.items() if value is not None]
    return "\n".join([*lines, ""]) if lines else ""


def _key(name: str) -> str:
    return name if name and _BARE.issuperset(name) else _text(name)


def _value(value: Any) -> str:  # Any: JSON
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else f"{'-' if value < 0 else ''}inf"
    if isinstance(value, list):
        return f"[{', '.join(_value(entry) for entry in value if entry is not None)}]"
    if isinstance(value, dict):
        inner = ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items() if entry is not None)
        return f"{{ {inner} }}" if inner else "{}"
    return repr(value)


def _text(text: str) -> str:
    """A basic string. Its escapes are those of JSON, and that of DEL."""
    return json.dumps(text.encode(errors="replace").decode(), ensure_ascii=False).replace("\x7f", "\\u007f")
