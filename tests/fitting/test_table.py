"""The table of estimates, and numbers rounded by their intervals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from fit_results import estimate, result, vertices
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from shadowmap_dr.fitting.table import NOT_DETERMINED, directions, rounded, rows, table


@pytest.mark.parametrize(
    ("value", "half_width", "shown"),
    [
        (0.1234, 0.01, ("0.12", "0.01")),
        (0.1234, 0.014, ("0.123", "0.014")),
        (0.1234, 0.0299, ("0.12", "0.03")),
        (1234.5, 120, ("1230", "120")),
        (1234.5, 380, ("1200", "400")),
        (99.99, 0.1, ("100.0", "0.1")),
        (-0.0001, 0.01, ("0.00", "0.01")),
        (0.5, 100, ("0", "100")),
        (0.5, 0, ("0.5", "0")),
        (100, 0, ("100", "0")),
        (0, 0, ("0", "0")),
        (0, 1e-9, ("0", "1e-9")),
        (0.123456789, 1e-9, ("0.1234568", "1e-9")),
        (2.5e-9, 1.4e-10, ("2.50e-9", "1.4e-10")),
        (1.2345e8, 2e6, ("1.23e8", "2e6")),
        (0.123456, None, ("0.1235", "")),
        (123456.7, None, ("123457", "")),
        (0.123456, math.inf, ("0.1235", NOT_DETERMINED)),
        (0.123456, math.nan, ("0.1235", NOT_DETERMINED)),
        (math.nan, 0.1, ("no number", "0.1")),
        (-math.inf, None, ("-∞", "")),
    ],
)
def test_numbers_are_rounded_by_their_intervals(value: float, half_width: float | None, shown: tuple[str, str]) -> None:
    assert rounded(value, half_width) == shown


@given(value=st.floats(-1e12, 1e12), half_width=st.floats(0, 1e12))
def test_rounding_is_small_beside_the_interval(value: float, half_width: float) -> None:
    shown, width = (float(text) for text in rounded(value, half_width))
    assert abs(shown - value) <= 0.51 * width + 1e-6 * abs(value)
    assert width == pytest.approx(half_width, rel=0.17)


@settings(max_examples=300)
@given(value=st.floats() | st.just(0.0), half_width=st.none() | st.floats())
def test_all_numbers_have_texts(value: float, half_width: float | None) -> None:
    assert all(len(text) <= 16 for text in rounded(value, half_width))


def test_rows() -> None:
    first, *_, last = rows(estimate())
    assert first == ("bunny:pose", "rotation x", "0", "0.12", "0.01", "deg")
    assert last == ("bunny:pose", "translation z", "0", "-0.125", NOT_DETERMINED, "")
    assert all(row.half_width == "" for row in rows(estimate(half_width=None)))


def test_large_arrays_have_one_row() -> None:
    assert rows(vertices()) == [("bunny:vertices", "5 vertices", "", "RMS change 0.5", "", "")]
    widths = np.full(15, 0.02)
    assert rows(vertices(half_width=widths))[0].half_width == "median 0.02"
    widths[:3] = np.inf
    assert rows(vertices(half_width=widths))[0].half_width == "median 0.02, 3 not determined"
    assert rows(vertices(half_width=np.full(15, np.inf)))[0].half_width == NOT_DETERMINED
    none = {"values": np.zeros(0), "start": np.zeros(0)}
    texture = vertices(kind="texture", arrays={"texture": np.zeros((8, 16, 3))}, **none)
    assert rows(texture)[0][1:4] == ("16 x 8 pixels", "", "")
    assert rows(vertices(arrays={}))[0].what == "15 numbers"


def test_the_table_names_each_estimate_once() -> None:
    console = Console(width=120)
    with console.capture() as captured:
        console.print(table(result()))
    text = captured.get()
    assert text.count("bunny:pose") == 1 and "not determined" in text and "± 95 %" in text
    with console.capture() as captured:
        console.print(table(result(found=False)))
    assert "No fit was found" in captured.get()


def test_directions_of_lights_have_lines() -> None:
    sun = estimate(name="sun:direction", kind="direction", arrays={"direction": np.array([0.6, 0.0, -0.8])})
    assert directions(result(estimates=[estimate(), sun])) == ["sun:direction: light travels along (0.6, 0, -0.8)."]
