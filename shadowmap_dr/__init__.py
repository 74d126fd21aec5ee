"""Differentiable shadow mapping for Mitsuba 3."""

from . import _llvm

_llvm.ensure()  # before anything imports mitsuba or drjit

from .errors import ShadowmapError  # noqa: E402

__version__ = "0.1.0"

__all__ = ["ShadowmapError", "__version__"]
