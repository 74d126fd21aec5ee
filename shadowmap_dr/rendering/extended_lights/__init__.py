"""Extended lights: area lights and environments as many samples, each with a shadow map."""

from .sample_maps import (
    SoftFrusta,
    SoftLight,
    SoftMaps,
    SoftPlan,
    check_soft_sizes,
    fit_soft_maps,
    make_soft_maps,
    plan_soft,
    samples_of,
    soft_map_vertices,
    still_aimed,
)
from .samples import LightSamples
from .shading import interleaving_of, sample_visibilities, soft_light
from .sky_samples import SkyWatch

__all__ = [
    "LightSamples",
    "SkyWatch",
    "SoftFrusta",
    "SoftLight",
    "SoftMaps",
    "SoftPlan",
    "check_soft_sizes",
    "fit_soft_maps",
    "interleaving_of",
    "make_soft_maps",
    "soft_map_vertices",
    "plan_soft",
    "samples_of",
    "soft_light",
    "still_aimed",
    "sample_visibilities",
]
