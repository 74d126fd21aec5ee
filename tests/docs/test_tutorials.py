"""The notebooks in `docs/tutorials`, with fewer pixels, samples and steps, and the script that compares integrators on them."""

from __future__ import annotations

import base64
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import ShadowmapError
from shadowmap_dr.io import assets
from shadowmap_dr.io.records import read_json

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "tutorials"
# With a loop for any integrator and a recorded one, then those with a loop of their own.
RACED = ("pose", "shape", "curve")
OTHERS = ("torch", "sun", "art", "photo", "certainty", "own_loss")
FEW = {"type": "shadowmap", "area_light_samples": 4, "environment_light_samples": 8, "soft_map_resolution": 64}
PARAMETERS: dict[str, dict[str, Any]] = {
    "pose": {"resolution": 64, "steps": 36, "reference_samples": 256, "integrator": FEW},
    "shape": {
        "resolution": 32, "steps": 9, "fine_steps": 4, "reference_samples": 32, "subdivisions": 3, "picture_size": 32,
        "distance_samples": 2000, "integrator": FEW,
    },
    "curve": {"resolution": 48, "steps": 40, "reference_samples": 128, "check_samples": 32, "integrator": FEW},
    "torch": {"resolution": 32, "steps": 8, "batch": 2, "subdivisions": 3, "reference_samples": 8, "picture_size": 32},
    "sun": {"resolution": 32, "steps": 8, "texels": 20, "reference_samples": 32},
    "photo": {"width": 64, "height": 48, "starts": 1, "reference_samples": 64},
    "certainty": {"starts": 1, "reference_samples": 64},
    "own_loss": {"width": 80, "height": 60, "starts": 3, "reference_samples": 64},
    "art": {"resolution": 64, "rings": 12, "steps": 80, "picture_size": 32, "picture_samples": 2},
}  # fmt: skip
# Share of the start's errors that may be left.
LEFT = {"pose": (0.1, 0.15), "shape": (0.75, 0.95), "curve": (0.6,)}

if not FOLDER.is_dir():
    pytest.skip("no tutorials beside the tests", allow_module_level=True)


