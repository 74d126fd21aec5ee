"""Checkpoints: arrays come back as they were written, or the file is refused."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io.checkpoints import read_checkpoint, write_checkpoint
from shadowmap_dr.io.files import read_arrays

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True, False]), "c": np.array(3, np.uint32), "d": np.zeros((0, 3))}


def test_arrays_come_back(tmp_path: Path) -> None:
    write_checkpoint(tmp_path / "a.npz", "this run", ARRAYS)
    found = read_checkpoint(tmp_path / "a.npz", "this run")
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype
    with pytest.raises(ShadowmapError, match=r"a\.npz belongs to a run with other settings"):
        read_checkpoint(tmp_path / "a.npz", "another run")


def test_compressed_arrays_are_not_unpacked(tmp_path: Path) -> None:
    """A small file may hold very large ones."""
    path = tmp_path / "a.npz"
    write_checkpoint(path, "this run", ARRAYS)
    np.savez_compressed(path, **np.load(path))
    assert read_arrays(path).keys() >= ARRAYS.keys()
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("zeros.npy", "w") as file:
        np.lib.format.write_array(file, np.zeros(1_000_000))
    with pytest.raises(ShadowmapError, match=r"cannot read the checkpoint") as raised:
        read_checkpoint(path, "this run")
    assert "its arrays take 8 MB, more than 0 MB" in str(raised.value.__cause__)


@pytest.mark.parametrize(
    "changes",
    [
        {"a": np.arange(6.0)},
        {"a": ARRAYS["a"].astype(np.float32)},
        {"a": ARRAYS["a"] + np.eye(2, 3)},
        {"c": np.array([])},
        {"e": np.zeros(3)},
        {"checks": np.array("{}")},
        {"checks": np.array("[]")},
        {"checks": np.array("[" * 100_000)},
        {"fingerprint": None},
        {"checks": None},
    ],
)
def test_edited_arrays_are_refused(tmp_path: Path, changes: dict[str, Any]) -> None:
    path = tmp_path / "a.npz"
    write_checkpoint(path, "this run", ARRAYS)
    edited = {**np.load(path), **changes}
    np.savez(path, **{name: array for name, array in edited.items() if array is not None})
    with pytest.raises(ShadowmapError, match=r"cannot read the checkpoint .*a\.npz: it was edited or is damaged; delete it"):
        read_checkpoint(path, "this run")
