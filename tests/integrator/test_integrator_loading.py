"""The plug-in: its parameters, XML, variants, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from dataclasses import fields
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, render, shadowmap, small_scene

import shadowmap_dr
from shadowmap_dr import ShadowmapError
from shadowmap_dr.integrator.options import Options
from shadowmap_dr.jit.threads import second_thread
from shadowmap_dr.rendering.settings import AUTO, SHADOW_NAMES, RenderSettings
from shadowmap_dr.shadow import ShadowSettings

XML = """
<scene version="3.0.0">
  <integrator type="shadowmap">
    <integer name="shadow_map_resolution" value="128"/>
    <string name="shadow_method" value="evsm4"/>
    <string name="shadow_filter" value="box"/>
    <integer name="shadow_filter_size" value="5"/>
    <boolean name="shadow_antialias" value="true"/>
    <integer name="shadow_samples" value="1"/>
    <boolean name="antialias" value="true"/>
    <float name="ambient" value="0.125"/>
    <boolean name="hide_emitters" value="true"/>
    <string name="aovs" value="depth, visibility"/>
    <integer name="tessellation" value="32"/>
    <boolean name="compat" value="false"/>
  </integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="2, -3, 4" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film>
  </sensor>
  <shape type="sphere"><point name="center" x="0" y="0" z="0.9"/><float name="radius" value="0.5"/></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="3"/></transform></shape>
  <emitter type="directional" id="sun"><vector name="direction" x="0.4" y="0.3" z="-1"/></emitter>
