"""Sweeps: batches, files, resuming, and workers that die."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fake_problems import BlobPoses, Bowls
from rich.console import Console

from shadowmap_dr.errors import OutputError, ShadowmapError
from shadowmap_dr.inverse import run_sweep
from shadowmap_dr.inverse.runs.worker import stem
from shadowmap_dr.io import console as io_console

SUPPORT = Path(__file__).parents[1] / "support"


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def begun(folder: Path) -> Counter[str]:
    """Number of times that each batch was begun."""
    return Counter(path.name.rsplit("-", 1)[0] for path in folder.glob("*-*"))


def folder(path: Path) -> str:
    path.mkdir(exist_ok=True)
    return str(path)


def solved(records: list[dict[str, Any]], tolerance: float = 0.05) -> bool:
    targets = np.array([[r, -r / 2] for r in range(len(records))])
    return bool(np.abs(np.array([record["final"] for record in records]) - targets).max() < tolerance)


def test_batches_have_files_and_their_size_does_not_matter(tmp_path: Path) -> None:
    found = run_sweep([Bowls(5, size=2, steps=80)], tmp_path / "a")["bowls"]
    assert solved(found) and len(found[0]["loss_curve"]) == 80
    files = sorted((tmp_path / "a" / "batches").iterdir())
    assert [json.loads(path.read_text())["runs"] for path in files] == [[0], [1, 2], [3, 4]]
    single = run_sweep([Bowls(5, size=1, steps=80)], tmp_path / "b")["bowls"]
    for one, other in zip(found, single, strict=True):
        assert np.allclose(one["final"], other["final"], atol=1e-5)
        assert np.allclose(one["loss_curve"], other["loss_curve"], rtol=1e-3, atol=1e-6)


def test_only_runs_that_are_missing_are_done_again(tmp_path: Path) -> None:
    log = tmp_path / "log"
    first = run_sweep([Bowls(4, size=2, log=folder(log))], tmp_path)["bowls"]
    (path,) = (tmp_path / "batches").glob("bowls-*-000002-000003.json")
    path.write_text("broken")
    # Two more runs, and batches of another size.
    again = run_sweep([Bowls(6, size=4, log=str(log))], tmp_path, resume=True)["bowls"]
    assert begun(log) == {"0-1": 1, "2-3": 1, "2-5": 1}
    assert again[:2] == first[:2] and len(again) == 6
    # Other settings: all of them, and what there is stays.
    run_sweep([Bowls(2, steps=41, log=str(log))], tmp_path, resume=True)
    assert begun(log)["0-1"] == 2
    assert run_sweep([Bowls(6, log=str(log))], tmp_path, resume=True)["bowls"] == again
    assert begun(log) == {"0-1": 2, "2-3": 1, "2-5": 1}
    # No wish to resume: all of them, and what there was with these settings goes.
    run_sweep([Bowls(2, log=str(log))], tmp_path)
    assert begun(log)["0-1"] == 3
    assert len(list((tmp_path / "batches").iterdir())) == 2


def test_records_of_another_variant_are_not_taken(tmp_path: Path) -> None:
    log = folder(tmp_path / "log")
    for variant in ("llvm_ad_mono", "llvm_ad_rgb", "llvm_ad_mono"):
        (record,) = run_sweep([Bowls(1, log=log)], tmp_path, variant=variant, resume=True)["bowls"]
        assert record["variant"] == variant
    assert begun(Path(log)) == {"0-0": 2}


def test_a_batch_that_fails_leaves_the_others(tmp_path: Path) -> None:
    log = folder(tmp_path / "log")
    with pytest.raises(ValueError, match="run 2 fails"):
        run_sweep([Bowls(6, log=log, fails=2)], tmp_path)
    assert begun(Path(log)) == {"0-1": 1, "2-3": 1, "4-5": 1}
    run_sweep([Bowls(6, log=log)], tmp_path, resume=True)
    assert begun(Path(log)) == {"0-1": 1, "2-3": 2, "4-5": 1}


def test_a_full_disk_ends_the_sweep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = folder(tmp_path / "log")

    def full(*_: Any, **__: Any) -> None:
        raise OutputError("cannot write a checkpoint: No space left on device.")

    monkeypatch.setattr("shadowmap_dr.inverse.runs.loop._save", full)
    with pytest.raises(OutputError, match="No space left"):
        run_sweep([Bowls(6, log=log)], tmp_path)
    assert begun(Path(log)) == {"0-1": 1}


def test_checkpoints_stay_until_the_result_is_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OutputError("cannot write the result")

    with monkeypatch.context() as patch:
        patch.setattr("shadowmap_dr.io.records.write_json", full)
        with pytest.raises(OutputError):
            run_sweep([BlobPoses(1)], tmp_path)
    (path,) = (tmp_path / "batches").iterdir()
    assert path.name.endswith(".checkpoint-run0.npz")
    run_sweep([BlobPoses(1)], tmp_path, resume=True)
    (path,) = (tmp_path / "batches").iterdir()
    assert path.suffix == ".json"


def test_settings_may_be_paths(tmp_path: Path) -> None:
    assert solved(run_sweep([Placed(2, steps=80)], tmp_path)["bowls"])


@dataclass(frozen=True)
class Placed(Bowls):
    """A problem with a setting that JSON does not know."""

    place: Path = Path("somewhere")

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "place": self.place}


def test_a_batch_goes_on_from_its_checkpoint(tmp_path: Path) -> None:
    log = folder(tmp_path / "log")
    problem = Bowls(2, log=log, stops=25)
    with pytest.raises(RuntimeError, match="stopped"):
        run_sweep([problem], tmp_path)
    assert len(list((tmp_path / "batches").glob("*.checkpoint.npz"))) == 1
    found = run_sweep([problem], tmp_path, resume=True)["bowls"]
    whole = run_sweep([Bowls(2)], tmp_path / "whole")["bowls"]
    for one, other in zip(found, whole, strict=True):
        assert np.allclose(one["final"], other["final"], atol=1e-6)
        assert np.allclose(one["loss_curve"], other["loss_curve"], rtol=1e-4, atol=1e-7)
    assert not list((tmp_path / "batches").glob("*.checkpoint.npz"))


def test_checkpoints_hold_for_their_runs_only(tmp_path: Path) -> None:
    """Batches of another size, done in between, leave gaps in a batch that begins and ends where a killed one did."""
    log = folder(tmp_path / "log")
    with pytest.raises(RuntimeError, match="stopped"):
        run_sweep([Bowls(8, size=8, log=log, stops=25)], tmp_path)
    with pytest.raises(ValueError, match="run 0 fails"):
        run_sweep([Bowls(4, size=2, log=log, fails=0)], tmp_path, resume=True)
    Path(log, "stopped").unlink()
    with pytest.raises(RuntimeError, match="stopped"):
        run_sweep([Bowls(8, size=8, log=log, stops=25)], tmp_path, resume=True)
    found = run_sweep([Bowls(8, size=8, log=log)], tmp_path, resume=True)["bowls"]
    whole = run_sweep([Bowls(8, size=8)], tmp_path / "whole")["bowls"]
    assert np.allclose(*([record["final"] for record in records] for records in (found, whole)), atol=1e-5)
    assert begun(Path(log)) == {"0-7": 3, "0-1": 1, "2-3": 1}
    assert not list((tmp_path / "batches").glob("*.npz"))


def test_an_interrupt_within_a_recording_ends_the_sweep(tmp_path: Path) -> None:
    """Dr.Jit makes an error of its own of it."""
    log = folder(tmp_path / "log")
    with pytest.raises(KeyboardInterrupt):
        run_sweep([Interrupted(6, log=log)], tmp_path)
    assert begun(Path(log)) == {"0-1": 1}


@dataclass(frozen=True)
class Interrupted(Bowls):
    """Ctrl-C comes in the middle of a step."""

    def losses(self, built: Any, parameters: Any, runs: Any) -> Any:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("FlatVariables::...") from error


def test_losses_of_another_number_than_runs_are_named(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="losses returned 1 numbers for 2 runs"):
        run_sweep([Summed(2)], tmp_path)
    assert not list((tmp_path / "batches").iterdir())


@dataclass(frozen=True)
class Summed(Bowls):
    """One loss for all runs."""

    def losses(self, built: Any, parameters: Any, runs: Any) -> Any:
        return dr.sum(super().losses(built, parameters, runs))


def test_what_is_not_resumed_begins_anew_and_leaves_others_alone(tmp_path: Path) -> None:
    batches = tmp_path / "batches"
    batches.mkdir()
    mine = stem(BlobPoses(1), "llvm_ad_rgb")
    own = [batches / f"{mine}-000000-000000.{ending}" for ending in ("checkpoint.npz", "checkpoint-run0.npz")]
    others = [batches / "poses-more-000000-000001.checkpoint.npz", batches / "poses-more-000000-000000.json"]
    for path in (*own, *others):
        path.write_bytes(b"not a checkpoint")
    run_sweep([BlobPoses(1)], tmp_path)  # would refuse to go on from what it cannot read
    assert sorted(batches.iterdir()) == sorted([*others, batches / f"{mine}-000000-000000.json"])


def test_pose_estimation_is_a_sweep(tmp_path: Path) -> None:
    found = run_sweep([BlobPoses(3)], tmp_path)["poses"]
    for record in found:
        assert np.abs(record["final"]).max() < 0.3 * np.abs(record["start"]).max()
        assert len(record["loss_curve"]) == 30 and record["seconds_per_iteration"] > 0
    assert run_sweep([BlobPoses(3)], tmp_path, resume=True)["poses"] == found


def test_a_killed_sweep_goes_on(tmp_path: Path) -> None:
    log = folder(tmp_path / "log")
    code = (
        "import sys; from pathlib import Path; import shadowmap_dr; import mitsuba as mi; mi.set_variant('llvm_ad_rgb')\n"
        "from fake_problems import Bowls; from shadowmap_dr.inverse import run_sweep\n"
        f"run_sweep([Bowls(6, log={log!r}, pause=0.02)], Path({str(tmp_path)!r}))"
    )
    path = os.pathsep.join([str(SUPPORT), str(SUPPORT.parents[1]), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, stderr=subprocess.DEVNULL)
    try:
        for _ in range(600):
            if list((tmp_path / "batches").glob("bowls-*-000000-000001.json")):
                break
            assert process.poll() is None
            time.sleep(0.1)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert not list((tmp_path / "batches").glob("bowls-*-000004-000005.json"))
    found = run_sweep([Bowls(6, log=log)], tmp_path, resume=True)["bowls"]
    assert len(found) == 6 and begun(Path(log))["0-1"] == 1 and begun(Path(log))["4-5"] == 1


def test_a_worker_that_dies_loses_its_own_batch_only(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    log = folder(tmp_path / "log")
    found = run_sweep([Bowls(8, log=log, fatal=2, pause=0.01)], tmp_path, scheduler="processes:2", threads=1)["bowls"]
    assert (Path(log) / "died").exists()
    assert begun(Path(log)) == {"0-1": 1, "2-3": 2, "4-5": 1, "6-7": 1}
    local = run_sweep([Bowls(8)], tmp_path / "local")["bowls"]
    for one, other in zip(found, local, strict=True):
        assert np.allclose(one["final"], other["final"], atol=1e-5)
        assert one["threads"] == 1 and one["variant"] == "llvm_ad_rgb"
    # Two processes at least, none of them this one.
    assert os.getpid() not in {int(path.read_text()) for path in Path(log).glob("*-*")}


def test_workers_of_a_scheduler_elsewhere(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    log = folder(tmp_path / "log")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, memory_limit=0, host="127.0.0.1"
    ) as cluster:
        address = cluster.scheduler_address
        assert address.startswith("tcp://127.0.0.1")
        with pytest.raises(ShadowmapError, match="1 batches failed, the first one with ValueError: run 2 fails"):
            run_sweep([Bowls(4, log=log, fails=2)], tmp_path, scheduler=address)
        # What did not fail is there.
        found = run_sweep([Bowls(4, log=log)], tmp_path, scheduler=address, resume=True)["bowls"]
    assert len(found) == 4 and begun(Path(log)) == {"0-1": 1, "2-3": 2}


def test_two_sweeps_share_a_cluster(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster,
        ThreadPoolExecutor(2) as pool,
    ):
        # Units of the same name, at once.
        lengths = (30, 45)
        sweeps = [
            pool.submit(run_sweep, [Bowls(2, steps=n, pause=0.01)], tmp_path / str(n), scheduler=cluster.scheduler_address)
            for n in lengths
        ]
        for n, sweep in zip(lengths, sweeps, strict=True):
            assert [len(record["loss_curve"]) for record in sweep.result()["bowls"]] == [n, n]


def test_a_scheduler_that_dies_is_named(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    log = folder(tmp_path / "log")
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None, memory_limit=0)
    with ThreadPoolExecutor(1) as pool:
        sweep = pool.submit(run_sweep, [Bowls(2, log=log, pause=1)], tmp_path, scheduler=cluster.scheduler_address)
        for _ in range(600):
            if begun(Path(log)):
                break
            time.sleep(0.1)
        cluster.close()
        with pytest.raises(ShadowmapError, match="scheduler at tcp://.* is gone"):
            sweep.result(60)


def test_a_scheduler_without_workers_is_waited_for_with_a_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(io_console, "_LINE_SECONDS", 0.2)
    written = io.StringIO()
    with (
        distributed.LocalCluster(n_workers=0, threads_per_worker=1, dashboard_address=None, memory_limit=0) as cluster,
        ThreadPoolExecutor(1) as pool,
    ):
        address = cluster.scheduler_address
        line = f"waiting for a worker of {address}: none has joined for "
        console = Console(file=written, width=40)  # lines are not broken
        sweep = pool.submit(run_sweep, [Bowls(2)], tmp_path, scheduler=address, console=console)
        for _ in range(600):
            if written.getvalue().count(line) > 1:
                break
            time.sleep(0.1)
        cluster.scale(1)
        assert len(sweep.result(120)["bowls"]) == 2
    assert re.search(re.escape(line) + rf"\d+ s \(start one with `dask worker {re.escape(address)}`\)\n", written.getvalue())


def test_bad_input_is_named(tmp_path: Path) -> None:
    for scheduler in ("slurm", "processes:none", "processes:0", "tcp:1", "tcp://", "tcp://localhost:abc", "tls://localhost:1"):
        with pytest.raises(ShadowmapError, match=scheduler):
            run_sweep([Bowls(1)], tmp_path, scheduler=scheduler)
    with pytest.raises(ShadowmapError, match="same name"):
        run_sweep([Bowls(1), Bowls(2)], tmp_path)
    with pytest.raises(ShadowmapError, match="'a/b'"):
        run_sweep([Bowls(1, name="a/b")], tmp_path)
    with pytest.raises(ShadowmapError, match="-1 threads"):
        run_sweep([Bowls(1)], tmp_path, threads=-1)
    with pytest.raises(ShadowmapError, match="no Mitsuba variant 'magic'"):
        run_sweep([Bowls(1)], tmp_path, variant="magic")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="cannot write .*file/batches"):
        run_sweep([Bowls(1)], tmp_path / "file")
