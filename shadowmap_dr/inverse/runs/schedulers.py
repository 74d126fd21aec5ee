"""Schedulers of a sweep's batches: this process, processes on this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import gc
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import OutputError, ShadowmapError, install_hint, is_interrupt
from ...io.console import waiting
from .worker import Batch, Worker

if TYPE_CHECKING:
    from distributed import Client

#: Names of schedulers.
SCHEDULERS = "local, processes:N or tcp://HOST:PORT"

MOST_THREADS = 1024

Say = Callable[[str], None]
Report = Callable[[Batch, dict[str, Any]], None]


def check_scheduler(name: str) -> None:
    """Raise ShadowmapError if no scheduler has this name, or if its package Dask is not installed."""
    kind, _, count = name.partition(":")
    if name == "local":
        return
    if kind == "processes":
        if not (count.isdecimal() and int(count)):
            raise ShadowmapError(f"scheduler {name!r}: give the number of processes, as in processes:2.")
    elif kind not in ("tcp", "tls") or not count.startswith("//"):
        raise ShadowmapError(f"no scheduler {name!r}: choose {SCHEDULERS}.")
    try:
        import distributed  # noqa: F401
    except ImportError as error:
        raise ShadowmapError(f"scheduler {name!r} needs Dask: {install_hint('distributed')}.") from error


def check_threads(threads: int) -> None:
    """Raise ShadowmapError for an impossible number of Dr.Jit threads."""
    if not 0 <= threads <= MOST_THREADS:
        raise ShadowmapError(f"{threads} threads: give 1 to {MOST_THREADS}, or 0 for all.")


def do_batches(
    batches: Sequence[Batch],
    scheduler: str,
    *,
    threads: int,
    folder: Path,
    on_done: Report,
    on_step: Callable[[Batch, int], None] = lambda batch, done: None,
    say: Say = lambda line: None,
) -> None:
    """Do all batches; ``on_done`` gets the result of each as soon as it ends.

    ``say`` gets a line every ten seconds while a scheduler does not answer or has no worker.

    If a worker dies, another worker repeats its batch. Only the scheduler ``local`` calls ``on_step``. Errors of batches are
    raised after all other batches are done.
    """
    if scheduler == "local":
        failed = _do_here(batches, threads, folder, on_done, on_step)
    else:
        failed = _do_elsewhere(batches, scheduler, threads, folder, on_done, say)
    if failed:
        error = failed[0]
        if scheduler == "local":
            raise error
        if isinstance(error, ShadowmapError):
            raise error
        lines = " ".join(str(error).split())
        raise ShadowmapError(f"{len(failed)} batches failed, the first one with {type(error).__name__}: {lines}") from error


def _do_here(
    batches: Sequence[Batch], threads: int, folder: Path, on_done: Report, on_step: Callable[[Batch, int], None]
) -> list[Exception]:
    failed: list[Exception] = []
    worker = Worker(threads)
    for batch in batches:
        try:
            result = worker.do(batch, folder, partial(on_step, batch))
        except OutputError:
            raise  # the next checkpoint could not be written either
        except Exception as error:
            if is_interrupt(error):
                raise KeyboardInterrupt from error
            failed.append(error)
            continue
        on_done(batch, result)
    return failed


def _do_elsewhere(
    batches: Sequence[Batch], scheduler: str, threads: int, folder: Path, on_done: Report, say: Say
) -> list[Exception]:
    from distributed import as_completed

    failed: list[Exception] = []
    with _client(scheduler, say) as client, waiting(say, _Workers(client, scheduler).missing):
        # Other sweeps on the same cluster may have batches of the same name with other results.
        sweep = uuid.uuid4().hex
        futures = {
            client.submit(_do, batch, str(folder), threads, pure=False, key=f"{batch.file}-{sweep}", retries=0): batch
            for batch in batches
        }
        for future in as_completed(list(futures)):
            batch = futures.pop(future)
            if future.cancelled():
                raise ShadowmapError(f"the Dask scheduler at {scheduler} is gone: restart it and resume from complete batches.")
            error = future.exception()
            if error is None:
                on_done(batch, future.result())
            else:
                failed.append(error)
            future.release()
    return failed


class _Workers:
    """Watch of a cluster's workers."""

    def __init__(self, client: Client, scheduler: str) -> None:
        self._client, self._scheduler, self._last = client, scheduler, 0.0

    def missing(self, seconds: float) -> str | None:
        """A line if the cluster has no worker now. ``seconds``: since the work began."""
        try:
            workers = self._client.nthreads()
        except Exception:  # of many kinds: the scheduler is gone, which the wait for results notices
            return None
        if workers:
            self._last = seconds
            return None
        since = "none has joined" if not self._last else "none is left"
        start = "" if self._scheduler.startswith("processes:") else f" (start one with `dask worker {self._scheduler}`)"
        return f"waiting for a worker of {self._scheduler}: {since} for {seconds - self._last:.0f} s{start}"


@contextmanager
def _client(scheduler: str, say: Say) -> Iterator[Client]:
    from distributed import Client, LocalCluster

    if scheduler.startswith("processes:"):
        count = int(scheduler.partition(":")[2])
        # One Python thread each; Dr.Jit has its own threads. Dask restarts workers that die.
        with waiting(say, lambda seconds: f"waiting for {count} processes to start, for {seconds:.0f} s"):
            cluster = LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0)
        with cluster, Client(cluster) as client:
            yield client
        return
    client = None
    with (
        waiting(say, lambda seconds: f"waiting for a Dask scheduler at {scheduler} to answer, for {seconds:.0f} s"),
        suppress(OSError, ValueError, TypeError),  # the last two: invalid ports and missing certificates
    ):
        client = Client(scheduler, timeout=20)
    if client is None:
        # Collect the failed client here: its destructor waits for a lock, forever in the thread that starts the next client.
        gc.collect()
        raise ShadowmapError(f"no Dask scheduler answers at {scheduler}: start one, or give its address.")
    with client:
        yield client


#: Worker of this process, at most one; replaced when another number of threads is asked for.
_WORKER: list[Worker] = []
_LOCK = threading.Lock()


def _do(batch: Batch, folder: str, threads: int) -> dict[str, Any]:
    with _LOCK:
        if not _WORKER or _WORKER[0].threads != threads:
            _WORKER[:] = [Worker(threads)]
        worker = _WORKER[0]
    return worker.do(batch, Path(folder))