</scene>
"""


def test_xml(variant: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(XML)
    scene = mi.load_file(str(path))
    image = mi.render(scene).numpy()
    assert image.shape == (16, 24, 3 + 2) and scene.integrator().aov_names() == ["depth", "visibility.sun"]
    options = dict(shadow_map_resolution=128, shadow_filter="box", shadow_filter_size=5, shadow_samples=1, ambient=0.125)
    assert np.array_equal(image[..., :3], render(scene, shadowmap(tessellation=32, **options)))
    assert "shadow_filter='box'" in str(scene.integrator())
    with second_thread():
        mi.util.write_bitmap(str(tmp_path / "image.exr"), image[..., :3], write_async=False)
    assert (tmp_path / "image.exr").stat().st_size > 0


def test_defaults_are_those_of_the_renderer(variant: str) -> None:
    assert shadowmap().shell.settings == shadowmap_dr.RenderSettings()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"shadow_resolution": 64}, "has no parameter 'shadow_resolution': it has ambient, antialias"),
        ({"shadow_map_resolution": 64.5}, "'shadow_map_resolution' of 'shadowmap' is 64.5, but must be an integer"),
        ({"shadow_map_resolution": 0}, "shadow map resolution is 0"),
        ({"shadow_map_resolution": True}, "is True, but must be an integer"),
        ({"shadow_method": "magic"}, "shadow method 'magic' is unknown; choose one of auto, vsm, esm"),
        ({"shadow_filter": "median"}, "shadow filter 'median' is unknown"),
        ({"shadow_filter_size": 4}, "4"),
        ({"shadow_samples": 100}, "shadow_samples is 100"),
        ({"antialias": 1}, "'antialias' of 'shadowmap' is 1, but must be a boolean"),
        ({"ambient": -1.0}, "ambient is -1.0"),
        ({"ambient": {"type": "rgb", "value": 1.0}}, "but must be a number"),
        ({"aovs": "depth,albedo"}, "no AOV 'albedo': choose from depth, position"),
        ({"aovs": "depth,depth"}, "'depth' is there twice"),
        ({"aovs": "R:depth"}, "'R' is a channel of the image itself"),
        ({"tessellation": 2}, "tessellation is 2"),
    ],
)
def test_bad_parameters(variant: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(RuntimeError) as error:
        shadowmap(**options)
    last = str(error.value).strip().splitlines()[-1]
    assert last.startswith("ShadowmapError: ") and message in last


def test_numbers_may_be_integers(variant: str) -> None:
    assert shadowmap(ambient=1).shell.settings.ambient == 1.0


def test_scene_with_nothing_to_render(variant: str) -> None:
    grid = mi.TensorXf(np.linspace(-1, 1, 27, dtype=np.float32).reshape(3, 3, 3, 1))
    scene = small_scene(ball=None, floor=None, blob={"type": "sdfgrid", "grid": grid})
    with pytest.raises(RuntimeError) as error:
        render(scene)
    assert isinstance(error.value.__cause__, ShadowmapError)
    assert "blob" in str(error.value.__cause__) and "SDFGrid" in str(error.value.__cause__)
    with pytest.raises(ShadowmapError, match="blob"):
        shadowmap().render(scene)


def test_negative_spp(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="spp is -1"):
        shadowmap().render(small_scene(), spp=-1)


def _mono_or_skip(variant: str) -> str:
    mono = variant.replace("_rgb", "_mono")
    if mono not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {mono}")
    return mono


def test_mono_variant(variant: str) -> None:
    colour = render(small_scene(camera=camera(32)))
    mi.set_variant(_mono_or_skip(variant))
    scene = small_scene(camera=camera(32, pixel_format="luminance"))
    params = mi.traverse(scene)
    dr.enable_grad(params["sun.irradiance.value"])
    params.update()
    image = mi.render(scene, params, integrator=shadowmap())
    assert image.shape == (32, 32, 1)
    # White light on grey surfaces.
    assert np.allclose(image.numpy(), colour[..., :1], atol=1e-4)
    dr.backward(dr.sum(image))
    assert dr.grad(params["sun.irradiance.value"])[0] == pytest.approx(image.numpy().sum() / 2, rel=1e-3)


@pytest.mark.parametrize("other", ["scalar_rgb", "llvm_ad_spectral"])
def test_other_variants(variant: str, other: str) -> None:
    if other not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {other}")
    mi.set_variant(other)
    try:
        for load in (lambda: shadowmap(), lambda: mi.load_string(XML)):
            with pytest.raises(RuntimeError) as error:
                load()
            last = str(error.value).strip().splitlines()[-1]
            assert last.startswith("ShadowmapError: ") and other in last and "llvm_ad_rgb" in last
    finally:
        mi.set_variant(variant)
    assert shadowmap().shell.settings == shadowmap_dr.RenderSettings()


@pytest.mark.parametrize("late", [False, True])
def test_order_of_imports(late: bool) -> None:
    """The plug-in is there whether the variant is set before or after the import."""
    lines = ["import shadowmap_dr", "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')"]
    script = textwrap.dedent(
        """
        assert type(mi.load_dict({'type': 'shadowmap'})).__name__ == 'ShadowMapIntegrator'
        mi.set_variant('llvm_ad_mono')
        integrator = mi.load_dict({'type': 'shadowmap'})
        assert isinstance(integrator, mi.Integrator)
        """
    )
    script = "\n".join(["import os", *(reversed(lines) if late else lines), script])
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)


def test_parameters_are_the_settings_of_the_renderer() -> None:
    """Names and defaults, but for those that mean nothing to it."""
    own = {"tessellation", "recorded"}
    options = {option.name: option.default for option in fields(Options) if option.name not in own}
    settings = {setting.name: setting.default for setting in fields(RenderSettings) if setting.name != "shadow"}
    shadow = {name: getattr(ShadowSettings, SHADOW_NAMES[name]) for name in SHADOW_NAMES}
    shadow |= {"shadow_map_resolution": AUTO, "shadow_tiles": 0, "shadow_filter_size": 0}  # chosen by the renderer
    assert options == {**settings, **shadow}
    others = {"bias", "tile_filter_size", "adaptive", "transmittance_texels"}
    assert {setting.name for setting in fields(ShadowSettings)} == {*SHADOW_NAMES.values(), *others}
    assert RenderSettings.of(**options) == RenderSettings()


@pytest.mark.parametrize("aovs", ["depth, visibility", ("depth", "visibility"), ["depth", "visibility"]])
def test_names_of_channels_as_text_or_sequence(aovs: Any) -> None:
    """The plug-in and the renderer keep the same tuple."""
    assert Options(aovs=aovs).aovs == RenderSettings(aovs=aovs).aovs == ("depth", "visibility")
    assert Options(aovs=aovs).render_settings() == RenderSettings.of(aovs=aovs)
