"""Settings of a rendering."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from numbers import Integral, Real
from typing import Any, ClassVar

from ..errors import ShadowmapError, did_you_mean
from ..shadow import MAX_TILES, ShadowSettings
from .film.aovs import AOVS, split_aovs

#: Most samples of one extended light.
MOST_SAMPLES = 4096
#: Names of settings of shadow maps where all settings are given together -> fields of :class:`ShadowSettings`. Its ``bias`` has
#: none.
SHADOW_NAMES = {
    "shadow_map_resolution": "resolution",
    "compat": "compat",
    "transmittance_method": "transmittance_method",
    "transmittance_groups": "transmittance_groups",
    **{
        f"shadow_{name}": name
        for name in (
            *("method", "tiles", "filter", "filter_size", "antialias", "bleeding", "order", "supersampling"),
            *("receiver_range", "cull_backfaces"),
        )
    },
}
#: A ``shadow_map_resolution``: texels follow pixels.
AUTO = "auto"
#: Most translucent surfaces along a ray.
MOST_LAYERS = 64
#: ``max_depth`` of light that is reflected once on its way to the camera.
DIRECT = 2


@dataclass(frozen=True)
class RenderSettings:
    """Settings of a rendering.

    Attributes:
        shadow: see :class:`ShadowSettings`.
        antialias: anti-alias silhouettes in the image; without it they have no gradient.
        ambient: radiance of unshadowed light that arrives from everywhere, beside that of the scene's environment.
        hide_emitters: the camera looks through area lights, and sees black instead of environments, which light the scene all
            the same.
        max_depth: 0 is black, 1 shows emitters only, 2 is direct light, as in Mitsuba; more, or -1, is the same as 2.
        area_light_samples: points on each area light, each with a shadow map; ``auto``: 8 to 32, twice as many as its penumbrae
            have pixels, more for near lights (:mod:`.extended_lights.sample_counts`). With 64 samples per pixel or more, each
            sample sees a fourth (ninth, ...) of them if that number divides theirs (interleaved sampling).
        environment_light_samples: directions of an environment, each with a shadow map.
        soft_map_resolution: texels along each side of these maps.
        emitter_shadows: ``samples``, or ``single``: one map of ``shadow.resolution`` texels (a power of two) for each area light,
            from which penumbrae are estimated; fast, and right for simple occluders only.
        shadow_samples: look-ups along each side of a pixel's footprint (``samples ** 2`` in all), or 0 for 1 where the image is
            larger than the shadow map, else 2 to 4, one for every two texels of the map that a pixel of the image has.
        light_memory: memory (GiB) for the shadow maps of lights, derivatives included. Maps of more lights are made one slice of
            the lights after the other, and once more for derivatives.
        translucent_layers: most translucent surfaces along the rays of cameras and of lights, nearest first; ``auto``: as many as
            the scene has when it is loaded, and one more, at most 32. Farther ones are left out.
        aovs: names of further channels, see :data:`shadowmap_dr.rendering.film.aovs.AOVS`. Text with commas is split into a
            tuple, as in the plug-in.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    shadow: ShadowSettings = field(default_factory=lambda: ShadowSettings(**_automatic({})))
    antialias: bool = True
    ambient: float = 0.0
    hide_emitters: bool = False
    max_depth: int = DIRECT
    shadow_samples: int = 0
    area_light_samples: int | str = AUTO
    environment_light_samples: int = 64
    soft_map_resolution: int = 128
    emitter_shadows: str = "samples"
    light_memory: float = 2.0
    translucent_layers: int | str = AUTO
    aovs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "aovs", split_aovs(self.aovs))
        except (TypeError, AttributeError):
            raise ShadowmapError(f"aovs is {self.aovs!r}: give names, as in 'depth,normal' or ('depth', 'normal').") from None
        for name in self.aovs:
            if name not in AOVS:
                raise ShadowmapError(f"There is no AOV '{name}': choose from {', '.join(AOVS)}.{did_you_mean(name, AOVS)}")
        for name in ("antialias", "hide_emitters"):
            if not isinstance(getattr(self, name), bool):
                raise ShadowmapError(f"{name} is {getattr(self, name)!r}: give True or False.")
        chosen = {name: getattr(self, name) for name in ("area_light_samples", "environment_light_samples")}
        if chosen["area_light_samples"] == AUTO:
            del chosen["area_light_samples"]
        for name in ("shadow_samples", *chosen, "max_depth"):
            if isinstance(getattr(self, name), bool) or not isinstance(getattr(self, name), Integral):
                raise ShadowmapError(f"{name} is {getattr(self, name)!r}: give an integer.")
        if self.max_depth < -1:
            raise ShadowmapError(f"max_depth is {self.max_depth}: choose -1 (no limit), or 0 and more.")
        if not 0 <= self.shadow_samples <= 8:
            raise ShadowmapError(f"shadow_samples is {self.shadow_samples}: choose 0 (automatic) to 8.")
        for name in chosen:
            if not 1 <= getattr(self, name) <= MOST_SAMPLES:
                raise ShadowmapError(f"{name} is {getattr(self, name)}: choose 1 to {MOST_SAMPLES}.")
        layers = self.translucent_layers
        if layers != AUTO and (not isinstance(layers, int) or isinstance(layers, bool) or not 1 <= layers <= MOST_LAYERS):
            raise ShadowmapError(f"translucent_layers is {layers!r}: give {AUTO}, or an integer from 1 to {MOST_LAYERS}.")
        if self.emitter_shadows not in ("samples", "single"):
            raise ShadowmapError(f"emitter_shadows is {self.emitter_shadows!r}: choose samples or single.")
        size = self.shadow.resolution
        if self.emitter_shadows == "single" and (size < 8 or size & (size - 1)):
            raise ShadowmapError(f"shadow map resolution is {size}; with emitter_shadows 'single' choose a power of two from 8")
        if self.shadow.method != "none":
            _ = self.soft_shadow  # whether such maps can be
        if isinstance(self.ambient, bool) or not isinstance(self.ambient, Real) or not 0 <= self.ambient < float("inf"):
            raise ShadowmapError(f"ambient is {self.ambient!r}: give a finite radiance of at least 0.")
        memory = self.light_memory
        if isinstance(memory, bool) or not isinstance(memory, Real) or not 0 < memory < float("inf"):
            raise ShadowmapError(f"light_memory is {memory!r}: give a positive number of GiB.")

    @classmethod
    def of(cls, **named: Any) -> RenderSettings:  # Any: checked by the records
        """From values by the names that the plug-in's parameters and the keywords of ``Renderer.from_scene`` have: those of the
        fields here, and :data:`SHADOW_NAMES`. Defaults are those of the records.

        Raises:
            ShadowmapError: an unknown name, with the nearest known one; an invalid value.
        """
        own = [setting.name for setting in fields(cls) if setting.name != "shadow"]
        for name in named:
            if name not in own and name not in SHADOW_NAMES:
                known = sorted([*own, *SHADOW_NAMES])
                nearest = get_close_matches(name, known, 1)
                hint = f"; the nearest is '{nearest[0]}'" if nearest else ""
                raise ShadowmapError(f"There is no setting '{name}': there are {', '.join(known)}{hint}.")
        try:
            shadow = ShadowSettings(**_automatic({SHADOW_NAMES[n]: value for n, value in named.items() if n in SHADOW_NAMES}))
        except ValueError as error:
            raise ShadowmapError(str(error)) from None
        return cls(shadow, **{name: value for name, value in named.items() if name in own})

    @property
    def lit(self) -> bool:
        """True if surfaces reflect light."""
        return not 0 <= self.max_depth < DIRECT

    def look_ups(self, width: int) -> int:
        """Look-ups along each side of a pixel's footprint in images of this many columns of samples."""
        if self.shadow_samples:
            return self.shadow_samples
        return 1 if width > self.shadow.resolution else min(max(2, self.shadow.resolution // (2 * width)), 4)

    @property
    def soft_shadow(self) -> tuple[ShadowSettings, ShadowSettings]:
        """Settings of the maps of extended lights: those of samples, and single ones."""
        try:
            sampled = replace(self.shadow, resolution=self.soft_map_resolution)
        except ValueError as error:
            raise ShadowmapError(f"{error} (soft_map_resolution)") from None
        return sampled, replace(self.shadow, method="vsm", filter="none", filter_size=1, supersampling=1, compat=False)


def _automatic(shadow: dict[str, Any]) -> dict[str, Any]:  # Any: checked by the record
    """Values of :class:`ShadowSettings` without ``auto`` as a resolution, which is the default: tiles as pixels need them."""
    automatic = shadow.get("resolution", AUTO) == AUTO
    given = {name: value for name, value in shadow.items() if not (name == "resolution" and automatic)}
    if given.get("tiles", 0) == 0:
        given["tiles"] = MAX_TILES if automatic and not given.get("compat") else 1
    if given.get("filter_size", 0) == 0:
        given.pop("filter_size", None)
        given["tile_filter_size"] = 1  # texels of tiles are as small as pixels
        given["adaptive"] = automatic and not given.get("compat") and given.get("supersampling", 1) == 1
    return given