@pytest.fixture(autouse=True)
def modules(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Scripts of that folder import each other by name; figures are not shown."""
    matplotlib.use("Agg")
    monkeypatch.syspath_prepend(FOLDER)
    yield
    from matplotlib import pyplot

    pyplot.close("all")
    for name in ("notebooks", "compare"):
        sys.modules.pop(name, None)


def need(name: str) -> None:
    if name in ("shape", "art"):
        pytest.importorskip("cholespy", reason="pip install '.[test]'")
    if name == "torch":
        pytest.importorskip("torch", reason="pip install '.[torch]'")


def run_small(name: str, *skip: str) -> tuple[dict[str, Any], list[str]]:
    """A notebook's namespace and the lines that it prints, with small numbers, without cells that wait for Mitsuba's.

    ``skip``: tags of further cells that are left out.
    """
    need(name)
    import notebooks

    printed: list[str] = []
    path = FOLDER / f"{name}.ipynb"
    names = notebooks.run(path, skip={"mitsuba", *skip}, on_cell=lambda cell, text: printed.append(text), **PARAMETERS[name])
    return names, "".join(printed).splitlines()


@pytest.mark.parametrize("name", RACED)
def test_notebook_runs_frozen(name: str) -> None:
    """From the first cell to the last, but for those that wait for Mitsuba's integrator; all loops end near the truth."""
    names, lines = run_small(name)
    before = names["error"](np.array(names["start"]))
    results = [line for line in lines if line.startswith(next(iter(before)))]
    # Through `mi.render`, with several views in one call as well, frozen, and with a finer mesh.
    assert len(results) == (4 if name == "shape" else 2)
    for line in results:
        after = {key: float(value) for key, value in (part.split(": ") for part in line.split(", "))}
        for (key, start), share in zip(before.items(), LEFT[name], strict=True):
            assert after[key] < share * start, (key, start, after[key])


def test_network_is_trained_frozen() -> None:
    """Shadows come to overlap with those of pictures and with others; the shape comes nearer."""
    names, lines = run_small("torch")
    overlaps = [line.partition(": ")[2].split(", ") for line in lines if line.startswith("suns")]
    assert len(overlaps) == 2 and all(float(after) > float(before) + 5 for before, after in overlaps), overlaps
    assert names["chamfer"](names["found"]) < 0.9 * names["chamfer"](names["points"])


def test_sun_and_texture_are_recovered() -> None:
    """The suns come nearer; a factor of all light changes the picture of the known paint only."""
    names, _ = run_small("sun")
    suns, guess = names["SUNS"], names["GUESS"]
    off, before = (
        sum(names["angle"](k, found) for k in range(len(suns)))
        for found in (names["three"], {f"angles{k}": mi.Point2f(angles) for k, angles in enumerate(guess)})
    )
    assert off < 0.9 * before, (off, before)
    assert names["losses_of_three"][-1] < 0.5 * names["losses_of_three"][0]
    (quilt, statue), (scaled_quilt, scaled_statue) = names["errors"]
    assert scaled_quilt < 1.1 * quilt and scaled_statue > 1.4 * statue


def test_art_takes_both_shadows_frozen() -> None:
    names, _ = run_small("art")
    first, last = (names["kept"][step] for step in (0, names["steps"]))
    for start, end in zip(names["overlap"](first[1]), names["overlap"](last[1]), strict=True):
        assert end > 75 > start


def test_a_photo_becomes_a_scene() -> None:
    names, _ = run_small("photo", "run")
    turn, place, sun, exposure = names["errors"](names["result"])
    assert names["result"].found and turn < 1 and place < 0.03 and sun < 1.5 and abs(exposure) < 0.1
    assert (names["folder"] / "report.html").is_file()


def test_certainty_is_that_of_the_photos() -> None:
    """The text of the notebook says all of this."""
    names, _ = run_small("certainty")
    assert np.isinf(names["turned"].estimates[0].half_width).tolist() == [False, False, True, False, False, False]
    pair = "sun:brightness and exposure of the target cannot be told apart by the pictures."
    assert pair in names["alone"].words and not names["lit"].words
    alone, shadow, two = (result.estimates[0] for result in names["results"].values())
    assert two.half_width[1] < shadow.half_width[1] < 0.1 * alone.half_width[1]
    for found in (shadow, two):
        assert abs(found.values[1] - 0.2) < found.half_width[1]


def test_edges_find_what_colours_do_not() -> None:
    """The text of the notebook says all of this."""
    names, lines = run_small("own_loss", "run")
    assert not names["by_colours"].found and abs(names["off"](names["by_colours"])[0]) > 5
    turn, place = names["off"](names["by_edges"])
    assert names["by_edges"].found and abs(turn) < 0.5 and place < 0.02
    lids = {name: abs(result.estimates[0].values[0] - names["LID"]) for name, result in names["opened"].items()}
    assert names["opened"]["edges"].found and lids["edges"] < 1 and lids["colours"] > 2 * lids["edges"]
    assert "take a way through NumPy" in lines[-1]


def test_notebooks_are_whole_and_small() -> None:
    for name in (*RACED, *OTHERS):
        path = FOLDER / f"{name}.ipynb"
        notebook = json.loads(path.read_text())
        assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
        ids = [cell["id"] for cell in notebook["cells"]]
        assert len(set(ids)) == len(ids)
        code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
        assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1)), "run docs/tutorials/notebooks.py"
        outputs = [output for cell in code for output in cell["outputs"]]
        assert {output["output_type"] for output in outputs} == {"stream", "display_data"}
        assert path.stat().st_size < 250_000


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A notebook of three cells."""
    sources = (
        ("size = 2", ["parameters"]),
        ("import matplotlib.pyplot as plt\nplt.figure(figsize=(1, 1))\nprint(size)", []),
        ("size = 0", ["run"]),
    )
    cells = [{"cell_type": "markdown", "id": "title", "metadata": {}, "source": ["# Title"]}]
    for k, (source, tags) in enumerate(sources):
        cell = {"cell_type": "code", "id": f"c{k}", "execution_count": None, "metadata": {"tags": tags}, "outputs": []}
        cells.append(cell | {"source": source.splitlines(True)})
    path = tmp_path / "tiny.ipynb"
    path.write_text(json.dumps({"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}))
    return path


def test_cells_run_with_other_parameters(tiny: Path) -> None:
    import notebooks

    printed: list[tuple[int, str]] = []
    names = notebooks.run(tiny, skip={"run"}, on_cell=lambda cell, text: printed.append((cell.number, text)), size=5)
    assert names["size"] == 5 and printed == [(1, ""), (2, "5\n")]
    assert notebooks.run(tiny)["size"] == 0
    with pytest.raises(ShadowmapError, match=r"tiny.ipynb has no parameter 'length'"):
        notebooks.run(tiny, length=1)
    with pytest.raises(ShadowmapError, match="SOURCES.md is no notebook"):
        notebooks.run(assets.scenes_dir() / "meshes" / "SOURCES.md")


def test_outputs_are_stored(tiny: Path) -> None:
    import notebooks

    notebooks.store_outputs(tiny, size=7)
    title, *code = json.loads(tiny.read_text())["cells"]
    assert "outputs" not in title and [cell["execution_count"] for cell in code] == [1, 2, 3]
    text, figure = code[1]["outputs"]
    assert text == {"name": "stdout", "output_type": "stream", "text": ["7\n"]}
    assert base64.b64decode(figure["data"]["image/png"]).startswith(b"\x89PNG")
    assert code[0]["outputs"] == code[2]["outputs"] == []


def falling(integrator: dict[str, Any], steps: int, seed: int = 0) -> Iterator[Any]:
    """Errors as an integrator of so many samples might leave them; two samples fail with the last of three seeds."""
    samples = integrator.get("sppi", 100)
    floor = {1: 1.0, 2: 1.0 if seed == 2 else 0.01}.get(samples, 0.01)
    for step in range(steps):
        yield np.array([max(0.5**step, floor)])


def test_search_takes_the_cheapest_counts_that_succeed_with_all_seeds(monkeypatch: pytest.MonkeyPatch) -> None:
    import compare

    calls: list[int] = []

    def fake(name: str, image_samples: int) -> dict[str, Any]:
        calls.append(image_samples)
        return {"optimise": falling, "error": lambda state: {"off": float(state[0])}}

    monkeypatch.setattr(compare, "load", fake)
    problem = compare.Problem({"off": 0.1}, 40, tuple((1, 1, k, 10 + k) for k in (1, 2, 4, 8)))
    record: dict[str, Any] = {}
    saved: list[int] = []
    compare.search("fake", problem, record, 3, lambda: saved.append(len(record["search"])))
    assert record["fair"] == [1, 1, 4, 14] and calls == [11, 12, 14]
    tried = [(entry["counts"][2], entry["seed"], entry["solved"]) for entry in record["search"]]
    assert tried == [(1, 0, False), (2, 0, True), (2, 1, True), (2, 2, False), (4, 0, True), (4, 1, True), (4, 2, True)]
    assert saved == [1, 2, 3, 4, 5, 6, 7, 7]
    # What a search that was cut short has measured is not measured again.
    del record["search"][5:]
    calls.clear()
    compare.search("fake", problem, record, 3, lambda: None)
    assert calls == [14] and len(record["search"]) == 7 and record["fair"] == [1, 1, 4, 14]
    # Nothing helps: no setting.
    compare.search("fake", compare.Problem({"off": 0.001}, 20, problem.candidates[2:]), record := {}, 3, lambda: None)
    assert record["fair"] is None
    with pytest.raises(ShadowmapError, match="no setting is known that solves 'fake'"):
        compare.counts_for_race("fake", record)
    entries = [((1, 1, 2, 12), True), ((1, 1, 2, 12), False), ((1, 1, 4, 14), True), ((1, 1, 4, 14), True), ((1, 1, 8, 18), True)]
    record = {"fair": None, "search": [{"counts": list(counts), "solved": solved} for counts, solved in entries]}
    assert compare.counts_for_race("fake", record) == (1, 1, 4, 14)
    assert compare.counts_for_race("fake", {**record, "fair": [1, 1, 8, 18]}) == (1, 1, 8, 18)


def test_guiding_is_part_of_a_setting(variant: str) -> None:
    import compare

    assert compare.projective((1, 2, 3, 4)) == {"type": "direct_projective", "sppc": 1, "sppp": 2, "sppi": 3, "guiding": "none"}
    assert compare.projective((1, 2, 3, 4, "grid"))["guiding"] == "grid"
    guided = [counts for problem in compare.PROBLEMS.values() for counts in problem.candidates if len(counts) == 5]
    for counts in guided:
        assert mi.load_dict(compare.projective(counts)).guiding == counts[4]


def test_solved_means_ten_steps_in_a_row() -> None:
    import compare

    trace, bar = compare.Trace(), {"off": 0.1}
    steps = iter([1.0] * 3 + [0.05] * 20)
    while trace.advance(steps, lambda state: {"off": float(state)}) and not trace.within(bar):
        pass
    # The mean of the last ten, two of which are still 1, is 0.24; with one it is 0.145, without 0.05.
    assert len(trace.errors) == 13 and trace.record(bar)["seconds"] == pytest.approx(sum(trace.seconds))
    assert compare.Trace(trace.seconds, trace.states, [{"off": 1.0}] * 13).record(bar)["seconds"] is None


def test_race_of_frozen_and_drop_in_and_mitsuba(tmp_path: Path) -> None:
    """All three methods do step after step; with a bar this low each is done after ten."""
    import compare

    problem = compare.Problem({"degrees": 100.0, "100 x offset": 100.0}, 30, ())
    result = compare.race("pose", problem, (1, 1, 1, 4), resolution=32, reference_samples=16, integrator=FEW)
    assert list(result["methods"]) == list(compare.METHODS)
    for entry in result["methods"].values():
        assert entry["solved"] and entry["steps"] == compare.WINDOW
        assert entry["errors"][-1]["degrees"] < 0.8 * np.degrees(0.45)
        assert entry["seconds"] == pytest.approx(sum(entry["seconds_of_steps"])) and entry["seconds"] > 0
    theirs = result["methods"]["direct_projective"]["seconds"]
    assert result["times_faster"]["shadowmap"] == pytest.approx(theirs / result["methods"]["shadowmap"]["seconds"])
    compare.plot(tmp_path / "race.png", {"pose": {"race": result}, "shape": {}})
    assert (tmp_path / "race.png").stat().st_size > 1000


def test_stored_comparison_is_of_these_problems() -> None:
    """The documents' figures come from a search and a race that the script would accept as they are."""
    import compare

    if not compare.OUT.is_file():
        pytest.skip("not measured: run docs/tutorials/compare.py --search, then docs/tutorials/compare.py")
    stored = read_json(compare.OUT)
    assert list(stored) == list(compare.PROBLEMS)
    for name, record in stored.items():
        assert record["race"]["bar"] == dict(compare.PROBLEMS[name].bar)
        assert record["race"]["counts"] == record["fair"]
        passed = [entry["solved"] for entry in record["search"] if entry["counts"] == record["fair"]]
        assert len(passed) >= 3 and all(passed)
        assert record["race"]["methods"].keys() == {*compare.METHODS, *(compare.ONE_CALL if name == "shape" else ())}
