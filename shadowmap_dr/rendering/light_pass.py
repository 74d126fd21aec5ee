"""The lights of one rendering with their shadow maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ..scene.lights.area import AreaLight
from ..scene.lights.read import Light
from ..scene.load import SceneData
from ..shadow import ShadowMaps
from .extended_lights import LightSamples, SoftMaps, SoftPlan, check_soft_sizes, plan_soft
from .settings import RenderSettings


@dataclass(frozen=True)
class Lighting:
    """The lights of one rendering with their shadow maps, None where there are none."""

    lights: tuple[Light, ...]
    maps: ShadowMaps | None
    areas: tuple[AreaLight, ...]
    samples: tuple[LightSamples, ...]
    soft_maps: SoftMaps | None

    def for_points(self, count: int) -> Lighting:
        """The same for look-ups by so many points at once (:meth:`~shadowmap_dr.shadow.ShadowMaps.for_points`)."""
        return self if self.maps is None else replace(self, maps=self.maps.for_points(count))


def plan_extended_lights(data: SceneData, settings: RenderSettings) -> tuple[SoftPlan, ...]:
    lights, single = (*data.areas, *data.environments), settings.emitter_shadows == "single"
    soft = plan_soft(lights, data.geometry, settings.area_light_samples, settings.environment_light_samples, single)
    if settings.shadow.method != "none":
        check_soft_sizes(soft, data.geometry, settings.soft_map_resolution)
    return soft
