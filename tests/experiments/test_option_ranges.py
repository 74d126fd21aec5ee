"""Numbers that no experiment can use: one line that names option, value and range, in commands and in Python."""

from __future__ import annotations

import dataclasses
import re
import sys
from typing import Any

import numpy as np
import pytest

from shadowmap_dr.cli import main
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.art.experiment import ArtOptions
from shadowmap_dr.experiments.faces.experiment import FaceOptions
from shadowmap_dr.experiments.faces.image import ImageOptions
from shadowmap_dr.experiments.gradients.convergence import ConvergenceOptions
from shadowmap_dr.experiments.gradients.jacobian import JacobianOptions
from shadowmap_dr.experiments.gradients.plane import PlaneOptions
from shadowmap_dr.experiments.lights.experiment import LightOptions
from shadowmap_dr.experiments.maps.experiment import MapsOptions
from shadowmap_dr.experiments.pose.experiment import PoseOptions
from shadowmap_dr.experiments.soft.experiment import SoftOptions
from shadowmap_dr.io.options import option
from shadowmap_dr.io.ranges import check_ranges

RECORDS: list[tuple[Any, dict[str, Any]]] = [
    (ArtOptions, {"targets": ("heart",)}),
    (ImageOptions, {"image": "a.png"}),
    *((kind, {}) for kind in (FaceOptions, ConvergenceOptions, JacobianOptions, PlaneOptions)),
    *((kind, {}) for kind in (LightOptions, MapsOptions, PoseOptions, SoftOptions)),
]


def _numeric(record: Any) -> list[str]:
    """Fields of numbers, by their defaults and types."""
    return [
        declared.name
        for declared in dataclasses.fields(record)
        if re.match(r"(int|float|tuple\[(int|float), \.\.\.\])", str(declared.type)) and declared.name not in ("threads",)
    ]


@pytest.mark.parametrize(("record", "required"), RECORDS, ids=lambda value: getattr(value, "__name__", ""))
@pytest.mark.parametrize("value", [10**20, -1, float("nan"), float("inf"), "7", True])
def test_every_number_of_every_record_has_a_range(record: Any, required: dict[str, Any], value: object) -> None:
    names = _numeric(record)
    assert names
    for name in names:
        several = isinstance(next(f.default for f in dataclasses.fields(record) if f.name == name), tuple)
        with pytest.raises(ShadowmapError) as caught:
            record(**required, **{name: (value,) if several else value})
        message = str(caught.value)
        assert re.search(name.removesuffix("s")[:6], message) and str(value) in message and "\n" not in message, message
        assert re.search(r"give a .*\d", message) or "at most" in message, message


def test_both_ends_belong_to_a_range() -> None:
    @dataclasses.dataclass
    class Record:
        side: int = option(4, allowed=(2, 8), help="Side.")
        weights: tuple[float, ...] = option((0.5,), allowed=(0.0, 1.0), names=("--weight",), help="Weight.")

    for good in (Record(2), Record(8), Record(np.int64(3)), Record(weights=(0, 1, np.float32(0.25)))):  # type: ignore[arg-type]
        check_ranges(good)
    with pytest.raises(ShadowmapError, match=r"side \(--side\) is 9: give a whole number from 2 to 8\."):
        check_ranges(Record(9))
    with pytest.raises(ShadowmapError, match="weights"):
        check_ranges(Record(weights=(10**400,)))
    with pytest.raises(ShadowmapError, match=r"weights \(--weight\) is 1\.5: give a number from 0\.0 to 1\.0\."):
        check_ranges(Record(weights=(0.5, 1.5)))


@pytest.mark.parametrize(
    ("arguments", "option"),
    [
        ("pose --resolution 70000", "--resolution"),
        ("pose --runs 99999999999999999999", "--runs"),
        ("maps --filter-size 99999", "--filter-size"),
        ("face --prior 1e300", "--prior"),
        ("face --prior nan", "--prior"),
        ("face --image a.png --prior inf", "--prior"),
        ("art --target heart --smoothness nan", "--smoothness"),
        ("art --target heart --copies 99999999999999999999", "--copies"),
        ("lights --memory 99999999999999999999", "--memory"),
        ("lights --cone nan", "--cone"),
        ("lights --filter-size 99999", "--filter-size"),
        ("lights-times --batch 99999999999999999999", "--batch"),
        ("soft --samples 99999999999999999999/1", "--samples"),
        ("gradients convergence --iterations 99999999999999999999", "--iterations"),
        ("model sphere --smoothness nan", "--smoothness"),
        ("model sphere --step-size inf", "--step-size"),
        ("face convert folder out.npz --neck nan", "--neck"),
        ("bench --mitsuba-seconds nan", "--mitsuba-seconds"),
    ],
)
def test_commands_name_option_value_and_range(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Any, arguments: str, option: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["shadowmap-dr", *arguments.split()])
    with pytest.raises(SystemExit) as ended:
        main.main()
    lines = capsys.readouterr().err.strip().splitlines()
    assert ended.value.code == 1 and len(lines) == 1
    assert option in lines[0] and "give a" in lines[0]
    assert list(tmp_path.iterdir()) == []
