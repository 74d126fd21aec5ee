"""Texts and leaves of records for recordings."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

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


@dataclass(frozen=True)
class Often:
    """A record that stores its findings."""

    RECORDED_OFTEN: ClassVar[bool] = True

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


@pytest.mark.parametrize("kind", [Outer, Often])
def test_later_walks_find_the_same(variant: str, kind: type[Outer]) -> None:
    a, b = mi.Float(1, 2), mi.Float(3)
    record = kind(Inner(a), (Inner(b, 2), a, None, "text"))
    first = identities(record)
    assert first[1] == [id(a), id(b)]
    for _ in range(3):
        assert identities(record) == first
        # Numbers of leaves go on from those before the record, and the same leaf has the same number.
        text, leaves = identities([b, record, record])
        assert leaves == [id(b), id(a)]
        if kind is Outer:
            assert text.split()[1] == "#0" and text.count("#0") == 3 and text.count("#1") == 4


def test_records_that_share_leaves_differ_from_those_that_do_not(variant: str) -> None:
    """Also where the findings of a record are stored: which of its leaves came before is told each time."""
    a, b, c, d = (mi.Float(k) for k in range(4))
    record = Often(Inner(a), (b,))
    texts = [take_apart([other, record, last])[0] for other in (c, a, b) for last in (d, c, a, b) for _ in range(2)]
    assert texts[::2] == texts[1::2]
    # c, d | c, c | c, a | c, b | a, d = a, c | a, a | a, b | b, d = b, c | b, a | b, b
    assert len(set(texts)) == 10
    for other in (c, a):
        _, leaves = take_apart([other, record, b])
        assert [id(leaf) for leaf in leaves] == [id(x) for x in ((c, a, b) if other is c else (a, b))]


@pytest.mark.parametrize("kind", [Outer, Often])
def test_copies_are_records_of_their_own(variant: str, kind: type[Outer]) -> None:
    a, b = mi.Float(1), mi.Float(2)
    record = kind(Inner(a))
    for _ in range(3):
        take_apart(record)
    assert identities(replace(record, first=Inner(b, 7)))[1] == [id(b)]
    assert "7" in take_apart(replace(record, first=Inner(b, 7)))[0].split()


@pytest.mark.parametrize("outer", [Outer, Often])
@pytest.mark.parametrize("kind", ["list", "record", "text"])
def test_what_changes_is_looked_at_each_time(variant: str, kind: str, outer: type[Outer]) -> None:
    changing, described, items = Changing(1), Described(), [1]
    record = outer(Inner(mi.Float(1)), ({"list": Holder(items), "record": Holder([], changing), "text": described}[kind],))
    texts = []
    for k in range(4):
        changing.value = described.now = k
        items[:] = [k] * k
        texts.append(take_apart(record)[0])
    assert len(set(texts)) == 4
