"""Who does the batches of a sweep: this process, processes on this machine, or the workers of a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import ShadowmapError
from .workshop import Unit, Workshop

#: How a scheduler is named.
SCHEDULERS = "local, processes:N or tcp://HOST:PORT"

Report = Callable[[Unit, dict[str, Any]], None]


def check_scheduler(name: str) -> None:
    """Raise ShadowmapError for a name of no scheduler, or if what it needs is not installed."""
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
        raise ShadowmapError(f"scheduler {name!r} needs Dask: pip install 'shadowmap-dr[distributed]'.") from error


def do_units(
    units: Sequence[Unit],
    scheduler: str,
    *,
    variant: str,
    threads: int,
    folder: Path,
    on_done: Report,
    on_step: Callable[[Unit, int], None] = lambda unit, done: None,
) -> None:
    """Do all units; ``on_done`` gets each one's result as soon as it is there, in the order in which they end.

    A unit whose worker died is done again by another one. ``on_step`` is called by the scheduler ``local`` only.
    Raises what a unit raised, after all others are done.
    """
    if scheduler == "local":
        workshop = Workshop(variant, threads)
        for unit in units:
            on_done(unit, workshop.do(unit, folder, lambda done, unit=unit: on_step(unit, done)))
        return
    from distributed import as_completed

    failed: list[BaseException] = []
    with _client(scheduler) as client:
        plugin = _plugin(variant, threads)
        client.register_plugin(plugin, name=plugin.name)
        # Not pure: units that are equal are different work all the same; and none keeps its result on the worker.
        futures = {
            client.submit(_do, unit, str(folder), plugin.name, pure=False, key=unit.file, retries=0): unit for unit in units
        }
        for future in as_completed(list(futures)):
            unit = futures.pop(future)
            error = future.exception()
            if error is None:
                on_done(unit, future.result())
            else:
                failed.append(error)
            future.release()
    if failed:
        error = failed[0]
        if isinstance(error, ShadowmapError):
            raise error
        lines = " ".join(str(error).split())
        raise ShadowmapError(f"{len(failed)} batches failed, the first one with {type(error).__name__}: {lines}") from error


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    from distributed import Client, LocalCluster

    if scheduler.startswith("processes:"):
        count = int(scheduler.partition(":")[2])
        # One thread for Python; those of Dr.Jit are its own affair. Workers start anew when they die.
        with (
            LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
            ) as cluster,
            Client(cluster) as client,
        ):
            yield client
        return
    try:
        client = Client(scheduler, timeout=20)
    except OSError as error:
        raise ShadowmapError(f"no Dask scheduler answers at {scheduler}: start one, or give its address.") from error
    with client:
        yield client


def _plugin(variant: str, threads: int) -> Any:
    from distributed import WorkerPlugin

    class WorkshopPlugin(WorkerPlugin):
        """Gives each worker a workshop."""

        name = f"shadowmap-dr-{variant}-{threads}"

        def setup(self, worker: Any) -> None:
            self.workshop = Workshop(variant, threads)

    return WorkshopPlugin()


def _do(unit: Unit, folder: str, plugin: str) -> dict[str, Any]:
    from distributed import get_worker

    return get_worker().plugins[plugin].workshop.do(unit, Path(folder))
