"""Dictionaries and scenes as Mitsuba's users have them: only the integrator's type is exchanged."""

from __future__ import annotations

import traceback
import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, render, shadowmap, small_scene

import shadowmap_dr
from shadowmap_dr import ShadowmapError

LAMP = {
    "type": "sphere",
    "center": [1, 0, 2.5],
    "radius": 0.4,
    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 4.0}},
}
SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ({"rr_depth": 5}, "ignores rr_depth: a parameter"),
        ({"shading_samples": 4, "bsdf_samples": 1}, "ignores bsdf_samples, shading_samples: parameters"),
        ({"sppc": 8, "sppp": 8, "sppi": 32, "guiding": "grid"}, "ignores guiding, sppc, sppi, sppp"),
        (
            {"guiding_proj": False, "guiding_rounds": 2, "project_seed": "both"},
            "ignores guiding_proj, guiding_rounds, project_seed",
        ),
        ({"proj_seed_spp": 64}, "ignores proj_seed_spp"),
        ({"emitter_samples": 1}, "ignores emitter_samples: a parameter of Mitsuba's integrators. Points on area lights are"),
    ],
)
def test_parameters_of_other_integrators(variant: str, entries: dict[str, Any], named: str) -> None:
    with pytest.warns(UserWarning) as found:
        integrator = mi.load_dict({"type": "shadowmap", "max_depth": 2, **entries})
    assert len(found) == 1 and named in str(found[0].message)
    assert integrator.shell.settings == shadowmap_dr.RenderSettings()


@pytest.mark.parametrize("optimize", [False, True])
def test_xml(variant: str, optimize: bool) -> None:
    xml = """<scene version="3.0.0"><integrator type="shadowmap">
        <integer name="max_depth" value="3"/><integer name="sppc" value="4"/>
        <string name="guiding" value="none"/><boolean name="hide_emitters" value="true"/></integrator>
        <shape type="rectangle"/><emitter type="point"/></scene>"""
    with pytest.warns(UserWarning) as found:
        scene = mi.load_string(xml, optimize=optimize)
    texts = [str(warning.message) for warning in found]
    assert len(texts) == 2 and "guiding, sppc" in texts[0] and "max_depth 3 as 2" in texts[1]
    assert scene.integrator().shell.settings.hide_emitters


def test_typing_errors_name_what_is_near(variant: str) -> None:
    with pytest.raises(RuntimeError) as error:
        shadowmap(max_dept=2)
    assert str(error.value).strip().splitlines()[-1].endswith("the nearest is 'max_depth'.")


@pytest.mark.parametrize("hidden", [False, True])
@pytest.mark.parametrize("depth", [0, 1, 2])
def test_max_depth(variant: str, depth: int, hidden: bool) -> None:
    scene = small_scene(camera=camera(32, pixel_format="rgba" if depth == 0 else "rgb"), lamp=LAMP, sky=SKY)
    common = {"max_depth": depth, "hide_emitters": hidden}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        image = render(scene, shadowmap(**common), spp=16)
    traced = render(scene, mi.load_dict({"type": "path", **common}), spp=256)
    if depth == 0:
        assert not image.any() and not traced.any()
        return
    # Outlines are filtered differently.
    assert np.quantile(np.abs(image - traced).max(2), 0.9) < (1e-3 if depth == 1 else 0.06)
    assert np.abs(image - traced).mean() < 0.02


@pytest.mark.parametrize("depth", [-1, 3, 8])
def test_deeper_paths(variant: str, depth: int) -> None:
    with pytest.warns(UserWarning, match=f"max_depth {depth} as 2: light that is reflected more than once is left out"):
        integrator = shadowmap(max_depth=depth)
    scene = small_scene(camera=camera(16))
    assert np.array_equal(render(scene, integrator), render(scene, shadowmap()))


@pytest.mark.parametrize("depth", [0, 1])
def test_derivatives_without_light(variant: str, depth: int) -> None:
    scene = small_scene(camera=camera(16), lamp=LAMP)
    params = mi.traverse(scene)
    names = ("lamp.emitter.radiance.value", "floor.bsdf.reflectance.value")
    for name in names:
        dr.enable_grad(params[name])
    params.update()
    image = mi.render(scene, params, integrator=shadowmap(max_depth=depth))
    dr.backward(dr.sum(image.array))
    radiance, reflectance = (np.ravel(dr.grad(params[name])) for name in names)
    assert (np.abs(radiance) > 0).all() == (depth == 1) and not reflectance.any()


def test_aovs_without_light(variant: str) -> None:
    integrator = shadowmap(max_depth=1, aovs="depth,visibility")
    image = render(small_scene(camera=camera(16)), integrator)
    assert integrator.aov_names() == ["depth"] and image.shape == (16, 16, 4) and image[..., 3].any()


def nested(**options: Any) -> Any:
    return mi.load_dict({"type": "aov", "aovs": "far:depth,n:sh_normal", "picture": {"type": "shadowmap", **options}})


def test_nested_in_aov(variant: str) -> None:
    scene = small_scene(camera=camera(24))
    image = render(scene, nested(), spp=4)
    assert image.shape == (24, 24, 7)
    assert np.array_equal(image[..., :3], render(scene, shadowmap(), spp=4))
    traced = render(scene, mi.load_dict({"type": "aov", "aovs": "far:depth,n:sh_normal", "picture": {"type": "direct"}}), spp=4)
    assert np.allclose(image[..., 3:], traced[..., 3:], atol=1e-4)


def test_channels_of_its_own_in_aov(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="has channels of its own .aovs is 'depth'., which aov cannot pass on"):
        nested(aovs="depth").render(small_scene(camera=camera(8)))


@pytest.mark.parametrize("name", ["floor.bsdf.reflectance.value", "ball.vertex_positions"])
def test_derivatives_in_aov(variant: str, name: str) -> None:
    found = {}
    for kind, integrator in (("nested", nested()), ("alone", shadowmap())):
        scene = small_scene(camera=camera(24))
        params = mi.traverse(scene)
        dr.enable_grad(params[name])
        params.update()
        image = mi.render(scene, params, integrator=integrator, spp=4)
        dr.backward(dr.sum(image[..., :3].array))
        backward = np.ravel(dr.grad(params[name]))
        image = mi.render(scene, params, integrator=integrator, spp=4)
        dr.set_grad(params[name], 1)
        dr.forward_to(image)
        found[kind] = backward, np.array(dr.grad(image))[..., :3]
    for a, b in zip(found["nested"], found["alone"], strict=True):
        assert np.abs(b).max() > 0
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5 * np.abs(b).max())


def test_what_samples_single_rays_is_refused(variant: str) -> None:
    inner = shadowmap()
    scene, outer = small_scene(camera=camera(8)), mi.load_dict({"type": "moment", "inner": inner})
    with pytest.raises(ShadowmapError, match="cannot be nested in integrators that sample single rays"):
        outer.render(scene, spp=1)
    # The same object in both: only one of them may ask.
    around = mi.load_dict({"type": "aov", "aovs": "far:depth", "inner": inner})
    assert render(scene, around).shape == (8, 8, 4)
    with pytest.raises(RuntimeError) as error:
        mi.render(scene, integrator=outer, spp=1)
    assert "sample single rays" in "".join(traceback.format_exception(error.value))
