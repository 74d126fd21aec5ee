"""How a scene is rendered."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from .aovs import AOVS
from .errors import ShadowmapError
from .shadow import ShadowSettings

#: Most samples of one extended light.
MOST_SAMPLES = 4096


@dataclass(frozen=True)
class RenderSettings:
    """How a scene is rendered.

    Attributes:
        shadow: see :class:`ShadowSettings`.
        antialias: anti-alias silhouettes in the image; without it they have no gradient.
        ambient: radiance of unshadowed light that arrives from everywhere, beside that of the scene's environment.
        hide_emitters: environments light the scene, but are not seen themselves.
        emitter_samples: points on each area light, each with a shadow map.
        environment_samples: directions of an environment, each with a shadow map.
        soft_map_resolution: texels along each side of these maps.
        shadow_samples: look-ups along each side of a pixel's footprint (``samples ** 2`` in all), or 0 for 2 where the image is
            not larger than the shadow map and 1 otherwise.
        aovs: names of further channels, see :data:`shadowmap_dr.aovs.AOVS`.
    """

    shadow: ShadowSettings = field(default_factory=ShadowSettings)
    antialias: bool = True
    ambient: float = 0.0
    hide_emitters: bool = False
    shadow_samples: int = 0
    emitter_samples: int = 32
    environment_samples: int = 64
    soft_map_resolution: int = 128
    aovs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in self.aovs:
            if name not in AOVS:
                raise ShadowmapError(f"There is no AOV '{name}': choose from {', '.join(AOVS)}.")
        if not 0 <= self.shadow_samples <= 8:
            raise ShadowmapError(f"shadow_samples is {self.shadow_samples}: choose 0 (automatic) to 8.")
        for name in ("emitter_samples", "environment_samples"):
            if not 1 <= getattr(self, name) <= MOST_SAMPLES:
                raise ShadowmapError(f"{name} is {getattr(self, name)}: choose 1 to {MOST_SAMPLES}.")
        if not (self.ambient >= 0 and self.ambient < float("inf")):
            raise ShadowmapError(f"ambient is {self.ambient}: give a finite radiance of at least 0.")

    @property
    def soft_shadow(self) -> ShadowSettings:
        """Settings of the maps of extended lights."""
        try:
            return replace(self.shadow, resolution=self.soft_map_resolution)
        except ValueError as error:
            raise ShadowmapError(f"{error} (soft_map_resolution)") from None
