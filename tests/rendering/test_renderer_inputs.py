"""Names, settings and numbers that the functional renderer cannot use."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from renderer_scenes import build, renderer_of, rest

from shadowmap_dr import Renderer, ShadowmapError


@pytest.fixture
def renderer(variant: str) -> Renderer:
    return renderer_of()


def test_unknown_names(renderer: Renderer) -> None:
    with pytest.raises(ShadowmapError, match="no shape 'bal' in the scene; its shapes are 'ball', 'floor'"):
        renderer.render(vertex_positions={"bal": rest(renderer)})
    with pytest.raises(ShadowmapError, match="no light 'moon' in the scene; its lights: 'sun', 'lamp'"):
        renderer.render(lights={"moon": renderer.light("sun")})
    with pytest.raises(ShadowmapError, match="There is no sensor 1: the scene has 1, counted from 0"):
        renderer.render(sensor=1)
    with pytest.raises(ShadowmapError, match="give its number in the scene"):
        renderer.render(sensor=mi.load_dict({"type": "perspective"}))
    with pytest.raises(ShadowmapError, match=r"aovs is 3: give names, as in 'depth,normal' or \('depth', 'normal'\)"):
        Renderer.from_scene(renderer.data.scene, aovs=3)
    with pytest.raises(ShadowmapError, match="There is no AOV 'dept': .* Did you mean 'depth'?"):
        Renderer.from_scene(renderer.data.scene, aovs="normal,dept")
    with pytest.raises(ShadowmapError, match="There is no sensor -1"):
        renderer.render(sensor=-1)


def test_numbers_of_numpy_are_numbers(renderer: Renderer) -> None:
    assert np.array_equal(renderer.render(sensor=np.int64(0)).numpy(), renderer.render().numpy())
    assert Renderer.from_scene(renderer.data.scene, tessellation=np.int64(16)).data.geometry.face_count


def test_inputs_of_the_wrong_kind(renderer: Renderer) -> None:
    with pytest.raises(ShadowmapError, match="vertex_positions is a Point3f: give a dictionary"):
        renderer.render(rest(renderer))
    with pytest.raises(ShadowmapError, match="There is no sensor -1"):
        renderer.render(sensor=np.int64(-1))
    before = mi.variant()
    mi.set_variant(before.replace("rgb", "mono"))
    try:
        with pytest.raises(ShadowmapError, match="The variant is .*_ad_mono, but this renderer was made for .*_ad_rgb: set that"):
            renderer.render()
    finally:
        mi.set_variant(before)


def test_scenes_and_settings_that_are_none(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="'scene.xml' is no mi.Scene of the variant .*: load it"):
        Renderer.from_scene("scene.xml")
    with pytest.raises(ShadowmapError, match="a NoneType is no mi.Scene"):
        Renderer.from_scene(None)
    with pytest.raises(ShadowmapError, match="There is no setting 'shadow_bias': there are .*shadow_bleeding"):
        Renderer.from_scene(build(), shadow_bias=1)


def test_damaged_files_of_scenes_are_named(variant: str, tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_bytes(b"v 0 0 \xff\nf 1 1 1\n")
    shape = {"type": "obj", "filename": str(tmp_path / "a.obj")}
    with pytest.raises(ShadowmapError, match=r"cannot load the dictionary: a file that it names is damaged\.$"):
        Renderer.from_dict({"type": "scene", "shape": shape})
    with pytest.raises(ShadowmapError, match="cannot load the dictionary: At dictionary node"):  # no position in Mitsuba's source
        Renderer.from_dict({"type": "scene", "shape": {"type": "no such shape"}})


@pytest.mark.parametrize("length", [1e-25, 1e-3, 1e25, 3e38])
def test_directions_of_any_length(renderer: Renderer, length: float) -> None:
    """Squares of their components may be out of range."""
    sun = renderer.light("sun")
    image = renderer.render().numpy()
    direction = mi.Vector3f(sun.direction) * length
    dr.enable_grad(direction)
    scaled = renderer.render(lights={"sun": replace(sun, direction=direction)})
    np.testing.assert_allclose(scaled.numpy(), image, atol=1e-3)
    dr.backward(dr.mean(scaled))
    assert all(np.isfinite(np.array(dr.grad(direction))))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", range(3))
def test_a_vertex_that_is_not_finite_takes_its_triangles_only(renderer: Renderer, axis: int, value: float) -> None:
    """And not the shadow of the whole mesh, whose bounds it is in."""
    points = rest(renderer).numpy().T.copy()
    # On the lower side, where neither the camera nor a light sees its triangles.
    lowest = int(points[:, 2].argmin())
    expected = renderer.render(vertex_positions={"ball": mi.Float(points.ravel())}).numpy()
    points[lowest, axis] = value
    with pytest.warns(UserWarning, match="1 of 162 vertices of shape 'ball' are not finite"):
        found = renderer.render(vertex_positions={"ball": mi.Float(points.ravel())}).numpy()
    assert (np.abs(found - expected).max(2) > 0.05).sum() <= 2


@pytest.mark.parametrize("spp", [0, -1, float("nan"), "4", None, True, 10**9, float("inf")])
def test_numbers_of_samples_that_are_none(renderer: Renderer, spp: Any) -> None:
    with pytest.raises(ShadowmapError, match=rf"spp is {re.escape(repr(spp))}: give at"):
        renderer.render(spp=spp)


def test_wrong_kinds_and_sizes(renderer: Renderer) -> None:
    with pytest.raises(ShadowmapError, match="Light 'sun' is a DirectionalLight, not a PointLight"):
        renderer.render(lights={"sun": renderer.light("lamp")})
    with pytest.raises(ShadowmapError, match="shape 'ball' are an array of 9 numbers, but 162 vertices need 486"):
        renderer.render(vertex_positions={"ball": mi.Float([0.0] * 9)})
    with pytest.raises(ShadowmapError, match=r"tensor shape \(3, 162\), but it has 162 vertices"):
        renderer.render(vertex_positions={"ball": np.zeros((3, 162), np.float32)})


@pytest.mark.parametrize(
    "options, message",
    [
        ({"shadow_method": "esm2"}, "shadow method 'esm2' is unknown"),
        ({"shadow_map_resolution": 5000}, "resolution is 5000"),
        ({"shadow_filter": "tent"}, "shadow filter 'tent' is unknown"),
        ({"shadow_filter_size": 8}, "8"),
        ({"shadow_filter_size": 99999}, "shadow filter size is 99999; it must be odd, and lie between 1 and 255"),
        ({"shadow_map_resolution": True}, "resolution is True"),
        ({"ambient": "1"}, "ambient is '1'"),
        ({"shadow_filter_size": 9, "shadow_map_resolution": 8}, "too large for maps of 8 texels"),
        ({"shadow_samples": 9}, "shadow_samples is 9"),
        ({"shadow_samples": 1.5}, "shadow_samples is 1.5: give an integer"),
        ({"area_light_samples": "4"}, "area_light_samples is '4': give an integer"),
        ({"ambient": float("nan")}, "ambient is nan"),
        ({"aovs": ("albedo",)}, "no AOV 'albedo'"),
        ({"aovs": 1.5}, "aovs is 1.5: give names, as in 'depth,normal'"),
        ({"aovs": ([],)}, "aovs is ([],): give names"),
        ({"shadow_method": []}, "shadow method [] is unknown"),
        ({"antialias": "no"}, "antialias is 'no': give True or False"),
        ({"shadow_antialias": 2}, "shadow map antialias is 2; give True or False"),
        ({"compat": None}, "shadow map compat is None; give True or False"),
        ({"shadow_bleeding": True}, "shadow map bleeding is True; give a finite number"),
        ({"tessellation": 1}, "tessellation is 1"),
    ],
)
def test_bad_settings(variant: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ShadowmapError) as error:
        Renderer.from_scene(build(), **options)
    assert message in str(error.value) and "\n" not in str(error.value)
