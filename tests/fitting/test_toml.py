"""Settings as TOML, read back by Python's own parser."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowmap_dr.fitting.toml import to_toml

tomllib = pytest.importorskip("tomllib")  # from Python 3.11 on

_TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=6)
_VALUE = st.booleans() | st.integers(-(2**63), 2**63 - 1) | st.floats(allow_nan=False) | _TEXT
_VALUES = _VALUE | st.lists(_VALUE, max_size=3) | st.dictionaries(_TEXT, _VALUE | st.lists(_VALUE, max_size=2), max_size=3)


@given(settings=st.dictionaries(_TEXT, _VALUES, max_size=5))
def test_settings_are_read_as_they_were(settings: dict[str, Any]) -> None:
    assert tomllib.loads(to_toml(settings)) == settings


def test_paths_arrays_and_settings_without_a_value() -> None:
    settings = {"out": Path("a/b"), "none": None, "sizes": (1, np.float32(0.5)), "t": {"x": None, "y": 1}, "n": math.nan}
    found = tomllib.loads(to_toml(settings))
    assert math.isnan(found.pop("n"))
    assert found == {"out": "a/b", "sizes": [1, 0.5], "t": {"y": 1}}
    assert to_toml({}) == ""
    assert tomllib.loads(to_toml({"targets": [{"name": "a", "mask": None}]})) == {"targets": [{"name": "a"}]}
