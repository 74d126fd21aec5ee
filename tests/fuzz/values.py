"""Random values, most of them at the edges of their ranges, and mutated files."""

from __future__ import annotations

import copy
import io
import re
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

_T = TypeVar("_T")

NUMBERS = (
    0.0,
    -0.0,
    1.0,
    -1.0,
    0.5,
    1e-3,
    1e3,
    1e-20,
    1e-38,
    1e-45,
    1e20,
    3e38,
    1e300,
    -1e300,
    float("nan"),
    float("inf"),
    -float("inf"),
)
INTEGERS = (0, 1, -1, 2, 3, 7, 16, 255, 256, 4095, 4096, 4097, 65535, 2**31 - 1, 2**31, 2**32, 2**63, 10**20, -(2**31), -(10**20))
#: Values of types that nobody expects.
OTHERS: tuple[Any, ...] = (
    None,
    "",
    "x",
    "7",
    True,
    [],
    {},
    (),
    [1, 2],
    {"a": 1},
    b"\xff",
    float("nan"),
    1 + 2j,
    object,
    np.array(1),
    "é\n",
)


def pick(rng: np.random.Generator, choices: Sequence[_T]) -> _T:
    """One of the choices."""
    return choices[int(rng.integers(len(choices)))]


def chance(rng: np.random.Generator, probability: float) -> bool:
    """True with a probability."""
    return bool(rng.random() < probability)


def number(rng: np.random.Generator) -> float:
    """A number, often an extreme one."""
    return pick(rng, NUMBERS) if chance(rng, 0.6) else float(rng.normal() * 10.0 ** rng.integers(-6, 7))


def integer(rng: np.random.Generator) -> int:
    """A whole number, often an extreme one."""
    return pick(rng, INTEGERS) if chance(rng, 0.6) else int(rng.integers(-10, 300))


def mutated(rng: np.random.Generator, data: bytes) -> bytes:
    """A file with one to four faults."""
    for _ in range(int(rng.integers(1, 5))):
        data = _FAULTS[int(rng.integers(len(_FAULTS)))](rng, data)
    return data


def mutated_text(rng: np.random.Generator, text: str) -> str:
    """A text with one to four faults, most of them in its numbers and words."""
    for _ in range(int(rng.integers(1, 5))):
        text = _TEXT_FAULTS[int(rng.integers(len(_TEXT_FAULTS)))](rng, text)
    return text


def changed_json(rng: np.random.Generator, value: Any) -> Any:
    """JSON with one to three entries replaced, removed or renamed, at any depth."""
    value = copy.deepcopy(value)
    for _ in range(int(rng.integers(1, 4))):
        value = _changed_entry(rng, value)
    return value


