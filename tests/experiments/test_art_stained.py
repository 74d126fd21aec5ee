"""`shadowmap-dr art --stained`: the loop, its files, killed runs, and what it says about bad input."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from shadowmap_dr.cli import main
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.art import stained
from shadowmap_dr.experiments.art.experiment import ArtOptions
from shadowmap_dr.inverse import StainedSheet
from shadowmap_dr.io import images
from shadowmap_dr.jit.threads import second_thread

SMALL = {"resolution": 32, "panes": 16, "picture_size": 32, "map_resolution": 96}


class Killed(Exception):
    """An end of a run in the middle."""


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    """A wide picture with a transparent corner."""
    x, y = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 40))
    pixels = np.stack([x, y, 1 - x, np.ones_like(x)], -1)
    pixels[:12, 10:22, 3] = 0
    Image.fromarray(np.round(255 * pixels).astype(np.uint8)).save(tmp_path / "given.png")
    return tmp_path / "given.png"


def test_a_sheet_has_all_its_files(variant: str, tmp_path: Path, picture: Path) -> None:
    options = ArtOptions((), stained=str(picture), iterations=40, out=tmp_path / "out", **SMALL)
    record = stained.run_stained(options)
    assert json.loads((tmp_path / "out" / "art.json").read_text()) == record
    assert {"shadowmap_dr", "machine", "settings"} <= record.keys()
    assert str(tmp_path) not in json.dumps(record)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*record["files"], "art.json"}
    assert record["rmse"] < 0.06 and record["rmse_curve"]["step"] == [10, 20, 30, 40]
    assert record["rmse_curve"]["rmse"][-1] == record["rmse"] < record["rmse_curve"]["rmse"][0]
    with Image.open(tmp_path / "out" / "steps.webp") as animation:
        assert animation.n_frames > 10 and animation.size == (32, 32)
    with Image.open(tmp_path / "out" / "picture.png") as still:
        assert still.size == (64, 64)
    tints = images.read_image(tmp_path / "out" / "sheet.exr")
    assert tints.shape == (20, 20, 3)
    with second_thread():
        sheet = mi.load_file(str(tmp_path / "out" / "sheet.xml"))
    floor = np.array(mi.render(sheet, spp=64))[..., :3]
    assert np.sqrt(np.mean((floor - stained.read_square(str(picture), 32)) ** 2)) < 0.08
    assert len(stained.table(record).rows) == 1 and "40 steps" in stained.summary(record)


def test_the_middle_of_a_picture_is_taken(picture: Path) -> None:
    square = stained.read_square(str(picture), 20)
    assert square.shape == (20, 20, 3)
    assert (square[:5, :5] == 0).all()  # transparent
    assert square[-1, -1, 1] > 0.9 and square[-1, 0, 0] < square[-1, -1, 0]


def test_killed_runs_go_on_where_they_were(variant: str, tmp_path: Path, picture: Path) -> None:
    def sheet() -> StainedSheet:
        return StainedSheet(stained.read_square(str(picture), 16), panes=8, map_resolution=64)

    def kill(done: int, note: str) -> None:
        if done == 55:
            raise Killed

    checkpoint = tmp_path / "checkpoint.npz"
    whole = stained.make_sheet(sheet(), 60)
    with pytest.raises(Killed):
        stained.make_sheet(sheet(), 60, checkpoint, "a", kill)
    with pytest.raises(ShadowmapError, match="other settings"):
        stained.make_sheet(sheet(), 60, checkpoint, "b")
    done: list[int] = []
    course = stained.make_sheet(sheet(), 60, checkpoint, "a", lambda n, note: done.append(n))
    assert done[0] == 51 and len(course.loss) == 60
    np.testing.assert_allclose(course.loss, whole.loss, rtol=0.02)
    assert [step for step, _ in course.frames] == [step for step, _ in whole.frames]
    checkpoint.write_bytes(b"nonsense")
    with pytest.raises(ShadowmapError, match="delete it"):
        stained.make_sheet(sheet(), 60, checkpoint, "a")


def test_coarse_panes_are_worth_a_warning(variant: str, tmp_path: Path, picture: Path) -> None:
    options = ["--stained", str(picture), "--panes", "2", "--resolution", "32", "--iterations", "5", "--animate", "none"]
    result = CliRunner().invoke(main.app, ["art", *options, "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert "given.png" in result.output
    record = json.loads((tmp_path / "out" / "art.json").read_text())
    assert "more --panes" in record["warnings"][0] and "steps.webp" not in record["files"]
    assert ArtOptions((), stained="a").iterations == 200


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--stained", "missing.png"], "missing.png"),
        (["--stained", "heart", "--target", "heart"], "no --target"),
        (["--stained", "heart", "--mesh", "spot"], "no --mesh"),
        (["--stained", "heart", "--camera", "perspective"], "no --camera"),
        (["--stained", "heart", "--panes", "0"], "--panes) is 0"),
    ],
)
def test_bad_arguments_are_one_line(variant: str, tmp_path: Path, arguments: list[str], words: str) -> None:
    result = CliRunner().invoke(main.app, ["art", *arguments, "--out", str(tmp_path)])
    assert isinstance(result.exception, ShadowmapError) and words in str(result.exception)
    assert "\n" not in str(result.exception)
