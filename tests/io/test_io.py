"""Image files, JSON records and plots."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.errors import OutputError, ShadowmapError
from shadowmap_dr.io import files, images, meshes, plots, records

RNG = np.random.default_rng(1)


def test_exr_round_trip_keeps_values_types_and_metadata(tmp_path: Path) -> None:
    channels = {
        "R": RNG.normal(size=(5, 7)).astype(np.float32),
        "G": RNG.normal(size=(5, 7)).astype(np.float16),
        "B": RNG.normal(size=(5, 7)).astype(np.float32) * 1e6,
        "depth.Z": np.full((5, 7), np.inf, np.float32),
        "id.I": np.arange(35, dtype=np.uint32).reshape(5, 7),
    }
    images.write_exr(tmp_path / "sub" / "a.exr", channels, {"note": "x = 1"})
    read, metadata = images.read_exr(tmp_path / "sub" / "a.exr")
    assert metadata["note"] == "x = 1"
    assert read.keys() == channels.keys()
    for name, array in channels.items():
        assert read[name].dtype == array.dtype
        np.testing.assert_array_equal(read[name], array)
    np.testing.assert_array_equal(images.read_image(tmp_path / "sub" / "a.exr")[..., 0], channels["R"])


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_image_round_trip(tmp_path: Path, channels: int) -> None:
    image = RNG.random((4, 6, channels)).astype(np.float32)
    images.write_image(tmp_path / "a.exr", image)
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.exr"), image[..., :3])
    images.write_image(tmp_path / "a.png", image)
    assert Image.open(tmp_path / "a.png").size == (6, 4)


def test_png_is_srgb_and_clipped(tmp_path: Path) -> None:
    linear = np.array([[[-1.0, 0.0, 0.0031308], [0.214041, 1.0, 7.0]]], dtype=np.float32)
    images.write_png(tmp_path / "a.png", linear)
    np.testing.assert_array_equal(np.array(Image.open(tmp_path / "a.png")), [[[0, 0, 10], [127, 255, 255]]])


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    records.write_json(path, [1])
    with pytest.raises(TypeError):
        records.write_json(path, {"a": object()})
    with pytest.raises(RuntimeError), files.atomic(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert records.read_json(path) == [1]
    assert os.listdir(tmp_path) == ["a.json"]


@pytest.mark.parametrize("name", ["a.exr", "a.png", "a.json"])
def test_full_disk_is_one_clear_error(tmp_path: Path, name: str) -> None:
    """A limit on the size of files stands in for a full disk."""
    code = (
        "import resource, sys, numpy as np\n"
        "from shadowmap_dr.io import images, records\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "image = np.random.default_rng(0).random((64, 64, 3))\n"
        "path = sys.argv[1]\n"
        "records.write_json(path, image) if path.endswith('json') else images.write_image(path, image)"
    )
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path / name)], capture_output=True, text=True)
    assert run.returncode == 1
    last = run.stderr.strip().splitlines()[-1]
    assert last.startswith("shadowmap_dr.errors.OutputError: cannot write") and name in last
    assert os.listdir(tmp_path) == []


def test_unusable_outputs(tmp_path: Path) -> None:
    for path in (tmp_path / "a.jpg", tmp_path / "a", tmp_path, Path("/proc/nothing/a.exr")):
        with pytest.raises(OutputError):
            files.check_output(path)
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=f"{tmp_path / 'file'} is a file"):
        files.check_output(tmp_path / "file" / "a.exr")
    with pytest.raises(OutputError):
        images.write_image(tmp_path / "a.tiff", np.zeros((2, 2, 3)))
    assert files.check_output(tmp_path / "new" / "a.exr") == tmp_path / "new" / "a.exr"


def test_unreadable_inputs(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_text("no image")
    for path in (tmp_path / "a.exr", tmp_path / "b.exr"):
        with pytest.raises(ShadowmapError, match=path.name):
            images.read_exr(path)
    (tmp_path / "a.json").write_text("{")
    for path in (tmp_path / "a.json", tmp_path / "b.json"):
        with pytest.raises(ShadowmapError, match=path.name):
            records.read_json(path)
    with pytest.raises(ShadowmapError, match="shape"):
        images.write_png(tmp_path / "a.png", np.zeros((2, 2, 7)))


def test_damaged_images_and_arrays_are_named(tmp_path: Path) -> None:
    """Libraries raise whatever they come across in a damaged file."""
    images.write_image(tmp_path / "good.exr", np.random.default_rng(0).random((6, 5, 3)), {"about": "this"})
    np.savez_compressed(tmp_path / "good.npz", numbers=np.arange(40.0), words=np.array(["a", "b"]))
    for kind, read in ((".exr", images.read_exr), (".npz", files.read_arrays)):
        good, path = (tmp_path / f"good{kind}").read_bytes(), tmp_path / f"bad{kind}"
        refused = 0
        for k in np.random.default_rng(1).integers(0, len(good), 300):
            path.write_bytes(good[:k] + bytes([good[k] ^ 0xFF]) + good[k + 1 :])
            try:
                read(path)
            except ShadowmapError as error:
                assert path.name in str(error) and "\n" not in str(error)
                refused += 1
        assert refused > 50


def test_arrays_come_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", x=np.arange(3), y=np.eye(2))
    assert list(files.read_arrays(tmp_path / "a.npz")) == ["x", "y"]
    np.testing.assert_array_equal(files.read_arrays(tmp_path / "a.npz", ("y", "z"))["y"], np.eye(2))
    np.save(tmp_path / "b.npy", np.eye(2))
    np.savez(tmp_path / "c.npz", x=np.array([{}]))
    for name, reason in (("b.npy", "no .npz file"), ("c.npz", "objects are not read"), ("d.npz", "no .npz file")):
        with pytest.raises(ShadowmapError, match=f"{name}.*{reason}"):
            files.read_arrays(tmp_path / name)


def test_meshes_on_a_full_disk(tmp_path: Path) -> None:
    """Mitsuba's own error is no OSError."""

    class Mesh:
        def write_ply(self, path: str) -> None:
            Path(path).write_bytes(b"half of it")
            raise RuntimeError("[FileStream]\n no space left")

    with pytest.raises(OutputError, match=r"cannot write .*a\.ply: \[FileStream\] no space left"):
        meshes.write_ply(tmp_path / "a.ply", Mesh())
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("content", ["[]", "3", '{"settings": null, "runs": {}}', '{"settings": {"a": 1}}', '{"runs": {}}'])
def test_records_of_something_else(tmp_path: Path, content: str) -> None:
    """They are set aside, and the experiment begins anew."""
    path, fresh = tmp_path / "record.json", {"settings": {"a": (1, 2)}, "runs": {}}
    for k in (1, 2):
        path.write_text(content)
        with pytest.warns(UserWarning, match=rf"record\.json is no record .* it is now record\.json\.{k}\.bak") as caught:
            assert records.read_record(path, fresh, {"runs": ()}) == fresh
        assert len(caught) == 1 and not path.exists() and (tmp_path / f"record.json.{k}.bak").read_text() == content


