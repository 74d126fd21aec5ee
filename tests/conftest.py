"""Fixtures shared by all tests."""

from __future__ import annotations

import functools
import gc
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

# Threads of NumPy's and PyTorch's own, one for each core in each worker, would spin while they wait. Before these are imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import quick_kernels  # selects the LLVM library before mitsuba is imported, and how it compiles

# isort: split
import drjit as dr
import mitsuba as mi

from tests.slow import slow_tests

TESTS = Path(__file__).parent


#: Folders whose tests are about arrays that several threads write to, and that alone would show it if they disturbed each other.
_TWO_THREADS = ("jit", "raster", "shadow")


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config.option, "loadscopereorder"):  # files with many tests first
        config.option.loadscopereorder = False


def _set_threads(two: bool) -> None:
    """Threads of Dr.Jit in one of several workers; alone it has all cores.

    They look for work in a loop before they sleep. Two in each worker take a third more of the processors' time than one. With
    one, Mitsuba 3.9 waits forever when it reads or writes an EXR file: see :func:`shadowmap_dr.jit.threads.second_thread`.
    """
    if "PYTEST_XDIST_WORKER" not in os.environ or dr.thread_count() == 1 + two:
        return
    before = _threads()
    dr.set_thread_count(1 + two)
    for thread in _threads() - before:  # others wait for the time in which they look for work
        os.setpriority(os.PRIO_PROCESS, thread, 19)


def _threads() -> set[int]:
    """Threads of this process; none where Linux does not list them."""
    tasks = Path("/proc/self/task")
    return {int(task.name) for task in tasks.iterdir()} if tasks.is_dir() else set()


@pytest.hookimpl(hookwrapper=True, trylast=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    _set_threads(item.path.relative_to(TESTS).parts[0] in _TWO_THREADS)  # before fixtures
    yield
    quick_kernels.flush_messages()  # while they are captured


@pytest.hookimpl(hookwrapper=True, trylast=True)
def pytest_runtest_call() -> Iterator[None]:
    yield
    quick_kernels.flush_messages()


pytest_runtest_teardown = pytest_runtest_call


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport() -> Iterator[None]:
    report = (yield).get_result()
    written = [(name, quick_kernels.without_messages(text)) for name, text in report.sections]
    report.sections = [(name, text) for name, text in written if text]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    slow = slow_tests()
    seconds: Counter[Path] = Counter()
    for item in items:
        name = f"{item.path.relative_to(TESTS).as_posix()}::{getattr(item, 'originalname', item.name)}"
        if name in slow:
            item.add_marker(pytest.mark.slow)
        # Before fixtures, some of which collect garbage.
        reason = _missing(str(_values(item).get("variant", "")))
        if reason:
            item.add_marker(pytest.mark.skip(reason=reason))
        else:
            seconds[item.path] += slow.get(name, 0.01)
    if "PYTEST_XDIST_WORKER" in os.environ:
        # Files that take long first: all workers end at the same time.
        items.sort(key=lambda item: -seconds[item.path])
    # Tests of one scene of the gradient suite after one another: they share derivative images, the first of them takes new ones.
    places = [place for place, item in enumerate(items) if item.path.name == "test_gradients.py"]
    for place, item in zip(places, sorted((items[place] for place in places), key=_scene_of), strict=True):
        items[place] = item


def pytest_collection_finish() -> None:
    # Modules stay: tests that collect garbage, by the hundred, need not look through them each time.
    gc.collect()
    gc.freeze()


def _scene_of(item: pytest.Item) -> tuple[str, str, bool]:
    values = _values(item)
    scene = values["traced"].case if "traced" in values else values.get("case", "")
    return values.get("variant", ""), scene, "reverse_mode" not in item.name


def _values(item: pytest.Item) -> dict[str, Any]:  # Any: parameters of a test
    call = getattr(item, "callspec", None)
    return call.params if call else {}


@functools.cache
def _missing(variant: str) -> str:
    """Reason for which tests of a variant of Mitsuba cannot run; empty if they can."""
    if not variant.endswith("_ad_rgb"):
        return ""
    if variant not in mi.variants():
        return f"this Mitsuba has no variant {variant}"
    on_gpu = variant.startswith("cuda")
    if dr.has_backend(dr.JitBackend.CUDA if on_gpu else dr.JitBackend.LLVM):
        return ""
    return "no GPU" if on_gpu else "no LLVM"


@pytest.fixture(params=["llvm_ad_rgb", "cuda_ad_rgb"])
def variant(request: pytest.FixtureRequest) -> Iterator[str]:
    """Sets the Mitsuba variant for a test and names it; tests that use it run once for each backend at hand."""
    name: str = request.param
    if _missing(name):
        pytest.skip(_missing(name))
    mi.set_variant(name)
    yield name


@pytest.fixture(scope="module", autouse=True)
def memory_is_given_back() -> Iterator[None]:
    """Dr.Jit keeps what it once had: without this, workers grow to many gigabytes over the tests."""
    yield
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()


@pytest.fixture(scope="session", autouse=True)
def few_samples_in_fits() -> Iterator[None]:
    """Mitsuba's images in fits have a quarter of the usual samples, each image of them 2^20: fits took half their time for them.

    Their random numbers are the same each time, and their noise is far below what tests of fits allow.
    """
    from shadowmap_dr.fitting import reference

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reference, "_PASS", reference._PASS // 4)
        yield


@pytest.fixture(autouse=True)
def no_garbage_while_frozen(request: pytest.FixtureRequest) -> Iterator[None]:
    """Scenes of earlier tests, collected between two calls of a frozen function, would change the registry that it checks."""
    # Experiments record their steps, whatever their tests are called.
    records = request.path.name.endswith("_experiment.py") or request.path.name == "test_inverse.py"
    if not records and not any(word in request.node.name for word in ("frozen", "freez", "record")):
        yield
        return
    gc.collect()
    gc.disable()
    yield
    gc.enable()
