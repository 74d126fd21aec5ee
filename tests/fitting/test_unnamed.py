"""Fits of scenes whose objects have no ids: Mitsuba names those by their place in memory."""

from __future__ import annotations

import re
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.fitting import Vary, fit, write_fit
from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.listing import listed
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.scene_file import write_fitted_scene
from shadowmap_dr.fitting.scene_loading import load_scene
from shadowmap_dr.scene.naming import name_objects

CAMERA = """<sensor type="perspective">
    <transform name="to_world"><lookat origin="{}, -3, 4" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm">
        <integer name="width" value="48"/><integer name="height" value="36"/><rfilter type="box"/>
    </film></sensor>"""
SCENE = f"""<scene version="3.0.0">
    {CAMERA.format(2)}
    {CAMERA.format(-2)}
    <shape type="rectangle"><transform name="to_world"><scale value="4"/></transform><bsdf type="diffuse"/></shape>
    <shape type="cube"><transform name="to_world"><scale value="0.4"/><translate x="0" y="0" z="0.5"/></transform>
        <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.2, 0.5, 0.3"/></bsdf></bsdf></shape>
    <emitter type="spot"><transform name="to_world"><lookat origin="1, 1, 5" target="0, 0, 0" up="0, 1, 0"/></transform>
        <rgb name="intensity" value="60"/><float name="cutoff_angle" value="30"/></emitter>
    <emitter type="constant"><rgb name="radiance" value="0.1"/></emitter>
</scene>"""
BOX = "shape_1.bsdf.brdf_0.reflectance.value"


@pytest.fixture(autouse=True)
def one_backend() -> None:
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "scene.xml").write_text(SCENE)
    return tmp_path / "scene.xml"


def picture(scene: mi.Scene, sensor: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "direct"}), spp=1024))[..., :3]


LISTED = ("camera_0:fov", "camera_1:fov", "light_0.cutoff_angle", "shape_1:scale")


def effects(file: Path, sensors: set[int]) -> dict[str, str]:
    """The last column of a list by names."""
    name, _, _, effect = listed(load_scene(file), [Vary.parse(entry) for entry in LISTED], sensors).columns
    return dict(zip(map(str, name.cells), map(str, effect.cells), strict=True))


def test_names_count_objects(file: Path) -> None:
    for scene in (load_scene(file), mi.load_file(str(file), optimize=False)):
        resolver = Resolver(Renderer.from_scene(scene))
        names = [one.name for one in resolver.candidates()]
        assert not [name for name in names if not name or name.startswith("object")]
        wanted = {
            "shape_0",
            "shape_1",
            "light_0",
            "camera_0",
            "camera_1",
            BOX,
            "light_0.intensity.value",
            "light_1.radiance.value",
        }
        assert wanted <= set(names)
        for entry in ("shape_*:pose", "shape_1:rotation", "light_0:direction", "camera_1:fov", "shape_0.bsdf.reflectance"):
            assert resolver.parameter(Vary.parse(entry)).labels


def test_ids_that_are_taken_get_a_number() -> None:
    scene = mi.load_dict({"type": "scene", "shape_0": {"type": "sphere"}, "shape_2": {"type": "cube"}})
    shapes = {shape.id(): shape for shape in scene.shapes()}
    for name in ("shape_0", "shape_2"):
        shapes[name].set_id("")
    next(iter(shapes.values())).set_id("shape_1")
    name_objects(scene)
    assert sorted(shape.id() for shape in scene.shapes()) == ["shape_1", "shape_1_1"]
    assert [info.name for info in Renderer.from_scene(scene).data.geometry.shapes] == [shape.id() for shape in scene.shapes()]


def test_names_of_files_that_mitsuba_writes(tmp_path: Path) -> None:
    """They have ``name`` where scene files have ``id``."""
    config = mi.parser.ParserConfig("llvm_ad_rgb")
    mi.parser.write_file(mi.parser.parse_dict(config, mi.cornell_box()), str(tmp_path / "box.xml"))
    names = [one.name for one in Resolver(Renderer.from_scene(load_scene(tmp_path / "box.xml"))).candidates()]
    assert {"small-box", "green-wall", "sensor", "white.reflectance.value", "light.emitter.radiance.value"} <= set(names)


def test_the_list_has_effects_of_lights_and_cameras(file: Path) -> None:
    first, second = effects(file, set()), effects(file, {1})
    for name in first:
        assert float(first[name].removesuffix(" %")) > 0 and float(second[name].removesuffix(" %")) > 0, name
    # Each camera has its effect on its own image; all else on those that are asked for.
    assert first["camera_1"] == second["camera_1"] and first["shape_1"] != second["shape_1"]
    assert effects(file, {0, 1})["shape_1"] in (first["shape_1"], second["shape_1"])


def test_fitted_scenes_keep_the_names(file: Path, tmp_path: Path) -> None:
    truth = load_scene(file)
    name_objects(truth)
    params = mi.traverse(truth)
    params[BOX] = mi.Color3f(0.6, 0.3, 0.2)
    params["light_0.intensity.value"] = mi.Color3f(90, 80, 50)
    params["camera_1.x_fov"] = 41.0
    params.update()
    vary = [BOX, "light_0.intensity", "camera_1:fov"]
    result = fit(file, [picture(truth), picture(truth, 1)], vary, starts=1, correct=False, spp=4)
    assert result.found
    written = write_fit(result, tmp_path / "out")
    again = load_scene(tmp_path / "out" / "scene.xml")
    name_objects(again)
    table = mi.traverse(again)
    assert list(table.keys()) == list(params.keys())
    assert not [words for words in result.words if "could not" in words], written
    np.testing.assert_allclose(np.ravel(table[BOX]), (0.6, 0.3, 0.2), atol=0.02)
    np.testing.assert_allclose(np.ravel(table["light_0.intensity.value"]), (90, 80, 50), rtol=0.03)
    np.testing.assert_allclose(np.ravel(table["camera_1.x_fov"]), 41, atol=0.1)
    text = (tmp_path / "out" / "scene.xml").read_text()
    assert not re.search(r"unnamed|object_", text)


def test_scenes_that_mitsuba_has_loaded_are_written_too(file: Path, tmp_path: Path) -> None:
    """Their objects are counted, although the file has names for them."""
    config = mi.parser.ParserConfig("llvm_ad_rgb")
    mi.parser.write_file(mi.parser.parse_file(config, str(file)), str(file))
    file.write_text(file.read_text().replace('type="cube"', 'type="cube" name="box"'))
    written = write_fitted_scene(file, {}, Changes(transforms={"shape_1": 2 * np.eye(4)}), tmp_path / "out")
    assert not written.notes
    before, after = (load_scene(one).shapes()[1] for one in (file, tmp_path / "out" / "scene.xml"))
    assert before.id() == after.id() == "box"
    old, new = (np.array(mi.traverse(one)["vertex_positions"]) for one in (before, after))
    np.testing.assert_allclose(new, 2 * old, atol=1e-5)
