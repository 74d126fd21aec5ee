"""Texts and leaves of records for recordings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import mitsuba as mi
import pytest

from shadowmap_dr.jit.frozen import take_apart


@dataclass(frozen=True)
class Inner:
    array: Any
    number: int = 1


@dataclass(frozen=True)
class Outer:
    first: Inner
    others: tuple[Any, ...] = ()
    name: str = "outer"


@dataclass
class Changing:
    value: int


class Described:
    """An object that gives its own text."""

    def __init__(self) -> None:
        self.now = 0

    def recording_text(self) -> str:
        return f"now {self.now}"


@dataclass(frozen=True)
class Holder:
    items: list[int] = field(default_factory=list)
    record: Any = None


def identities(record: Any) -> tuple[str, list[int]]:
    text, leaves = take_apart(record)
    return text, [id(leaf) for leaf in leaves]


def test_later_walks_find_the_same(variant: str) -> None:
    a, b = mi.Float(1, 2), mi.Float(3)
    record = Outer(Inner(a), (Inner(b, 2), a, None, "text"))
    first = identities(record)
    assert first[1] == [id(a), id(b)]
    for _ in range(3):
        assert identities(record) == first
        # Numbers of leaves go on from those before the record, and the same leaf has the same number.
        text, leaves = identities([b, record, record])
        assert leaves == [id(b), id(a)] and text.split()[1] == "#0" and text.count("#0") == 3 and text.count("#1") == 4


def test_copies_are_records_of_their_own(variant: str) -> None:
    a, b = mi.Float(1), mi.Float(2)
    record = Outer(Inner(a))
    for _ in range(3):
        take_apart(record)
    assert identities(replace(record, first=Inner(b, 7)))[1] == [id(b)]
    assert "7" in take_apart(replace(record, first=Inner(b, 7)))[0].split()


@pytest.mark.parametrize("kind", ["list", "record", "text"])
def test_what_changes_is_looked_at_each_time(variant: str, kind: str) -> None:
    changing, described, items = Changing(1), Described(), [1]
    record = Outer(Inner(mi.Float(1)), ({"list": Holder(items), "record": Holder([], changing), "text": described}[kind],))
    texts = []
    for k in range(4):
        changing.value = described.now = k
        items[:] = [k] * k
        texts.append(take_apart(record)[0])
    assert len(set(texts)) == 4