def changed_arrays(rng: np.random.Generator, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays of which one or two have other values, types or shapes, or other names."""
    changed = dict(arrays)
    for _ in range(int(rng.integers(1, 3))):
        name = pick(rng, tuple(changed))
        value = changed[name]
        choices = (
            value[:-1] if value.ndim else value,
            value.T,
            value.astype(str),
            value[:0] if value.ndim else value,
            np.array(3),
            np.array([]),
            value[None],
            np.full(value.shape, pick(rng, (np.nan, np.inf, -1.0, 1e30, 1e300))),
            np.full(value.shape, -1),
            np.ones(value.shape, bool),
            np.ones(value.shape, complex),
            np.full(value.shape, 10**9),
            np.full(value.shape, 200, np.uint8),
        )
        changed[name] = pick(rng, choices)
        if chance(rng, 0.2):
            changed[f"{name}x"] = changed.pop(name)
    return changed


def npz(arrays: dict[str, np.ndarray]) -> bytes:
    """Content of an .npz file."""
    buffer = io.BytesIO()
    named: dict[str, Any] = {**arrays}  # NumPy's stubs take named arrays for its own option
    np.savez(buffer, **named)
    return buffer.getvalue()


def _changed_entry(rng: np.random.Generator, value: Any) -> Any:
    """JSON with one entry changed, at a random depth."""
    if isinstance(value, (dict, list)) and value and chance(rng, 0.85):
        key: Any = pick(rng, tuple(value)) if isinstance(value, dict) else int(rng.integers(len(value)))
        if chance(rng, 0.15):
            entry = value.pop(key)
            if isinstance(value, dict) and chance(rng, 0.3):
                value[f"{key}x"] = entry
        else:
            value[key] = _changed_entry(rng, value[key])
        return value
    return pick(rng, (None, "", "x", 0, -1, 1.5, 10**30, True, [], {}, [None], {"a": 1}, float("nan"), 1e308, [[1, 2], [3]]))


def _place(rng: np.random.Generator, data: bytes) -> int:
    # Headers more often than the rest.
    end = len(data) if chance(rng, 0.5) else min(len(data), 200)
    return int(rng.integers(max(1, end)))


def _flip(rng: np.random.Generator, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if changed:
            changed[_place(rng, data)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _truncate(rng: np.random.Generator, data: bytes) -> bytes:
    return data[: _place(rng, data)]


def _overwrite(rng: np.random.Generator, data: bytes) -> bytes:
    at, length = _place(rng, data), int(pick(rng, (1, 2, 4, 8)))
    return data[:at] + pick(rng, (b"\xff", b"\x00", b"\x7f", b"\x80")) * length + data[at + length :]


def _insert(rng: np.random.Generator, data: bytes) -> bytes:
    at = _place(rng, data)
    return data[:at] + rng.bytes(int(rng.integers(1, 30))) + data[at:]


def _remove(rng: np.random.Generator, data: bytes) -> bytes:
    at = _place(rng, data)
    return data[:at] + data[at + int(rng.integers(1, 30)) :]


def _repeat(rng: np.random.Generator, data: bytes) -> bytes:
    at = _place(rng, data)
    return data[:at] + data[at : at + int(rng.integers(1, 200))] * int(rng.integers(2, 20)) + data[at:]


def _change_number(rng: np.random.Generator, data: bytes) -> bytes:
    """Another number in place of one of the text's."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data[:20_000]))
    if not found:
        return data
    at = pick(rng, found)
    new = str(integer(rng) if chance(rng, 0.6) else number(rng)).encode()
    return data[: at.start()] + new + data[at.end() :]


def _empty(rng: np.random.Generator, data: bytes) -> bytes:
    return pick(rng, (b"", b"\n", b"\x00" * 100, rng.bytes(300)))


_FAULTS = (_flip, _flip, _truncate, _overwrite, _overwrite, _insert, _remove, _repeat, _change_number, _change_number, _empty)


def _word(rng: np.random.Generator, text: str) -> str:
    """Another word in place of one."""
    found = list(re.finditer(r"[A-Za-z_]\w*", text))
    if len(found) < 2:
        return text
    at, new = (
        pick(rng, found),
        pick(rng, found)[0] if chance(rng, 0.7) else pick(rng, ("", "x", "é", "nan", "None", "\x00", "<", '"')),
    )
    return text[: at.start()] + new + text[at.end() :]


def _numbers(rng: np.random.Generator, text: str) -> str:
    return _change_number(rng, text.encode("utf-8", "surrogateescape")).decode("utf-8", "surrogateescape")


def _cut(rng: np.random.Generator, text: str) -> str:
    at = int(rng.integers(max(1, len(text))))
    return text[:at] + text[at + int(rng.integers(1, 40)) :]


def _double(rng: np.random.Generator, text: str) -> str:
    lines = text.splitlines(keepends=True) or [""]
    at = int(rng.integers(len(lines)))
    return "".join([*lines[:at], lines[at] * int(rng.integers(2, 5)), *lines[at + 1 :]])


def _drop_line(rng: np.random.Generator, text: str) -> str:
    lines = text.splitlines(keepends=True) or [""]
    at = int(rng.integers(len(lines)))
    return "".join([*lines[:at], *lines[at + 1 :]])


_TEXT_FAULTS = (_word, _word, _numbers, _numbers, _numbers, _cut, _double, _drop_line)