def test_edited_entries_of_records_are_made_again(tmp_path: Path) -> None:
    path, fresh = tmp_path / "record.json", {"settings": {"a": (1, 2)}, "runs": {}}
    runs = {"x": {"n": np.float32(0.1), "bad": float("nan")}, "y": {"n": 2}, "z": 3}
    records.write_record(path, {"settings": {"a": (1, 2), "b": 3}, "runs": runs}, "runs")
    assert records.read_record(path, fresh, {"runs": ()})["runs"] == records.plain(runs)
    record = records.read_json(path)
    record["runs"]["y"]["n"] = 4
    record["runs"]["w"] = {"n": 5}
    path.write_text(json.dumps(record))
    with pytest.warns(UserWarning, match=r"record\.json: 2 of 4 entries of 'runs' were edited or are damaged"):
        assert list(records.read_record(path, fresh, {"runs": ()})["runs"]) == ["x", "z"]
    with pytest.raises(ShadowmapError, match=r"record\.json belongs to a run with other settings"):
        records.read_record(path, {"settings": {"a": (1, 3)}}, {"runs": ()})
    for checks in ([], {"runs": 3}, {"runs": {"x": None}}):
        path.write_text(json.dumps({**record, "checks": checks}))
        with pytest.warns(UserWarning, match="4 of 4"):
            assert records.read_record(path, fresh, {"runs": ()})["runs"] == {}


def test_records_of_earlier_versions_need_some_keys(tmp_path: Path) -> None:
    path, fresh = tmp_path / "record.json", {"settings": {}, "runs": {}}
    path.write_text('{"settings": {}, "runs": {"x": {"n": 1}, "y": {}, "z": 3}}')
    with pytest.warns(UserWarning, match="2 of 3"):
        assert records.read_record(path, fresh, {"runs": ("n",)})["runs"] == {"x": {"n": 1}}


