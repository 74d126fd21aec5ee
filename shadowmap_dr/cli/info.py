"""The command `shadowmap-dr info`: versions, libraries, and the package's scenes and meshes."""

from __future__ import annotations

import importlib.metadata
import platform

import drjit as dr
import mitsuba as mi
import typer

from .. import __version__, _llvm
from ..io import assets


def info() -> None:
    """Show versions, the LLVM library, variants, threads and the GPU."""
    llvm = _llvm.loaded_version()
    gpu = dr.has_backend(dr.JitBackend.CUDA)
    rows = [
        ("shadowmap_dr", __version__),
        ("mitsuba", mi.__version__),
        *((name, _version(name)) for name in ("drjit", "numpy", "OpenEXR")),
        ("python", platform.python_version()),
        ("LLVM version", ".".join(map(str, llvm)) if llvm else "none"),
        ("LLVM library", str(_llvm.loaded_library() or "none")),
        ("variants", ", ".join(mi.variants())),
        ("threads", str(dr.thread_count())),
        ("GPU", f"CUDA {dr.detail.cuda_version()}" if gpu else "none"),
        ("scenes", ", ".join(assets.scene_names())),
        ("meshes", ", ".join(assets.mesh_names())),
        ("targets", ", ".join(assets.target_names())),
    ]
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        typer.echo(f"{name:<{width}}  {value}")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
