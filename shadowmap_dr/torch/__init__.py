"""The raster functions, shadow maps and the renderer as differentiable functions of PyTorch tensors.

Tensors are float32, indices any integers, and all of one call lie on one device: the CPU, or the GPU that Dr.Jit uses. Any
strides will do. Functions copy what they are given and share no memory with what they return, so tensors may be changed in
place before and after the backward pass; that may run more than once (``retain_graph=True``). There are first derivatives only,
in reverse and forward. Bad input raises a one-line :class:`shadowmap_dr.ShadowmapError`.

``torch.func`` works: ``grad``, ``vjp``, ``jvp``, ``jacrev``, ``jacfwd``, and ``vmap`` as a loop over images; it cannot batch
:func:`rasterize` and :func:`render_maps`. Code compiled by ``torch.compile`` calls all functions as they are (graph breaks).

Images are stored as in Mitsuba: row 0 of what is rasterized lies at y = -1 in clip space.

PyTorch's threads on the CPU wait for their next work by spinning, and Dr.Jit's threads have fewer cores meanwhile: a step takes
1.4 to 1.8 times as long. If PyTorch was not imported before, importing this module lets them sleep (``OMP_WAIT_POLICY=PASSIVE``,
unless that is set); else set this variable before Python starts.

Importing this module also tells glibc to keep freed blocks of up to 32 MiB, at most 256 MiB in all, for PyTorch's next tensors,
unless ``MALLOC_TRIM_THRESHOLD_``, ``MALLOC_MMAP_THRESHOLD_`` or ``GLIBC_TUNABLES`` is set: 0.85 times the time of a step at
512 x 512.

Importing this module needs PyTorch: in a checkout ``pip install '.[torch]'``, elsewhere ``pip install torch``.
"""

from __future__ import annotations

import os
import sys

if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

try:
    import torch  # noqa: F401
except ModuleNotFoundError as error:
    if error.name != "torch":
        raise
    from ..errors import install_hint

    raise ImportError(f"shadowmap_dr.torch needs PyTorch: {install_hint('torch')}.", name="torch") from None

from .antialias import antialias, build_topology
from .memory import keep_freed_blocks
from .parameters import Parameters
from .raster import interpolate, rasterize
from .records import Raster, Topology
from .render import Renderer
from .shadow import DirectionalLight, Light, PointLight, ShadowMaps, SpotLight, filter_maps, render_maps, visibility

keep_freed_blocks()

__all__ = [
    "DirectionalLight",
    "Light",
    "Parameters",
    "PointLight",
    "Raster",
    "Renderer",
    "ShadowMaps",
    "SpotLight",
    "Topology",
    "antialias",
    "build_topology",
    "filter_maps",
    "interpolate",
    "rasterize",
    "render_maps",
    "visibility",
]
