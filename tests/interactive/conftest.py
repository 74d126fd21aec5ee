"""Fixtures of the tests of modelling."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from browsers import browser
from model_fakes import FakeSession
from model_pages import Place, opened


@pytest.fixture
def fake() -> Iterator[FakeSession]:
    """A session with a stand-in for the optimiser, started."""
    session = FakeSession()
    session.session.start()
    yield session
    session.session.close()


@pytest.fixture(scope="module")
def instance() -> Iterator[Any]:
    with browser() as instance:
        yield instance


@pytest.fixture
def place(variant: str) -> Iterator[Place]:
    place = Place()
    yield place
    place.close()


@pytest.fixture
def page(instance: Any, place: Place) -> Iterator[Any]:
    with opened(instance, place) as page:
        yield page
