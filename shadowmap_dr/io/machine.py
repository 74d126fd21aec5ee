"""Conditions of measurements, and the entries with which all records of experiments begin."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import __version__, _llvm
from .records import plain

#: Dr.Jit's version.
DRJIT_VERSION = importlib.metadata.version("drjit")


def header(settings: Mapping[str, Any]) -> dict[str, Any]:
    """First entries of a record: the version of this package, the machine, and the settings, as JSON values."""
    return {"shadowmap_dr": __version__, "machine": plain(machine()), "settings": plain(settings)}


def machine() -> dict[str, Any]:
    """Conditions of a measurement: processor, threads, versions, variant."""
    llvm = _llvm.loaded_version()
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": dr.thread_count(),
        "gpu": f"CUDA {dr.detail.cuda_version()}" if dr.has_backend(dr.JitBackend.CUDA) else None,
        "system": platform.platform(),
        "variant": mi.variant(),
        "shadowmap_dr": __version__,
        "mitsuba": mi.__version__,
        "drjit": DRJIT_VERSION,
        "llvm": ".".join(map(str, llvm)) if llvm else None,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _processor() -> str:
    try:
        entries = [line.split(":", 1) for line in Path("/proc/cpuinfo").read_text().splitlines() if ":" in line]
    except OSError:
        return platform.processor() or platform.machine()
    found = {name.strip(): value.strip() for name, value in entries}
    vector = next((kind for kind in ("avx512f", "avx2") if kind in found.get("flags", "").split()), "")
    numbers = [f"family {found['cpu family']} model {found['model']}"] if "cpu family" in found and "model" in found else []
    return ", ".join(filter(None, [found.get("model name", platform.machine()), *numbers, vector]))
