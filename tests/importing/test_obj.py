"""OBJ files with their materials as exporters write them, and without them."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.importing import Imported, import_model

VERTICES = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = ("f 1 2 4 3\n", "f 5/1 6/2 8/3 7/4\n", "f 1 2 6 5\n")
RED = "newmtl red\nKd 0.8 0.1 0.1\n\n"


@pytest.fixture(autouse=True)
def one_backend() -> None:
    mi.set_variant("llvm_ad_rgb")


def imported(folder: Path, library: str = RED, content: str | None = None, head: str = "mtllib a.mtl\n") -> Imported:
    """A file with one object of two materials and one of one, imported beside a library and a picture."""
    (folder / "a.mtl").write_text(library)
    Image.fromarray(np.full((4, 4, 3), (200, 100, 50), np.uint8)).save(folder / "Paint.PNG")
    first, second, third = FACES
    usual = f"o big box\nusemtl red\n{first}o top\nusemtl paint\n{second}usemtl red\n{third}"
    (folder / "m.obj").write_text(head + VERTICES + (content or usual))
    return import_model(folder / "m.obj", folder / "m.xml")


def names(found: Imported) -> set[str]:
    return {shape.id() for shape in mi.load_file(str(found.scene), optimize=False).shapes()}


def own_notes(found: Imported) -> list[str]:
    """Notes but for those of each file without camera and light."""
    return [note for note in found.notes if "the file has no" not in note]


def values(found: Imported) -> mi.SceneParameters:
    return mi.traverse(mi.load_file(str(found.scene), optimize=False))


def test_names_are_those_of_objects_and_materials(tmp_path: Path) -> None:
    found = imported(tmp_path, RED + "newmtl paint\nmap_Kd Paint.PNG\n")
    assert names(found) == {"big_box", "top_red", "top_paint"}
    assert {"red.brdf_0.base_color.value", "paint.brdf_0.base_color.data"} <= set(values(found).keys())
    assert own_notes(found) == ["names that Mitsuba does not take, or that were there twice, are others: 'big box' is 'big_box'"]


def test_libraries_that_are_missing_are_noted(tmp_path: Path) -> None:
    found = imported(tmp_path, head="mtllib none.mtl\n")
    assert own_notes(found)[0] == "materials are left out: there is no file 'none.mtl'"
    assert "big_box" in names(found)  # also without materials


def test_pictures_that_are_missing_or_damaged_are_noted(tmp_path: Path) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    found = imported(tmp_path, RED + "map_Kd none.png\n\nnewmtl paint\nmap_Kd bad.png\n")
    assert own_notes(found)[:2] == [
        "a picture is left out: there is no file 'none.png'",
        "the picture 'bad.png' is left out: it is damaged, too large, or no picture that Pillow reads",
    ]
    np.testing.assert_allclose(np.ravel(values(found)["red.brdf_0.base_color.value"]), (0.8, 0.1, 0.1), atol=3e-3)


@pytest.mark.parametrize(
    "written", ["Paint.PNG", "paint.png", "./Paint.PNG", "C:\\work\\paint.png", "-s 2 2 1 Paint.PNG", "textures/paint.png"]
)
def test_pictures_are_found_as_exporters_write_them(tmp_path: Path, written: str) -> None:
    found = imported(tmp_path, RED + f"newmtl paint\nKd 1 1 1\nmap_Kd {written}\n")
    picture = np.array(values(found)["paint.brdf_0.base_color.data"])
    assert picture.shape[:2] == (4, 4)
    assert any("the options '-s 2 2 1' of 'Paint.PNG' are left out" in note for note in found.notes) == written.startswith("-")


def test_pictures_in_folders_beside_that_of_the_model(tmp_path: Path) -> None:
    (tmp_path / "textures").mkdir()
    Image.fromarray(np.full((2, 2, 3), 90, np.uint8)).save(tmp_path / "textures" / "grey.png")
    (tmp_path / "model").mkdir()
    found = imported(tmp_path / "model", RED + "newmtl paint\nmap_Kd ../textures/grey.png\n")
    assert np.shape(values(found)["paint.brdf_0.base_color.data"])[:2] == (2, 2)


@pytest.mark.parametrize(
    "head", ["mtllib a.mtl\nmtllib b.mtl\n", "mtllib a.mtl b.mtl\n", "mtllib none.mtl\nmtllib a.mtl b.mtl\n"]
)
def test_files_with_several_libraries(tmp_path: Path, head: str) -> None:
    (tmp_path / "b.mtl").write_text("newmtl paint\nKd 0 0 0.7\n")
    found = imported(tmp_path, head=head)
    table = values(found)
    np.testing.assert_allclose(np.ravel(table["red.brdf_0.base_color.value"]), (0.8, 0.1, 0.1), atol=3e-3)
    np.testing.assert_allclose(np.ravel(table["paint.brdf_0.base_color.value"]), (0, 0, 0.7), atol=3e-3)
    assert any("'none.mtl'" in note for note in found.notes) == ("none" in head)


def test_opacity_emission_roughness_and_metal(tmp_path: Path) -> None:
    library = "newmtl red\nKd 0.8 0 0\nd 0.4\nPr 0.3\nPm 0.9\n\nnewmtl paint\nKd 0.1 0.1 0.1\nTr 0.25\nKe 3 2 1\n"
    table = values(imported(tmp_path, library))
    expected = {
        "red.opacity.value": 0.4,
        "red.nested_bsdf.brdf_0.roughness.value": 0.3,
        "red.nested_bsdf.brdf_0.metallic.value": 0.9,
        "paint.opacity.value": 0.75,
        "top_paint.emitter.radiance.value": (3, 2, 1),
    }
    for key, value in expected.items():
        np.testing.assert_allclose(np.ravel(table[key]), value, rtol=1e-5, err_msg=key)


@pytest.mark.parametrize("line", ["d 1", "d 0", "Tr 1", "d -halo 1.0", "d nan", "Ke 0 0 0", "Ke x y z", "Pr"])
def test_values_that_change_nothing(tmp_path: Path, line: str) -> None:
    """Exporters write opacities of zero where they mean one."""
    table = values(imported(tmp_path, f"newmtl red\nKd 0.8 0 0\n{line}\n"))
    assert "red.brdf_0.base_color.value" in table and not [key for key in table.keys() if "opacity" in key or "emitter" in key]


def test_bump_maps_are_noted(tmp_path: Path) -> None:
    found = imported(tmp_path, RED + "map_Bump -bm 0.2 bump.png\nmap_d alpha.png\n")
    assert own_notes(found)[:2] == ["bump maps are left out", "pictures of opacity are left out"]


@pytest.mark.parametrize(
    ("name", "words"), [("gone.png", "there is no file 'gone.png'"), ("bad.png", "'bad.png' is left out: it is dam")]
)
def test_pictures_that_ply_files_name(tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, words: str) -> None:
    (tmp_path / "bad.png").write_bytes(b"no picture")
    numbers = "".join(f"property float {key}\n" for key in "xyzst")
    head = f"ply\nformat ascii 1.0\ncomment TextureFile {name}\nelement vertex 3\n{numbers}element face 1\n"
    faces = "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(head + faces)
    found = import_model(tmp_path / "a.ply", tmp_path / "a.xml")
    assert words in own_notes(found)[0]
    assert not capfd.readouterr().err  # no traceback of trimesh
