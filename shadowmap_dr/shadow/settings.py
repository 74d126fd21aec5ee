"""Settings of shadow maps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from operator import index

from ..raster import MAX_RESOLUTION
from .filters import FILTERS, filter_kernel
from .methods.registry import DEFAULT, METHODS, PREFILTERED

#: Most texels along each side of a filter.
MAX_FILTER_SIZE = 255
#: Most parts of translucent casters whose depths are encoded apart.
MAX_GROUPS = 8
#: Most tiles of a light.
MAX_TILES = 16
# Filter size of maps whose texels are about as large as pixels: as wide as the footprint of a pixel.
_FOOTPRINT = 3


@dataclass(frozen=True)
class ShadowSettings:
    """Settings of shadow maps.

    Attributes:
        method: ``auto`` (``evsm4``, or ``vsm`` with ``compat``), ``vsm`` (variance), ``esm`` (exponential), ``evsm2``, ``evsm4``
            (exponential variance, two or four moments), ``msm`` (four power moments), ``csm`` (convolution: Fourier series),
            ``pcf`` (percentage-closer: the look-up compares depths and filters the results; a texel that an outline crosses
            has two depths, weighted by area), ``standard`` (one comparison, no gradients) or ``none``.
        resolution: texels along each side of a map.
        adaptive: a renderer may take fewer texels, unfiltered ones, where pixels are larger (:meth:`fewer`).
        tiles: most maps that share the image plane of a directional light or a spot. A renderer takes as many, a power of two, as
            the pixels that see shadows are worth.
        filter: ``box``, ``gaussian``, ``wendland`` or ``none``.
        filter_size: odd number of texels.
        tile_filter_size: the same for maps of which several share a light's image plane, None for ``filter_size``.
        antialias: anti-alias the maps; without it shadows have no gradient to the outlines of their casters.
        bias: depth offset of ``standard`` and ``pcf``, in units of the depth range of the map.
        bleeding: visibilities below this are cut off and the rest is stretched to 0..1; for ``vsm``, ``evsm`` and ``msm``.
        order: terms of the series of ``csm``, an even number.
        supersampling: side of the block of anti-aliased samples whose mean each texel is. Makes coverage and derivatives more
            exact; rasterizes the square of this number as many texels. For pre-filtered methods.
        receiver_range: maps resolve depths only from shortly before the first visible receiver on: the distance of casters
            before it does not matter, and causes no light bleeding.
        cull_backfaces: do not draw backfaces into the maps of directional lights, if they belong to parts that were closed and
            turned outwards when the scene was loaded. Saves a third of drawing. Shadows are the same as long as these parts do
            not turn inside out, not even in a fold. Not with ``compat``.
        transmittance_method: encoding of the depths at which translucent casters take light away: ``msm``, or another method
            that is pre-filtered.
        transmittance_groups: parts of these casters, front to back, whose depths are encoded apart, 1 to 8; 0 for 2, or 4 where a
            texel sees more than eight casters. As many as there are casters tell them all apart.
        transmittance_texels: ``resolution`` of the maps of translucent casters if points look them up once where pixels look
            visibility up several times; 0 if these maps are as the others.
        compat: the conventions of Worchel and Alexa's code: unnormalised radial depth, fixed frusta, dark outside of them, their
            kernels, minimum variance 1e-4.
    """

    method: str = "auto"
    resolution: int = 256
    adaptive: bool = False
    tiles: int = 1
    filter: str = "gaussian"
    filter_size: int = 3
    tile_filter_size: int | None = None
    antialias: bool = True
    bias: float = 5e-3
    compat: bool = False
    bleeding: float = 0.0
    order: int = 4
    supersampling: int = 1
    receiver_range: bool = True
    cull_backfaces: bool = False
    transmittance_method: str = "msm"
    transmittance_groups: int = 0
    transmittance_texels: int = 0

    def __post_init__(self) -> None:
        for name in ("resolution", "tiles", "filter_size", "order", "supersampling", "transmittance_groups"):
            if isinstance(getattr(self, name), bool):
                raise ValueError(f"shadow map {name} is {getattr(self, name)!r}; give a whole number")
            try:
                object.__setattr__(self, name, index(getattr(self, name)))
            except TypeError:
                raise ValueError(f"shadow map {name} is {getattr(self, name)!r}; give a whole number") from None
        for name in ("adaptive", "antialias", "compat", "receiver_range", "cull_backfaces"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"shadow map {name} is {getattr(self, name)!r}; give True or False")
        for name in ("bias", "bleeding"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise ValueError(f"shadow map {name} is {value!r}; give a finite number")
        if self.method == "auto":
            object.__setattr__(self, "method", "vsm" if self.compat else DEFAULT)
        if not isinstance(self.method, str) or self.method not in METHODS:
            raise ValueError(f"shadow method {self.method!r} is unknown; choose one of auto, {', '.join(METHODS)}")
        if not isinstance(self.filter, str) or self.filter not in FILTERS:
            raise ValueError(f"shadow filter {self.filter!r} is unknown; choose one of {', '.join(FILTERS)}")
        if self.compat and self.method not in ("vsm", "standard", "none"):
            raise ValueError(f"shadow method {self.method!r} has no compatible variant; use vsm with compat")
        if not 0 <= self.bleeding < 1:
            raise ValueError(f"light bleeding is to be cut off below {self.bleeding}; give a number from 0 to below 1")
        if not isinstance(self.transmittance_method, str) or self.transmittance_method not in PREFILTERED:
            known = ", ".join(PREFILTERED)
            raise ValueError(f"transmittance method {self.transmittance_method!r} is unknown; choose one of {known}")
        if not 0 <= self.transmittance_groups <= MAX_GROUPS:
            raise ValueError(f"transmittance groups are {self.transmittance_groups}; give 1 to {MAX_GROUPS}, or 0 for automatic")
        if not 2 <= self.order <= 16 or self.order % 2:
            raise ValueError(f"the order of the Fourier series is {self.order}; it must be an even number from 2 to 16")
        if not 1 <= self.resolution <= 4096:
            raise ValueError(f"shadow map resolution is {self.resolution}; it must lie between 1 and 4096")
        if not 1 <= self.tiles <= MAX_TILES:
            raise ValueError(f"shadow tiles are {self.tiles}; they must lie between 1 and {MAX_TILES}")
        if self.compat and self.cull_backfaces:
            raise ValueError("compat has fixed frusta, which may begin inside of a caster: do not combine it with cull_backfaces")
        if not 1 <= self.supersampling <= 8 or self.supersampling * self.resolution > MAX_RESOLUTION:
            raise ValueError(
                f"shadow map supersampling is {self.supersampling}; it must lie between 1 and 8, "
                f"and maps may have {MAX_RESOLUTION} texels along a side in all"
            )
        if self.supersampling > 1 and self.method != "none" and (self.compat or not self.filterable):
            raise ValueError(f"shadow method {self.method!r} cannot be supersampled; use a pre-filtered one without compat")
        if not 1 <= self.filter_size <= MAX_FILTER_SIZE:
            raise ValueError(f"shadow filter size is {self.filter_size}; it must be odd, and lie between 1 and {MAX_FILTER_SIZE}")
        filter_kernel(self.filter, self.filter_size)
        if self.tile_filter_size is not None:
            filter_kernel(self.filter, self.tile_filter_size)
        if self.filter_size + 6 > self.resolution and self.method != "none":
            raise ValueError(
                f"shadow filter size {self.filter_size} is too large for maps of {self.resolution} texels; "
                f"use at least {self.filter_size + 6} texels"
            )

    @property
    def of_tiles(self) -> ShadowSettings:
        """Settings of maps that share a light's image plane."""
        return self if self.tile_filter_size is None else replace(self, filter_size=self.tile_filter_size)

    def fewer(self, texels: int) -> ShadowSettings:
        """Settings of maps of so many texels along each side, filtered as tiles, if that is fewer than ``resolution``."""
        return replace(self.of_tiles, resolution=texels) if texels < self.resolution else self

    @property
    def of_transmittance(self) -> ShadowSettings:
        """Settings of transmittance maps."""
        if not self.transmittance_texels:
            return self
        filters = "box" if self.transmittance_texels < self.resolution else self.filter
        return replace(self, resolution=self.transmittance_texels, filter=filters, filter_size=_FOOTPRINT)

    @property
    def filters(self) -> bool:
        """True if a filter blends neighbouring texels."""
        return self.filter != "none" and self.filter_size > 1

    @property
    def footprint(self) -> int:
        """Texels along each side that a stored texel is made of."""
        return self.filter_size if self.filters else 1

    @property
    def counts_from_planes(self) -> bool:
        """True if depths in tiles count from the plane that fits the visible points best. Other methods' biases and errors are
        shares of the depth range, which would be too little on slopes then."""
        return self.method in PREFILTERED and PREFILTERED[self.method].scales

    @property
    def filterable(self) -> bool:
        """True if stored values may be blended, that is, anti-aliased and filtered."""
        return self.method in PREFILTERED
