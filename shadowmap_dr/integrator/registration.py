"""Registration of the plug-in ``shadowmap``. Its modules, and all that renders, are imported when a scene first asks for it."""

from __future__ import annotations

import functools
from collections.abc import Callable

import mitsuba as mi

from ..errors import ShadowmapError
from .name import PLUGIN


def install() -> None:
    """Register the plug-in now and for all variants that will be set."""
    mi.detail.add_variant_callback(register)
    register()


def register(old: str | None = None, new: str | None = None) -> None:
    """Make the plug-in known to the current variant, if there is one. Called by Mitsuba whenever the variant changes."""
    variant = new or mi.variant()
    if variant is not None:
        mi.register_integrator(PLUGIN, _constructor(variant))


def _constructor(variant: str) -> Callable[[mi.Properties], mi.Integrator]:
    @functools.cache
    def integrator_class() -> type:
        from .plugin import make_class

        return make_class()

    def construct(props: mi.Properties) -> mi.Integrator:
        if variant.endswith(("_ad_rgb", "_ad_mono")):
            return integrator_class()(props)
        raise ShadowmapError(
            f"'{PLUGIN}' does not work with the variant {variant}: set one whose name ends in _ad_rgb or _ad_mono, "
            "for instance llvm_ad_rgb."
        )

    return construct
