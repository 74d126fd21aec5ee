"""Sizes of the benchmark that take seconds."""

from __future__ import annotations

from shadowmap_dr.experiments.bench.common import Sizes

TINY = Sizes(
    resolutions=(16,),
    rounds=2,
    mitsuba_rounds=1,
    default_steps={},
    starts=1,
    iterations=3,
    path_traced=False,
    meshes=("teapot-1k",),
    raster_resolutions=(8, 16),
    worst={"slivers-20": "even-20", "screen-filling-10": "teapot-1k"},
    full_raster=("spot-6k", (16,)),
    series={"resolution": (8, 16), "lights": (1, 2)},
    light_resolutions=(16,),
    passes=1,
    large=("teapot-1k", 16),
    batch=(1, 2),
    batch_resolution=8,
    sums=((16, 1),),
    crowds=({"instances": 4, "groups": 2, "shapes": 4, "lights": 3},),
    loop_size=8,
    loop_steps=0,
    plugin_kinds=("camera", "reflectance"),
    plugin_resolutions=(8,),
    plugin_samples=(2,),
    plugin_lights=((2, "points"),),
    torch_resolutions=(8,),
    cold=("pose",),
    cold_rounds=1,
    fits=("bunny-pose",),
    fit_starts=1,
)
