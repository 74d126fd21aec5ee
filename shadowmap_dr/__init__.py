"""Differentiable shadow mapping for Mitsuba 3."""

from . import _llvm

_llvm.ensure()  # before anything imports mitsuba or drjit

import mitsuba as mi  # noqa: E402

from . import integrator, variants  # noqa: E402
from .errors import ShadowmapError  # noqa: E402
from .rendering import Renderer, RenderSettings  # noqa: E402
from .shadow import ShadowSettings  # noqa: E402

__version__ = "0.1.0"

variants.warn_if_untried(mi.__version__)
integrator.install()  # the plug-in `shadowmap`, in this variant and all that will be set

__all__ = ["RenderSettings", "Renderer", "ShadowSettings", "ShadowmapError", "__version__"]


def __dir__() -> list[str]:
    return [*__all__, "__all__", "__doc__", "__file__", "__name__", "__path__"]
