"""Differentiable shadow mapping for Mitsuba 3."""

from typing import TYPE_CHECKING, Any

from . import _llvm

_llvm.ensure()  # before anything imports mitsuba or drjit

import mitsuba as mi  # noqa: E402

from . import integrator, variants  # noqa: E402
from .errors import ShadowmapError  # noqa: E402

if TYPE_CHECKING:
    from .fitting import Fit, fit
    from .rendering import Renderer, RenderSettings
    from .shadow import ShadowSettings

__version__ = "0.1.0"

variants.warn_if_untried(mi.__version__)
integrator.install()  # the plug-in `shadowmap`, in this variant and all that will be set

__all__ = ["Fit", "RenderSettings", "Renderer", "ShadowSettings", "ShadowmapError", "__version__", "fit"]


def __getattr__(name: str) -> Any:  # Any: one of several classes
    """Classes that are imported when they are first used: the command line's help needs none of them."""
    if name in ("Fit", "fit"):
        from . import fitting

        globals().update(Fit=fitting.Fit, fit=fitting.fit)
        return globals()[name]
    if name not in ("RenderSettings", "Renderer", "ShadowSettings"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from . import rendering, shadow

    globals().update(Renderer=rendering.Renderer, RenderSettings=rendering.RenderSettings, ShadowSettings=shadow.ShadowSettings)
    return globals()[name]


def __dir__() -> list[str]:
    return [*__all__, "__all__", "__doc__", "__file__", "__name__", "__path__"]
