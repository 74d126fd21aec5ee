"""Fitted scenes as files: Mitsuba reads what was changed, and nothing else is another. Files of all kinds, and bad input."""

from __future__ import annotations

import shutil
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from scene_files import FILM, SCENES, check_all, mesh_file, numbers, picture, read, scene, turned, write

from shadowmap_dr.errors import OutputError, ShadowmapError
from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.scene_file import write_fitted_scene
from shadowmap_dr.importing import ImportOptions, import_model


def test_only_changed_lines_are_others(tmp_path: Path, variant: str) -> None:
    file = SCENES / "gallery.xml"
    written = write(file, tmp_path, values={"wall.bsdf.reflectance.value": np.array([0.1, 0.2, 0.3])})
    before, after = (path.read_text(encoding="utf-8").splitlines() for path in (file, written.files[0]))
    others = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
    assert len(others) == 4 and not written.notes
    assert others[1] == (
        '            <rgb name="reflectance" value="0.62, 0.60, 0.56"/>',
        '            <rgb name="reflectance" value="0.1, 0.2, 0.3"/>',
    )
    assert all("filename" in old and "scenes/" in new for old, new in (others[0], others[2], others[3]))


def test_a_fit_of_a_fit(tmp_path: Path, variant: str) -> None:
    first = write(SCENES / "gallery.xml", tmp_path, transforms={"dragon": turned()}, values={"sun.to_world": turned(1)})
    second = write_fitted_scene(first.files[0], {}, Changes(transforms={"dragon": turned(2)}), tmp_path / "again")
    assert not second.notes
    old = np.array(mi.traverse(mi.load_file(str(SCENES / "gallery.xml"), optimize=False))["dragon.vertex_positions"])
    matrix = turned(2) @ turned()
    expected = old.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(np.array(read(second)["dragon.vertex_positions"]).reshape(-1, 3), expected, atol=1e-4)
    with pytest.raises(OutputError, match="the scene itself would be overwritten; give another folder"):
        write_fitted_scene(second.files[0], {}, Changes(), tmp_path / "again")


def nested(folder: Path) -> Path:
    """A scene of several files, in folders with blanks."""
    picture(folder / "pictures of mine" / "t.png")
    mesh_file(folder / "parts" / "b.ply")
    mesh_file(folder / "ä ö.ply")
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="$pictures/t.png"/></texture>'
    inner = f'<bsdf type="diffuse" id="mat">{texture}</bsdf>'
    scene(folder, inner, "parts/deep er.xml")
    scene(folder, '<include filename="parts/deep er.xml"/><bsdf type="plastic" id="plastic"/>', "one.xml")
    scene(folder, '<shape type="ply" id="two"><string name="filename" value="b.ply"/><ref id="mat"/></shape>', "parts/two.xml")
    body = """<default name="pictures" value="pictures of mine"/><default name="red" value="0.5, 0.1, 0.1"/>
    <default name="mesh" value="ä ö.ply"/><path value="parts"/>
    <include filename="one.xml"/>
    <include filename="$which.xml"/>
    <shape type="ply" id="ball"><string name="filename" value="$mesh"/><bsdf type="diffuse">
    <rgb name="reflectance" value="$red"/></bsdf></shape>
    <shape type="cube" id="box"><ref id="plastic"/><transform name="to_world"><scale value="$size"/></transform></shape>
    <emitter type="point" id="bulb"><rgb name="intensity" value="$red"/></emitter>"""
    return scene(folder, body, "main of all.xml")


GIVEN = {"which": "two", "size": "3"}


