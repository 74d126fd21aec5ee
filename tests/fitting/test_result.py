"""Results of fits: their file, and what it says of damaged ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fit_results import estimate, picture, result
from hypothesis import given
from hypothesis import strategies as st

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.result import FORMAT, Picture, read_fit


def test_the_file_holds_the_result(tmp_path: Path) -> None:
    made = result()
    made.write_json(tmp_path / "fit.json")
    stored = json.loads((tmp_path / "fit.json").read_text(encoding="utf-8"))
    assert stored["format"] == FORMAT and stored["settings"] == {"starts": 3, "vary": ["bunny:pose"]}
    assert {"shadowmap_dr", "machine", "command", "seconds", "history", "words", "found"} <= stored.keys()
    pose, wall = stored["estimates"]
    np.testing.assert_array_equal(pose["matrix"], made.estimates[0].arrays["matrix"])
    assert pose["half_width"][-1] is None and wall["half_width"] is None  # infinite; not estimated
    assert "vertices" not in wall and len(stored["pictures"]) == 1
    assert stored["pictures"][0]["error"] == pytest.approx(made.pictures[0].error)


def test_a_file_is_read_as_it_was_written(tmp_path: Path) -> None:
    made = result()
    made.write_json(tmp_path / "fit.json")
    found = read_fit(tmp_path / "fit.json")
    assert found.found and found.words == made.words and found.names == made.names and found.history == made.history
    for ours, theirs in zip(made.estimates, found.estimates, strict=True):
        assert (ours.name, ours.kind, ours.labels, ours.units) == (theirs.name, theirs.kind, theirs.labels, theirs.units)
        np.testing.assert_array_equal(ours.values, theirs.values)
    assert found.estimates[0].half_width is not None and np.isinf(found.estimates[0].half_width[-1])
    assert found.estimates[1].half_width is None
    assert found.to_json() == made.to_json()


def test_a_result_without_numbers(tmp_path: Path) -> None:
    """A fit of nothing but vertices has no correlations."""
    made = result(names=[], correlations=np.zeros((0, 0)), estimates=[], history=[], pictures=[])
    made.write_json(tmp_path / "fit.json")
    assert read_fit(tmp_path / "fit.json").correlations.shape == (0, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "shadowmap-dr fit 9"}, "its format is 'shadowmap-dr fit 9'"),
        ({"format": "else"}, "no result of shadowmap-dr fit"),
        ({"correlations": [[1.0]]}, "for 7 numbers"),
        ({"names": "abc"}, "a list of names is 'abc'"),
        ({"seconds": "soon"}, "could not convert"),
        ({"found": "yes"}, "found is 'yes'"),
        ({"estimates": [{}]}, "the entry 'half_width' is missing"),
        ({"estimates": [7]}, "not subscriptable"),
        ({"history": [{"start": None}]}, "start is 'None'"),
        ({"pictures": None}, "not iterable"),
    ],
)
def test_damaged_files_are_named_in_one_line(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = tmp_path / "fit.json"
    path.write_text(json.dumps({**result().to_json(), **change}), encoding="utf-8")
    with pytest.raises(ShadowmapError) as raised:
        read_fit(path)
    message = str(raised.value)
    assert words in message and str(path) in message and "\n" not in message


@pytest.mark.parametrize("content", ["", "[]", "null", "3", '"text"'])
def test_files_of_other_content(tmp_path: Path, content: str) -> None:
    (tmp_path / "fit.json").write_text(content, encoding="utf-8")
    with pytest.raises(ShadowmapError, match="cannot read"):
        read_fit(tmp_path / "fit.json")
    with pytest.raises(ShadowmapError, match="no file"):
        read_fit(tmp_path / "none.json")


_JSON = st.recursive(st.none() | st.booleans() | st.floats() | st.text(max_size=3), lambda inner: st.lists(inner, max_size=3))


@given(key=st.sampled_from(sorted(result().to_json())), value=_JSON)
def test_no_entry_ends_in_another_error(tmp_path_factory: pytest.TempPathFactory, key: str, value: Any) -> None:
    path = tmp_path_factory.mktemp("fits") / "fit.json"
    path.write_text(json.dumps({**result().to_json(), key: value}), encoding="utf-8")
    try:
        read_fit(path)
    except ShadowmapError as error:
        assert "\n" not in str(error)


def test_the_error_is_relative_to_the_counted_pixels() -> None:
    target, weight = np.full((4, 4, 3), 0.5, np.float32), np.ones((4, 4), np.float32)
    weight[0] = 0
    fit = target * np.float32(1.1)
    fit[0] = 100  # masked
    assert Picture(target, target, fit, weight).error == pytest.approx(0.1, rel=1e-5)
    assert Picture(0 * target, target, fit, weight).error == np.inf
    assert Picture(0 * target, target, 0 * target, weight).error == 0
    assert np.isnan(Picture(target, target, fit, 0 * weight).error)
    assert picture().error > 0


def test_estimates_of_unequal_lengths_are_refused() -> None:
    with pytest.raises(ShadowmapError, match="one of each"):
        estimate(start=np.zeros(2))
    with pytest.raises(ShadowmapError, match="one of each"):
        estimate(labels=("x",))
