"""Options that several experiments have."""

from __future__ import annotations

from ...io.options import option


def scheduler_option() -> str:
    """The scheduler of a sweep, see :func:`shadowmap_dr.inverse.run_sweep`."""
    return option("local", metavar="local|processes:N|tcp://HOST:PORT", help="Scheduler of the runs: this process, or workers.")


def threads_option() -> int:
    """Dr.Jit's threads in each process of a sweep."""
    return option(0, help="Threads of each process, 0 for one for each core.")


def cameras_option() -> tuple[str, ...]:
    """Cameras of the experiments on derivatives of one shadow."""
    cameras = ("orthographic", "perspective")
    return option(cameras, names=("--camera",), choices=cameras, shown="both", help="Camera; repeatable.")
