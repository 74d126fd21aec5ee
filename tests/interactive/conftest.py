"""Fixtures of the tests of modelling."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from model_fakes import FakeSession


@pytest.fixture
def fake() -> Iterator[FakeSession]:
    """A session with a stand-in for the optimiser, started."""
    session = FakeSession()
    session.session.start()
    yield session
    session.session.close()
