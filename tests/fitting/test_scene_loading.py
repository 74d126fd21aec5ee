"""Scene files with pictures of 8 bits, whose values are to vary."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import Vary, fit, prepared, write_fit
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.scene_loading import load_scene
from shadowmap_dr.io import assets
from shadowmap_dr.io.images import write_image

KEY = "wall.bsdf.reflectance.data"
SCENE = """<scene version="3.0.0">
    <default name="fov" value="40"/>
    <sensor type="perspective" id="camera"><float name="fov" value="$fov"/>
        <transform name="to_world"><lookat origin="0, 0, 3" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/><rfilter type="box"/></film>
    </sensor>
    <emitter type="directional" id="sun"><vector name="direction" x="0" y="0" z="-1"/></emitter>
    <shape type="rectangle" id="wall"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
        <string name="filename" value="wall.png"/><string name="filter_type" value="nearest"/></texture></bsdf></shape>
</scene>"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    mi.set_variant("llvm_ad_rgb")
    pixels = np.random.default_rng(0).integers(60, 200, (8, 8, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "wall.png")
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def test_textures_have_numbers_with_derivatives(file: Path) -> None:
    usual, loaded = mi.load_file(str(file), optimize=False), load_scene(file, {"fov": "41"})
    table = mi.traverse(loaded)
    assert not dr.is_float_v(mi.traverse(usual)[KEY]) and dr.is_diff_v(table[KEY]) and dr.is_float_v(table[KEY])
    assert list(table.keys()) == list(mi.traverse(usual).keys())
    assert table["camera.x_fov"][0] == pytest.approx(41)
    images = [mi.render(one, spp=16, integrator=mi.load_dict({"type": "direct"})) for one in (load_scene(file), usual)]
    np.testing.assert_allclose(*map(np.array, images), atol=1e-3)


def test_all_scenes_of_the_package_load_alike() -> None:
    mi.set_variant("llvm_ad_rgb")
    for name in assets.scene_names():
        path = assets.scene(name)
        assert list(mi.traverse(load_scene(path)).keys()) == list(mi.traverse(mi.load_file(str(path), optimize=False)).keys())


def test_a_texture_in_a_file_is_fitted(file: Path) -> None:
    seen = np.array(mi.render(mi.load_file(str(file)), spp=64, integrator=mi.load_dict({"type": "direct"})))[..., :3]
    Image.fromarray(np.full((8, 8, 3), 128, np.uint8)).save(file.parent / "wall.png")
    fit = prepared(file, seen, ["wall.bsdf:texture"], steps=120)
    (found,) = fit.run().estimates
    (picture,) = fit.result().pictures
    first, last = (np.abs(image - picture.target).mean() for image in (picture.start, picture.fit))
    assert first > 0.02 and last < first / 3
    assert found.arrays["texture"].shape == (8, 8, 3)


def test_whole_numbers_and_bad_files_are_refused_in_a_line(file: Path, tmp_path: Path) -> None:
    scene = mi.load_file(str(file), optimize=False)
    with pytest.raises(ShadowmapError, match=f"{KEY} holds whole numbers"):
        Resolver(Renderer.from_scene(scene)).parameters([Vary("wall.bsdf", "texture")])
    with pytest.raises(ShadowmapError, match="the file does not exist"):
        load_scene(tmp_path / "none.xml")
    (tmp_path / "bad.xml").write_text("<scene version='3.0.0'><shape type='nothing'/></scene>")
    with pytest.raises(ShadowmapError, match=r"cannot load .*bad\.xml"):
        load_scene(tmp_path / "bad.xml")


@pytest.mark.parametrize("coloured", [True, False])
def test_grey_textures_of_coloured_pictures(file: Path, coloured: bool) -> None:
    """The words say what is wrong with the texture, not with the start."""
    seen = np.array(mi.render(mi.load_file(str(file)), spp=64, integrator=mi.load_dict({"type": "direct"})))[..., :3]
    picture = seen if coloured else np.repeat(seen.mean(2, keepdims=True), 3, 2)
    Image.fromarray(np.full((8, 8), 128, np.uint8)).save(file.parent / "wall.png")
    result = prepared(file, picture, ["wall.bsdf:texture"], steps=120).run()
    words = "wall.bsdf has one channel, so that it is grey, and the picture has colours: give it three channels."
    assert (words in result.words) == coloured and result.found != coloured


def test_files_in_other_folders(file: Path) -> None:
    """``path`` says where they are, also with the value of a parameter."""
    (file.parent / "pictures").mkdir()
    (file.parent / "wall.png").rename(file.parent / "pictures" / "wall.png")
    text = SCENE.replace("<default", '<default name="folder" value="none"/><path value="$folder"/><default', 1)
    (file.parent / "none").mkdir()
    file.write_text(text)
    scene = load_scene(file, {"folder": "pictures"})
    assert np.shape(mi.traverse(scene)[KEY])[:2] == (8, 8)
    with pytest.raises(ShadowmapError, match="wall.png"):
        load_scene(file)


def test_pixels_of_a_sky(file: Path) -> None:
    """They are fitted without recordings, since Mitsuba reads them back, and are written."""
    pixels = np.random.default_rng(0).uniform(0.2, 1, (4, 8, 3)).astype(np.float32)
    sky = '<emitter type="envmap" id="sky"><string name="filename" value="{}"/></emitter></scene>'
    for name, picture in (("true", pixels), ("grey", np.full_like(pixels, 0.5))):
        write_image(file.parent / f"{name}.exr", picture)
        (file.parent / f"{name}.xml").write_text(SCENE.replace("</scene>", sky.format(f"{name}.exr")))
    direct, files = mi.load_dict({"type": "direct"}), [file.parent / f"{name}.xml" for name in ("true", "grey")]
    seen, before = (np.array(mi.render(load_scene(one), spp=256, integrator=direct)) for one in files)
    result = fit(files[1], seen[..., :3], ["sky.data:texture"], steps=40, starts=1, spp=1)
    write_fit(result, file.parent / "out")
    after = np.array(mi.render(load_scene(file.parent / "out" / "scene.xml"), spp=256, integrator=direct))
    assert np.abs(after - seen).mean() < 0.3 * np.abs(before - seen).mean()
