"""The Mitsuba variants that commands accept."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .errors import ShadowmapError, did_you_mean, warn

DEFAULT_VARIANT = "llvm_ad_rgb"
#: Endings of variant names: of those that rendering with shadow maps supports, of those with colours, of all.
SUPPORTED, COLOURED, ANY = ("_ad_rgb", "_ad_mono"), ("_ad_rgb",), ("",)

#: Versions of Mitsuba (major, minor) that the tests have run with.
_TRIED = ((3, 9),)


def warn_if_untried(version: str) -> None:
    """Warn of a version of Mitsuba (``mi.__version__``) that the tests have never run with."""
    numbers = tuple(int(part) for part in version.split(".")[:2] if part.isdigit())
    if numbers not in _TRIED:
        newest = ".".join(map(str, _TRIED[-1]))
        warn(f"Mitsuba {version} was never tried with shadowmap_dr. If results look wrong: pip install 'mitsuba=={newest}.*'")


def set_variant(name: str, endings: tuple[str, ...] = SUPPORTED) -> None:
    """Set the Mitsuba variant.

    ``endings``: endings of the variants that the command supports. Raises ShadowmapError if the variant does not exist, does not
    end in one of these, or has no device.
    """
    fitting = [variant for variant in mi.variants() if variant.endswith(endings)]
    if name not in mi.variants():
        raise ShadowmapError(
            f"no variant {name!r} in this Mitsuba: choose one of {', '.join(fitting)}.{did_you_mean(name, fitting)}"
        )
    if name not in fitting:
        raise ShadowmapError(f"this command does not work in the variant {name}: choose one of {', '.join(fitting)}.")
    if name.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise ShadowmapError(f"the variant {name} needs an NVIDIA GPU, and Dr.Jit found none: use {DEFAULT_VARIANT}.")
    mi.set_variant(name)