def test_records_of_earlier_versions_that_no_report_can_be_made_of(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    entries = {"a": {"loss": 1.0}, "b": {"loss": "x"}, "c": {"loss": None}, "d": {"loss": []}}
    path.write_text(json.dumps({"settings": {}, "runs": entries}))

    def report(record: dict[str, Any]) -> str:
        return ", ".join(f"{run['loss']:.2f} {int(run['loss'])}" for run in record["runs"].values())

    with pytest.warns(UserWarning, match="3 of 4 entries of 'runs' were edited or are damaged"):
        found = records.read_record(path, {"settings": {}, "runs": {}}, {"runs": ("loss",)}, report)
    assert found["runs"] == {"a": {"loss": 1.0}}


@pytest.mark.parametrize("content", [b"{", b"\xff\xfe", b"[" * 100_000, b"1" * 10_000, b""])
def test_files_that_are_no_json_are_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ShadowmapError, match=r"cannot read .*a\.json") as caught:
        records.read_json(tmp_path / "a.json")
    assert "\n" not in str(caught.value)


def test_temporary_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys; from pathlib import Path; from shadowmap_dr.io import files\n"
        "with files.atomic(Path(sys.argv[1])) as temporary: os.kill(os.getpid(), signal.SIGKILL)"
    )
    path = tmp_path / "checkpoints" / "run.npz"
    assert subprocess.run([sys.executable, "-c", code, str(path)]).returncode == -9
    (left,) = path.parent.iterdir()
    other = path.parent / left.name.replace(files._HOST, "0" * 8)  # of another machine
    own = path.parent / ".notes-2024.npz"
    other.touch(), own.touch()
    with files.atomic(path) as temporary:
        assert not left.exists() and other.exists() and own.exists()
        files._CLEARED.clear()
        files.remove_leftovers(path.parent)
        assert temporary.exists()  # of a process that runs
    assert sorted(path.parent.iterdir()) == sorted([path, other, own])


def test_json_of_numpy_values(tmp_path: Path) -> None:
    value = {"a": np.float32(0.5), "b": np.arange(3), "c": (np.int64(2), True, None), "d": float("nan"), "e": tmp_path}
    records.write_json(tmp_path / "a.json", value)
    assert records.read_json(tmp_path / "a.json") == {
        "a": 0.5,
        "b": [0, 1, 2],
        "c": [2, True, None],
        "d": None,
        "e": str(tmp_path),
    }


def test_plots_are_drawn_without_a_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    plots.plot_curves(tmp_path / "a.png", {"error": {"one": [[1.0, 0.1], [2.0, 0.0]], "two": [[]]}, "loss": {}})
    plots.image_sheet(tmp_path / "b.png", {"x": {"start": np.ones((3, 4, 3)), "end": np.full((3, 4, 1), np.nan)}})
    assert Image.open(tmp_path / "a.png").size[0] > 100
    assert Image.open(tmp_path / "b.png").size[0] > 100


@pytest.mark.parametrize("name", ["a.png", "a.exr"])
@pytest.mark.parametrize("shape", [(), (5,), (0, 5), (5, 0), (2, 3, 0), (2, 3, 1, 1)])
def test_arrays_that_are_no_images(tmp_path: Path, name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(ShadowmapError, match=r"an image of shape \(.*give \(H, W\)"):
        images.write_image(tmp_path / name, np.ones(shape, np.float32))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "channels",
    [{}, {"Y": np.ones(5, np.float32)}, {"Y": np.ones((0, 5), np.float32)}, {"Y": np.ones((4, 4))},
     {"R": np.ones((4, 4), np.float32), "G": np.ones((4, 5), np.float32)}],
)  # fmt: skip
def test_channels_that_openexr_cannot_hold(tmp_path: Path, channels: dict[str, Any]) -> None:
    with pytest.raises(ShadowmapError, match=r"cannot write .*a\.exr: channel.*; give "):
        images.write_exr(tmp_path / "a.exr", channels)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_plots_of_the_largest_numbers(tmp_path: Path) -> None:
    plots.plot_curves(tmp_path / "a.png", {"loss": {"a": [[1e-300, 1e308], [float("nan"), 1.0]]}})
    assert Image.open(tmp_path / "a.png").width > 100


@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize("name", ["a.png", "a.exr"])
def test_images_beyond_single_precision_are_white(tmp_path: Path, name: str) -> None:
    images.write_image(tmp_path / name, np.full((4, 5, 3), 1e300))
    assert (images.to_srgb(np.full((4, 5), 1e300)) > 0.999).all()
    if name == "a.png":
        assert (np.asarray(Image.open(tmp_path / name)) == 255).all()
    else:
        assert np.isinf(images.read_image(tmp_path / name)).all()