@pytest.mark.parametrize("copy_files", [False, True])
def test_included_files_and_constants(tmp_path: Path, variant: str, copy_files: bool) -> None:
    file = nested(tmp_path / "source ö")
    values = {
        "plastic.diffuse_reflectance.value": np.array([0.3, 0.2, 0.1]),
        "ball.bsdf.reflectance.value": np.array([0.1, 0.2, 0.3]),
    }
    changes = Changes(values=values, transforms={"two": turned(), "box": turned(1)})
    out = tmp_path / "out put"
    written = write_fitted_scene(file, GIVEN, changes, out, copy_files=copy_files)
    assert not written.notes
    if copy_files:
        shutil.rmtree(tmp_path / "source ö")
        out = out.rename(tmp_path / "moved")
    again = mi.traverse(mi.load_file(str(out / "scene.xml"), optimize=False))
    for key, value in values.items():
        np.testing.assert_allclose(np.array(again[key]).ravel(), value, rtol=1e-5)
    np.testing.assert_allclose(np.array(again["bulb.intensity.value"]).ravel(), [0.5, 0.1, 0.1], rtol=1e-5)
    text = (out / "scene.xml").read_text(encoding="utf-8")
    assert '<rgb name="intensity" value="$red"/>' in text and '<default name="red" value="0.5, 0.1, 0.1"/>' in text
    assert '<string name="filename" value="$mesh"/>' in text and '<default name="size" value="3"/>' in text
    assert {path.name for path in written.files[1:]} >= {"one.xml", "two.xml", "deep er.xml"}
    # The parameters can be given again.
    mi.load_file(str(out / "scene.xml"), optimize=False, size="2", red="0.1, 0.1, 0.1")


def test_all_parameters_of_several_files(tmp_path: Path, variant: str) -> None:
    assert not check_all(nested(tmp_path / "source"), tmp_path, GIVEN).notes


def test_given_parameters_become_defaults(tmp_path: Path, variant: str) -> None:
    written = write(
        SCENES / "pose.xml", tmp_path, {"object": "meshes/bunny.ply", "resolution": "32"}, transforms={"object": turned()}
    )
    assert not written.notes
    loaded = mi.load_file(str(written.files[0]), optimize=False)
    assert list(loaded.sensors()[0].film().size()) == [32, 32]
    bunny = mi.load_dict({"type": "ply", "filename": str(SCENES / "meshes/bunny.ply")})
    assert mi.traverse(loaded)["object.vertex_positions"].shape == mi.traverse(bunny)["vertex_positions"].shape
    assert '<string name="filename" value="$object"/>' in written.files[0].read_text()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_encodings(tmp_path: Path, variant: str, encoding: str, ends: str) -> None:
    declared = "" if encoding in ("utf-8-sig", "utf-16") else f' encoding="{encoding.replace("latin-1", "iso-8859-1")}"'
    text = f'<?xml version="1.0"{declared}?>\n<!-- Größe -->\n<scene version="3.0.0">\n'
    text += '  <!-- für ä -->\n  <shape type="cube" id="ä"/>\n'
    text += '  <shape type="sphere" id="b"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>\n</scene>\n'
    (tmp_path / "a.xml").write_bytes(text.replace("\n", ends).encode(encoding))
    written = write(
        tmp_path / "a.xml", tmp_path, values={"b.bsdf.reflectance.value": np.array([0.3, 0.4, 0.5])}, transforms={"ä": turned()}
    )
    assert not written.notes
    np.testing.assert_allclose(np.array(read(written)["b.bsdf.reflectance.value"]).ravel(), [0.3, 0.4, 0.5])
    result = written.files[0].read_bytes().decode("utf-8")
    assert "<!-- Größe -->" in result and "<!-- für ä -->" in result and 'id="ä"' in result


def test_old_scenes(tmp_path: Path, variant: str) -> None:
    """Names with capitals, as before version 2."""
    body = """<shape type="sphere" id="a"><transform name="toWorld"><scale value="2"/></transform>
    <bsdf type="plastic"><rgb name="diffuseReflectance" value="0.2, 0.3, 0.4"/></bsdf></shape>
    <emitter type="spot" id="spot"><transform name="toWorld"><translate x="2"/></transform>
    <float name="cutoffAngle" value="20"/></emitter>"""
    written = check_all(scene(tmp_path, body, version="0.6.0"), tmp_path)
    assert [note.partition(" ")[0] for note in written.notes] == ["spot.texture.value"]
    text = written.files[0].read_text()
    assert 'name="diffuseReflectance"' in text and 'name="toWorld"' in text


