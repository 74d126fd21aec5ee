"""The table of poses found: grouping, statistics, the comparison on the same starts, what is written."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.pose import table as pose_table
from shadowmap_dr.io import records as io_records


def record(method: str, run: int, degrees: float | None, **changes: Any) -> dict[str, Any]:
    """As the pose experiment writes it; the offset error is twice the number of degrees."""
    offset = None if degrees is None else 2 * degrees
    return {
        "object": "spot", "resolution": 128, "method": method, "run": run, "seed": 0, "start": [run / 10, 0.1, 0.2],
        "iterations": 2, "reference": "mitsuba", "shadow_only": False, "normals": "face", "settings": {"name": method},
        "final": [0, 0, 0], "rotation_error_deg": degrees, "translation_error_x100": offset,
        "recovered": degrees is not None and degrees < 0.15, "seconds_per_iteration": 0.25, "seconds_total": 1.0,
        "rotation_error_curve": [10, 1, degrees], "environment": {"mitsuba": "3", "load_average": 1.5}, **changes,
    }  # fmt: skip


def test_rows_have_means_medians_and_shares() -> None:
    records = [record("shadows", run, degrees) for run, degrees in enumerate((0.1, 0.2, 0.6))]
    (row,) = (row.plain() for row in pose_table.rows(records))
    assert row["mean"] == pytest.approx({"rotation_error_deg": 0.3, "translation_error_x100": 0.6})
    assert row["median"] == pytest.approx({"rotation_error_deg": 0.2, "translation_error_x100": 0.4})
    assert row["recovered"] == 1 and row["share_recovered"] == pytest.approx(1 / 3)
    assert row["runs"]["run"] == [0, 1, 2] and row["runs"]["start"][2] == [0.2, 0.1, 0.2]
    assert row["seconds_per_step"] is None and "load_average" not in row["environment"]


def test_times_come_from_runs_that_were_timed_alone() -> None:
    timed = [record("shadows", 0, 0.1, seconds_per_iteration=0.125, iterations=40), record("mitsuba", 0, 0.1)]
    (row,) = pose_table.rows([record("shadows", 0, 0.1, seconds_per_iteration=9.0)], timed)
    assert row.seconds == 0.125


def test_what_was_run_differently_is_a_row_of_its_own_and_the_last_of_two_records_counts() -> None:
    before_there_was_a_choice = record("shadows", 0, 0.5)
    del before_there_was_a_choice["normals"]
    records = [
        record("mitsuba", 0, 0.1), before_there_was_a_choice, record("shadows", 0, 0.1),
        record("shadows", 0, 0.2, normals="vertex"), record("shadows", 0, 0.3, reference="own"),
        record("shadows", 0, 0.4, shadow_only=True), record("shadows", 0, 0.6, resolution=64),
        record("shadows", 0, 0.7, object="hand"), record("shadows", 0, 0.8, reference="own", shadow_only=True),
    ]  # fmt: skip
    table = pose_table.rows(records)
    found = [(row.case, row.object, row.resolution, row.method, *row.errors("rotation_error_deg")) for row in table]
    assert found == [
        ("seen", "hand", 128, "shadows", 0.7), ("seen", "spot", 64, "shadows", 0.6), ("seen", "spot", 128, "shadows", 0.1),
        ("seen", "spot", 128, "mitsuba", 0.1), ("own-reference", "spot", 128, "shadows", 0.3),
        ("shadow-only", "spot", 128, "shadows", 0.4), ("vertex-normals", "spot", 128, "shadows", 0.2),
    ]  # fmt: skip


def test_runs_with_different_settings_are_no_row() -> None:
    with pytest.raises(ShadowmapError, match="runs 0 and 1 of shadows for spot at 128"):
        pose_table.rows([record("shadows", 0, 0.1), record("shadows", 1, 0.1, iterations=3)])


def test_what_was_measured_of_settings_makes_no_difference_but_the_variant_does() -> None:
    def proxy(residual: float) -> dict[str, Any]:
        return {"settings": {"proxy": {"distance": 3, "image_residual": residual}, "fair": residual > 1.5}}

    (row,) = pose_table.rows([record("mitsuba", run, 0.1, **proxy(residual)) for run, residual in enumerate((1, 2))])
    assert len(row.runs) == 2
    other = record("mitsuba", 1, 0.1, **proxy(1), environment={"variant": "cuda_ad_rgb"})
    with pytest.raises(ShadowmapError, match="different settings"):
        pose_table.rows([record("mitsuba", 0, 0.1, **proxy(1)), other])


def test_times_may_come_from_an_earlier_table(tmp_path: Path) -> None:
    records = [record("shadows", 0, 0.1)]
    pose_table.write(tmp_path, records, [record("shadows", 0, 0.1, seconds_per_iteration=0.125)])
    (row,) = pose_table.rows(records, pose_table.read([tmp_path]))
    assert row.seconds == 0.125
    pose_table.write(tmp_path, records)
    (row,) = pose_table.rows(records, pose_table.read([tmp_path]))
    assert row.seconds is None


def test_mitsuba_is_compared_on_the_starts_that_both_have() -> None:
    ours = [record("shadows", run, degrees) for run, degrees in enumerate((0.10, 0.11, 0.14, 5.0, 6.0))]
    theirs = [record("mitsuba", run, 0.10) for run in range(3)] + [record("mitsuba", 4, 9.0, start=[1, 1, 1])]
    (entry,) = pose_table.comparison(pose_table.rows(ours + theirs))
    assert entry["starts"] == [0, 1, 2] and entry["recovered_ours_and_mitsuba"] == [3, 3]
    assert entry["ours_less_mitsuba"] == pytest.approx({"rotation_error_deg": 0.01, "translation_error_x100": 0.02})
    assert entry["met"]

    for turned, shifted in ((0.16, 0.2), (0.1, 0.26)):  # by 0.06 too far in one of the two
        worse = [record("shadows", run, turned, translation_error_x100=shifted, recovered=True) for run in range(3)]
        assert not pose_table.comparison(pose_table.rows(worse + theirs))[0]["met"]
    lost = [*ours[:2], record("shadows", 2, 5.0)]  # the same median, a run fewer
    assert not pose_table.comparison(pose_table.rows(lost + theirs))[0]["met"]
    assert pose_table.comparison(pose_table.rows(ours)) == []
    smoother = [record("shadows", run, 0.01, settings={"samples_per_pixel": 4}) for run in range(3)]
    smooth = [record("mitsuba", run, 0.1, normals="vertex") for run in range(3)]
    both = pose_table.comparison(pose_table.rows(ours + theirs + smoother + smooth))
    assert [entry["case"] for entry in both] == ["seen", "four-samples"]
    assert both[1]["ours_less_mitsuba"]["rotation_error_deg"] == pytest.approx(-0.09)


def test_failed_runs_count_as_infinitely_far_off(tmp_path: Path) -> None:
    failed = record("shadows", 0, None, rotation_error_curve=[10, None, None])
    table = pose_table.write(tmp_path, [failed, record("shadows", 1, 0.1), record("shadows", 2, 0.1)])
    assert np.isinf(table[0].errors("rotation_error_deg")).tolist() == [True, False, False] and table[0].recovered() == 2
    row = io_records.read_json(tmp_path / "pose.json")["rows"][0]
    assert row["mean"]["rotation_error_deg"] is None and row["median"]["rotation_error_deg"] == 0.1


def test_program_writes_record_table_and_plots(tmp_path: Path) -> None:
    hidden = record("shadows", 0, 0.1, shadow_only=True)
    for name, records in {"a": [record("shadows", 0, 0.1)], "b": [record("mitsuba", 0, 0.125), hidden]}.items():
        # A list in earlier versions.
        io_records.write_json(tmp_path / name / "pose.json", records if name == "a" else {"runs": records})
    command = [sys.executable, "-m", "shadowmap_dr.experiments.pose.table", "a", "b", "--timed", "a", "--out", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    out = tmp_path / "out"
    assert {path.name for path in out.iterdir()} == {"pose.json", "pose-table.md", "pose-seen.png", "pose-shadow-only.png"}
    assert (out / "pose-table.md").read_text().strip() == done.stdout.strip()
    assert "| spot | 128 | shadows | 1 of 1 | 0.100 | 0.100 | 0.200 | 0.200 | 0.25 |" in done.stdout
    assert "| face | 1 | spot | 128 | 1 | 1, 1 | 0.100, 0.125 | 0.200, 0.250 | yes |" in done.stdout
    assert "| spot | 128 | 1/1: 0.100, 0.200 |  |  | 1/1: 0.125, 0.250 |  | 1/1: 0.100, 0.200 |" in done.stdout
    stored = json.loads((out / "pose.json").read_text())
    assert len(stored["rows"]) == 3 and len(stored["comparison"]) == 1


def test_a_table_goes_on_from_what_an_earlier_one_has(tmp_path: Path) -> None:
    first = [record("shadows", run, 0.1, rotation_error_curve=[10, 1.23456, 0.1]) for run in range(2)]
    old = pose_table.write(tmp_path / "old", [*first, record("mitsuba", 0, 0.3)], timed=first)
    again = record("shadows", 1, 0.2, seconds_per_iteration=7.0)
    failed = record("rasterizer", 0, None, rotation_error_curve=[10, None, None])
    io_records.write_json(tmp_path / "new" / "pose.json", [again, failed])
    table = pose_table.write(tmp_path / "out", pose_table.read([tmp_path / "old", tmp_path / "new"]))
    found = {row.method: row.errors("rotation_error_deg").tolist() for row in table}
    assert found == {"shadows": [0.1, 0.2], "rasterizer": [np.inf], "mitsuba": [0.3]}
    by_method = {row["method"]: row for row in io_records.read_json(tmp_path / "out" / "pose.json")["rows"]}
    assert by_method["shadows"]["runs"]["rotation_error_curve"] == [[10, 1.23, 0.1], [10, 1, 0.2]]
    assert by_method["rasterizer"]["runs"]["rotation_error_curve"] == [[10, None, None]]
    assert by_method["shadows"]["seconds_per_step"] == 0.25  # somebody took the time for the earlier table
    (mitsuba,) = (row for row in old if row.method == "mitsuba")
    assert by_method["mitsuba"] == mitsuba.plain()


def test_runs_of_several_seeds_and_plots_that_could_only_be_drawn_in_part_are_kept(tmp_path: Path) -> None:
    out = tmp_path / "out"
    pose_table.write(out, [record("shadows", 0, 0.1, seed=seed) for seed in (0, 1)])
    assert [(run["seed"], run["run"]) for run in pose_table.read([out])] == [(0, 0), (1, 0)]
    (out / "pose-seen.png").write_text("of all runs")
    pose_table.write(out, [*pose_table.read([out]), record("mitsuba", 0, 0.3, rotation_error_curve=None)])
    assert (out / "pose-seen.png").read_text() == "of all runs"


@pytest.mark.parametrize(
    "content",
    ['{"rows": [{}]}', '{"rows": [1]}', "{}", "[1]", '[{"object": "spot"}]', '[{"rotation_error_deg": 1}]', "nonsense"],
)
def test_unusable_folders(tmp_path: Path, content: str) -> None:
    with pytest.raises(ShadowmapError, match="no file"):
        pose_table.read([tmp_path])
    (tmp_path / "pose.json").write_text(content)
    with pytest.raises(ShadowmapError, match="pose.json"):
        pose_table.read([tmp_path])


@pytest.mark.parametrize("as_table", [False, True])
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("method", "x"),
        ("object", 3),
        ("resolution", None),
        ("shadow_only", None),
        ("settings", []),
        ("environment", "x"),
        ("seed", []),
    ]
    + [
        ("recovered", 2),
        ("normals", "x"),
        ("rotation_error_deg", [1, 2]),
        ("translation_error_x100", "x"),
        ("rotation_error_curve", 1),
    ],
)
def test_edited_records_are_refused(tmp_path: Path, name: str, value: object, as_table: bool) -> None:
    path = tmp_path / "pose.json"
    records = [record("shadows", 0, 0.1), record("shadows", 1, 0.2)]
    content: Any = {"rows": [row.plain() for row in pose_table.rows(records)]} if as_table else records
    path.write_text(json.dumps(content))
    assert len(pose_table.read([path])) == 2
    edited = content["rows"][0] if as_table else content[0]
    if as_table and name in edited["runs"]:
        edited["runs"][name] = [value, value]
    else:
        edited[name] = value
    path.write_text(json.dumps(content))
    with pytest.raises(ShadowmapError, match=r"pose\.json is no (table|list of records) of the pose experiment"):
        pose_table.read([path])
