"""Small images of an object on a ground that reaches the horizon: most pixels see a small part of the light's map. References are
Mitsuba's."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from scipy.ndimage import binary_erosion

from mitsuba_baselines.derivatives import agreement
from shadowmap_dr import Renderer
from shadowmap_dr.io import assets

Array = npt.NDArray[np.float64]
SIZE = 96


def bunny_on(half: float, size: int = SIZE, shift: float = 0, sunk: float = 0.25, ground: Any = None, **others: Any) -> mi.Scene:
    """A bunny, 1.4 high, that has sunk into a ground of so much in each direction, in the sun. ``others``: instead of the sun."""
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = t().look_at([-1.5, -3.2, 1.6], [0, 0, 0.5], [0, 0, 1])
    place = t().translate([shift, 0, 0]).rotate([1, 0, 0], 90).scale(0.7).translate([0, 0.97 - sunk / 0.7, 0])
    sun = {"type": "directional", "direction": [0.9, -0.3, -1.0]}
    return mi.load_dict({
        "type": "scene",
        **(others or {"sun": sun}),
        "sensor": {"type": "perspective", "fov": 45, "to_world": view, "film": film},
        "ground": {"type": "rectangle", "to_world": t().scale(half), "bsdf": ground or {"type": "diffuse"}},
        "bunny": {"type": "ply", "filename": str(assets.mesh("bunny")), "to_world": place},
    }, optimize=False)  # fmt: skip


# Below the ground, so that this casts a shadow on it, and its maps cover all of the ground.
CELLAR: dict[str, Any] = {"type": "sphere", "center": [0, 0, -2], "radius": 0.3}
SUN: dict[str, Any] = {"sun": {"type": "directional", "direction": [0.9, -0.3, -1.0]}}


def traced(scene: mi.Scene, spp: int) -> Array:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=spp), np.float64)


def relative_error(image: Array, reference: Array) -> float:
    return float(np.sqrt(((image - reference) ** 2).mean() / (reference**2).mean()))


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(("half", "tiles", "most"), [(2.0, 1, 0.025), (10.0, 2, 0.015), (100.0, 4, 0.015)])
def test_shadows_are_as_sharp_on_wide_grounds(half: float, tiles: int, most: float) -> None:
    """With one map the error was 0.046 and 0.123 on the wider ones."""
    size = 128
    scene = bunny_on(half, size, cellar=CELLAR, **SUN)
    renderer = Renderer.from_scene(scene)
    assert renderer.plan.tiles == (tiles,)
    assert relative_error(np.array(renderer.render(spp=4), np.float64), traced(scene, 64)) < most


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("light", ["sun", "spot", "lamp", "sky"])
@pytest.mark.parametrize("sunk", [0.3, 0.8])
def test_grounds_hide_what_has_sunk_into_them(light: str, sunk: float) -> None:
    """No map has to cover the ground for it. Before, the sun had four maps, the lamp six times as many as now.

    Errors were up to 0.06 under the spot, and 0.05 under the sky.
    """
    t = mi.ScalarTransform4f
    lights: dict[str, Any] = {
        "sun": SUN["sun"],
        "spot": {"type": "spot", "to_world": t().look_at([-3, 1, 4], [0, 0, 0], [0, 0, 1]), "cutoff_angle": 60},
        "lamp": {"type": "rectangle", "to_world": t().look_at([-3, 1, 4], [0, 0, 0], [0, 0, 1]), "emitter": {"type": "area"}},
        "sky": {"type": "constant"},
    }
    scene = bunny_on(100, 64, sunk=sunk, **{light: lights[light]})
    renderer = Renderer.from_scene(scene)
    assert renderer.plan.tiles in ((1,), ()) and all(plan.kind != "cube" for plan in renderer.light_pass.soft)
    spp = 1024 if light in ("lamp", "sky") else 64
    assert relative_error(np.array(renderer.render(spp=4), np.float64), traced(scene, spp)) < 0.02


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("kind", ["edge", "below", "glass"])
def test_grounds_cast_shadows_on_what_cameras_see_of_it(kind: str) -> None:
    """Past the edge of a small ground, from below, and through glass."""
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    origin = [0, -5, -0.6] if kind == "below" else [0, -5, 0.6 if kind == "edge" else 2.5]
    glass = {"type": "mask", "opacity": 0.3, "nested": {"type": "twosided", "nested": {"type": "diffuse"}}}
    scene = mi.load_dict({
        "type": "scene", "sun": {"type": "directional", "direction": [0.2, 0.3, -1]},
        "sensor": {"type": "perspective", "fov": 35, "to_world": t().look_at(origin, [0, 0, -0.3], [0, 0, 1]), "film": film},
        "ground": {"type": "rectangle", "to_world": t().scale(1.2), "bsdf": glass if kind == "glass" else {"type": "diffuse"}},
        "post": {"type": "cube", "to_world": t().scale([0.3, 0.3, 0.9])},
    }, optimize=False)  # fmt: skip
    direct = mi.load_dict({"type": "volpath", "max_depth": 2})
    reference = np.array(mi.render(scene, integrator=direct, spp=256), np.float64)
    assert relative_error(np.array(Renderer.from_scene(scene).render(spp=4), np.float64), reference) < 0.03


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("tiles", [True, False])
def test_derivatives_by_places_on_wide_grounds(tiles: bool) -> None:
    """With one map of all of the ground cosine and scale were 0.86 and 0.81 at 128 x 128 pixels."""
    step = 0.012
    pair = [traced(bunny_on(100, shift=sign * step), 256) for sign in (1, -1)]
    renderer = Renderer.from_scene(bunny_on(100, **({"cellar": CELLAR} if tiles else {}), **SUN))
    assert (renderer.plan.tiles[0] > 1) == tiles
    shift = mi.Float(0)
    dr.enable_grad(shift)
    moved = renderer.vertices("bunny") + mi.Point3f(shift, 0, 0)
    image = renderer.render({"bunny": moved}, spp=4)
    dr.forward(shift)
    found = agreement(np.array(dr.grad(image), np.float64), (pair[0] - pair[1]) / (2 * step))
    assert found.cosine > 0.97 and found.scale == pytest.approx(1, abs=0.05)


@pytest.mark.usefixtures("variant")
def test_many_lights_keep_one_map_each_in_small_images() -> None:
    suns = {f"sun{k}": {"type": "directional", "direction": [0.3 * k, -0.3, -1.0]} for k in range(4)}
    assert Renderer.from_scene(bunny_on(100, cellar=CELLAR, **suns)).plan.tiles == (1,) * 4
    del suns["sun3"]
    assert Renderer.from_scene(bunny_on(100, cellar=CELLAR, **suns)).plan.tiles == (4,) * 3


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("half", [3.0, 300.0])
def test_skies_do_not_shine_through_wide_grounds(half: float) -> None:
    """Maps of the sky below the ground are as wide as its view, if they count the points on it. The error was 0.10 then."""
    scene = bunny_on(half, sunk=0, sky={"type": "constant"})
    assert relative_error(np.array(Renderer.from_scene(scene).render(spp=4), np.float64), traced(scene, 256)) < 0.03


@pytest.mark.usefixtures("variant")
def test_grounds_that_spread_light_are_lit_from_below() -> None:
    """Points on them count in maps of the sky below them."""
    thin = {"type": "principledthin", "diff_trans": 1.6, "base_color": {"type": "rgb", "value": 0.8}}
    below = {"type": "sphere", "center": [-0.6, -1.2, -0.5], "radius": 0.4}
    scene = bunny_on(3, sunk=0, ground=thin, sky={"type": "constant"}, below=below)
    assert relative_error(np.array(Renderer.from_scene(scene).render(spp=4), np.float64), traced(scene, 256)) < 0.045


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("sunk", [-0.1, 0.3])
def test_borders_of_maps_are_not_seen(sunk: float) -> None:
    """Light where a spot's map ends, around a box above and in a ground: pixels were up to 0.8 % darker.

    ``tests/fitting/test_views.py`` has the derivative by the spot's direction, whose cosine with differences was 0.90 for that.
    """
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    place = t().look_at([1, 1, 4], [0, 0, 0.3], [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene", "spot": {"type": "spot", "to_world": place, "cutoff_angle": 25, "beam_width": 18},
        "sensor": {"type": "perspective", "fov": 45, "to_world": t().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1]), "film": film},
        "ground": {"type": "rectangle", "to_world": t().scale(4)},
        "box": {"type": "cube", "to_world": t().translate([0, 0, 0.4 - sunk]).scale([0.45, 0.3, 0.4])},
    }, optimize=False)  # fmt: skip
    image, bare = (np.array(Renderer.from_scene(scene, shadow_method=one).render(), np.float64) for one in ("auto", "none"))
    lit = binary_erosion((traced(scene, 64) > 0.9 * bare).all(2), iterations=5)
    assert lit.mean() > 0.2 and (image[lit] > 0.999 * bare[lit]).all()