def test_imported_models(tmp_path: Path, variant: str) -> None:
    mesh = trimesh.creation.box()
    mesh.visual = trimesh.visual.TextureVisuals(
        np.random.default_rng(0).random((8, 2)),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (200, 100, 50)), name="paint"),
    )
    (tmp_path / "a.glb").write_bytes(trimesh.Scene([mesh]).export(file_type="glb"))
    found = import_model(tmp_path / "a.glb", tmp_path / "imported" / "a.xml", ImportOptions(size=32, floor=True))
    assert all(".spec_trans.value " in note for note in check_all(found.scene, tmp_path).notes)


def test_objects_without_names(tmp_path: Path, variant: str) -> None:
    """Mitsuba names them by their place in memory: the order of all names tells which they are."""
    body = f'<sensor type="perspective">{FILM}</sensor><shape type="cube"/><shape type="sphere"/><shape type="cube" id="b"/>'
    file = scene(tmp_path, body)
    table = mi.traverse(mi.load_file(str(file), optimize=False))
    names = list(table.keys())
    key = next(name for name in names if name.endswith("x_fov"))
    changes = Changes(values={key: np.array([20.0])}, transforms={"shape_0": turned(), "shape_1": turned(1)})
    assert any("no such parameter" in note for note in write_fitted_scene(file, {}, changes, tmp_path / "first").notes)
    written = write_fitted_scene(file, {}, changes, tmp_path / "second", names=names)
    assert not written.notes
    again = read(written)
    assert float(np.ravel(np.array(again[next(name for name in again.keys() if name.endswith("x_fov"))]))[0]) == pytest.approx(20)


def test_dictionaries(tmp_path: Path, variant: str) -> None:
    description = mi.cornell_box() | {"ball": {"type": "ply", "filename": str(SCENES / "meshes/spot.ply")}}
    table = mi.traverse(mi.load_dict(description, optimize=False))
    values = {"red.reflectance.value": np.array([0.1, 0.2, 0.3]), "light.emitter.radiance.value": np.array([5.0, 6.0, 7.0])}
    values["sensor.to_world"] = turned() * np.array([1 / 1.3] * 3 + [1.0])
    written = write_fitted_scene(description, {}, Changes(values=values, transforms={"ball": turned()}), tmp_path / "out")
    assert not written.notes
    again = read(written)
    assert set(again.keys()) == set(table.keys())
    for key, value in values.items():
        np.testing.assert_allclose(numbers(again[key]).ravel(), value.ravel(), atol=1e-5, err_msg=key)
    assert list((tmp_path / "out").iterdir()) == [tmp_path / "out" / "scene.xml"]  # no folder without files


def test_dictionaries_with_objects_are_refused(tmp_path: Path, variant: str) -> None:
    description = {"type": "scene", "ball": mi.load_dict({"type": "sphere"})}
    with pytest.raises(
        ShadowmapError, match="the scene's dictionary cannot be written as a file: .*Describe its parts by dictionaries"
    ):
        write_fitted_scene(description, {}, Changes(), tmp_path)


def test_bad_input(tmp_path: Path, variant: str) -> None:
    (tmp_path / "broken.xml").write_text("<scene version='3.0.0'><shape")
    (tmp_path / "shape.xml").write_text('<shape type="sphere" version="3.0.0"/>')
    for path, given, words in (
        (tmp_path / "none.xml", {}, "no scene .*: the file does not exist"),
        (tmp_path / "broken.xml", {}, "cannot load .*broken.xml"),
        (tmp_path / "shape.xml", {}, "its root is no scene"),
        (SCENES / "pose.xml", {"object": "none.ply"}, "cannot load .*pose.xml"),
    ):
        with pytest.raises(ShadowmapError, match=words) as caught:
            write_fitted_scene(path, given, Changes(), tmp_path / "out")
        assert "\n" not in str(caught.value)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_fitted_scene(SCENES / "pose.xml", {}, Changes(), tmp_path / "file" / "out")
    with pytest.raises(ShadowmapError, match=r"The map of 'wall' has the shape \(3, 3\), but must be a matrix \(4, 4\)"):
        write_fitted_scene(SCENES / "pose.xml", {}, Changes(transforms={"wall": np.eye(3)}), tmp_path / "out")
