"""fit.toml: the whole of a fit's inputs as a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.options import FitOptions
from shadowmap_dr.fitting.task import FitTask, PictureFile, read_task
from shadowmap_dr.fitting.toml import to_toml
from shadowmap_dr.fitting.vary import Vary

FULL = FitTask(
    scene="/rooms/a room.xml",
    parameters={"object": "meshes/spot.ply", "resolution": "64"},
    pictures=(PictureFile("/pictures/a.png"), PictureFile("/pictures/b.exr", 1, "/pictures/mask.png", 0.25)),
    options=FitOptions(
        vary=(Vary("bunny", "pose"), Vary("sun", "direction", spread=60.0), Vary("car_*", "translation", "xz", -1.0, 1.5, 0.5)),
        white_balance=True,
        vignetting=True,
        starts=3,
        loss="l1",
        delta=0.25,
        resolution=64,
    ),
)


def written(path: Path, task: FitTask) -> Path:
    path.write_text(to_toml(task.plain()), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "task", [FULL, FitTask("pose"), FitTask("pose", options=FitOptions(exposure=True))], ids=lambda t: t.scene
)
def test_a_task_is_read_as_it_was_written(tmp_path: Path, task: FitTask) -> None:
    found = read_task(written(tmp_path / "fit.toml", task))
    assert found.options == task.options and found.scene == task.scene
    assert dict(found.parameters) == dict(task.parameters) and list(found.pictures) == list(task.pictures)


def test_usual_values_are_left_out() -> None:
    assert FitTask("pose").plain() == {"scene": "pose", "target": [], "vary": []}
    assert FULL.plain()["target"][0] == {"file": "/pictures/a.png"}


_NAMES = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=8)
_NUMBERS = st.none() | st.floats(-1e6, 1e6)


@given(
    name=_NAMES,
    low=_NUMBERS,
    prior=st.none() | st.floats(1e-6, 1e6),
    file=_NAMES,
    exposure=st.floats(1e-6, 1e6),
    parameters=st.dictionaries(_NAMES, _NAMES, max_size=2),
    starts=st.integers(1, 1024),
    delta=st.floats(1e-6, 1e6),
)
def test_any_texts_and_numbers_are_read_as_they_were_written(
    tmp_path_factory: pytest.TempPathFactory, name: str, file: str, parameters: dict[str, str], **numbers: Any
) -> None:
    vary = Vary(name, "value", low=numbers["low"], prior=numbers["prior"])
    picture = PictureFile(f"/{file}", exposure=numbers["exposure"])
    task = FitTask("pose", parameters, (picture,), FitOptions((vary,), starts=numbers["starts"], delta=numbers["delta"]))
    assert read_task(written(tmp_path_factory.mktemp("tasks") / "fit.toml", task)) == FitTask(
        "pose", parameters, [picture], task.options
    )


def test_files_are_beside_the_task(tmp_path: Path) -> None:
    """A scene of this package has a name that is no file."""
    text = """
        scene = "room.xml"
        target = ["a.png", { file = "b.png", sensor = 1, mask = "m.png", exposure = 2 }]
        vary = ["sun:direction,spread=60", { name = "wall", kind = "value", min = 0, max = 1 }]
        starts = 4
        delta = 1
    """
    (tmp_path / "fit.toml").write_text(text)
    found = read_task(tmp_path / "fit.toml")
    assert found.scene == str(tmp_path / "room.xml")
    assert found.pictures[0] == PictureFile(str(tmp_path / "a.png"))
    assert found.pictures[1] == PictureFile(str(tmp_path / "b.png"), 1, str(tmp_path / "m.png"), 2.0)
    assert found.options.vary == (Vary("sun", "direction", spread=60), Vary("wall", "value", low=0, high=1))
    assert found.options.starts == 4 and found.options.delta == 1.0
    (tmp_path / "fit.toml").write_text(
        "scene = 'pose'\n[[target]]\nfile = '/a.png'\n[[vary]]\nname = 'sun'\n[parameters]\nresolution = 64"
    )
    found = read_task(tmp_path / "fit.toml")
    assert found.scene == "pose" and found.parameters == {"resolution": "64"} and found.pictures[0].file == "/a.png"


LONG = 5000 * "x"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "scene is missing; give a text in quotes"),
        ("scene = 3", "scene is 3; give a text in quotes"),
        ("scene = ''", "scene is ''; give a text in quotes"),
        ("scene = pose", "cannot read"),
        ("scene = 'a'\nscene = 'b'", "cannot read"),
        ("scene = 'a'\nstrats = 3", "there is no key 'strats'. Did you mean 'starts'?"),
        ("scene = 'a'\nstarts = '3'", "starts is '3'; give a value like 8"),
        ("scene = 'a'\nstarts = 3.5", "starts is 3.5; give a value like 8"),
        ("scene = 'a'\nstarts = true", "starts is True; give a value like 8"),
        ("scene = 'a'\nexposure = 1", "exposure is 1; give a value like False"),
        ("scene = 'a'\nloss = 2", "loss is 2; give a value like 'huber'"),
        ("scene = 'a'\nloss = 'l3'", "loss is 'l3': choose huber, l2 or l1"),
        ("scene = 'a'\nstarts = 0", "starts"),
        ("scene = 'a'\ndelta = nan", "delta"),
        ("scene = 'a'\ndelta = true", "delta is True; give a value like 0.1"),
        (f"scene = 'a'\ndelta = 1{400 * '0'}", "delta"),
        (f"scene = 'a'\nstarts = 1{5000 * '0'}", "cannot read"),
        ("scene = 'a'\nexposure = true\nwhite_balance = true", "leave exposure out"),
        ("scene = 'a'\ntarget = 'a.png'", "target is 'a.png'; give a list, or [[target]]"),
        ("scene = 'a'\ntarget = [3]", "target is 3; give a table"),
        ("scene = 'a'\ntarget = [{}]", "target: file is missing; give a text in quotes"),
        ("scene = 'a'\ntarget = [{file = 'a.png', sensr = 1}]", "target: there is no key 'sensr'. Did you mean 'sensor'?"),
        ("scene = 'a'\ntarget = [{file = 'a.png', sensor = '1'}]", "target: sensor is '1'; give a value like 0"),
        ("scene = 'a'\ntarget = [{file = 'a.png', mask = 1}]", "target: mask is 1; give a text in quotes"),
        ("scene = 'a'\ntarget = [{file = 'a.png', exposure = 0}]", "target: exposure is 0; give a positive number"),
        ("scene = 'a'\ntarget = [{file = 'a.png', exposure = nan}]", "target: exposure is nan; give a positive number"),
        ("scene = 'a'\nvary = 'sun'", "vary is 'sun'; give a list, or [[vary]]"),
        ("scene = 'a'\nvary = [1]", "vary: 1 is a int; give text"),
        ("scene = 'a'\nvary = ['sun:directoin']", "Did you mean 'direction'?"),
        ("scene = 'a'\nvary = [{name = 'sun', mni = 1}]", "vary: there is no key 'mni'"),
        ("scene = 'a'\nvary = ['sun', 'sun']", "vary sun is given twice"),
        ("scene = 'a'\nparameters = 3", "parameters is 3; give a table"),
        ("scene = 'a'\ntarget = [{file = 'a.png', exposure = 1e300}]", "exposure is 1e+300; give a positive number up to 1e+06"),
        ("scene = 'a'\ndelta = 1e300", "delta of the loss is 1e+300: give a positive number up to 1e+12"),
        (f"scene = 'a'\n{LONG} = 3", "there is no key 'xxx"),
        (f"scene = 'a'\nstarts = '{LONG}'", "; give a value like 8"),
        (f"scene = 'a'\ntarget = [{{file = ['{LONG}']}}]", "; give a text in quotes"),
        (f"scene = 'a'\nvary = ['sun:pose', '{LONG}', '{LONG}']", "is given twice"),
    ],
)
def test_bad_tasks_are_named_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "fit.toml"
    path.write_text(text)
    with pytest.raises(ShadowmapError) as raised:
        read_task(path)
    message = str(raised.value)
    assert words in message and str(path) in message and "\n" not in message and len(message) <= 600


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "binary.toml").write_bytes(b"scene = '\xff\xfe'")
    for name, words in (("binary.toml", "it is no text"), ("none.toml", "No such file"), ("", "Is a directory")):
        with pytest.raises(ShadowmapError, match=words) as raised:
            read_task(tmp_path / name)
        assert str(raised.value).startswith(f"cannot read {tmp_path / name}: ")


_VALUES = st.recursive(
    st.booleans() | st.integers(-(2**63), 2**63) | st.floats() | st.sampled_from(["sun", "sun:pose", "a.png", "huber", ""]),
    lambda own: st.lists(own, max_size=2) | st.dictionaries(st.sampled_from(["name", "kind", "file", "sensor", "min", "x"]), own),
    max_leaves=6,
)


@given(
    entries=st.dictionaries(st.sampled_from(["scene", "vary", "target", "parameters", "starts", "delta", "loss", "x"]), _VALUES)
)
def test_tasks_end_in_a_record_or_one_kind_of_error(tmp_path_factory: pytest.TempPathFactory, entries: dict[str, Any]) -> None:
    path = tmp_path_factory.mktemp("tasks") / "fit.toml"
    path.write_text(to_toml({"scene": "pose", **entries}), encoding="utf-8")
    try:
        read_task(path)
    except ShadowmapError as error:
        assert str(path) in str(error) and "\n" not in str(error)
