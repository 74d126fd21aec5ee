"""Arrays and materials as other programs write them: integers for fractions, other sets of coordinates, no material at all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shadowmap_dr import ShadowmapError
from shadowmap_dr.importing import import_model
from shadowmap_dr.importing.reader import read_model
from tests.importing.gltf_files import CORNERS, TEXCOORDS, GltfFile
from tests.importing.test_import import matt

STRIPES = np.array([[[255, 0, 0], [0, 0, 255]]] * 2, np.uint8)


def square(file: GltfFile, material: dict[str, Any]) -> dict[str, Any]:
    """Attributes of a square with a material."""
    file.node("wall", mesh=file.square(file.material(**material)))
    attributes: dict[str, Any] = file.json["meshes"][0]["primitives"][0]["attributes"]
    return attributes


def part(file: GltfFile, folder: Path) -> Any:  # Any: Part
    return read_model(file.write(folder / "model.gltf")).parts[0]


def integers(file: GltfFile, values: np.ndarray, kind: str, code: int) -> int:
    """An accessor of integers that stand for fractions."""
    found = file.accessor(values, kind)
    file.json["accessors"][found] |= {"componentType": code, "normalized": True, "count": len(values)}
    return found


def test_integers_stand_for_fractions(tmp_path: Path) -> None:
    file = GltfFile()
    attributes = square(file, matt(baseColorTexture=file.texture(STRIPES)))
    attributes["POSITION"] = integers(file, np.pad((CORNERS * 32767).astype(np.int16), ((0, 0), (0, 1))), "VEC3", 5122)
    file.json["bufferViews"][-1]["byteStride"] = 8
    attributes["TEXCOORD_0"] = integers(file, (TEXCOORDS * 65535).astype(np.uint16), "VEC2", 5123)
    found = part(file, tmp_path)
    np.testing.assert_allclose(found.vertices, CORNERS, atol=1e-6)
    np.testing.assert_allclose(found.texcoords, TEXCOORDS, atol=1e-6)


def test_sparse_arrays(tmp_path: Path) -> None:
    file = GltfFile()
    attributes = square(file, matt())
    rows, places = file.accessor(np.array([2], np.uint32), "SCALAR"), file.accessor(np.float32([[5, 6, 7]]), "VEC3")
    views = [file.json["accessors"][number]["bufferView"] for number in (rows, places)]
    indices = {"bufferView": views[0], "componentType": 5125}
    file.json["accessors"][attributes["POSITION"]]["sparse"] = {
        "count": 1, "indices": indices, "values": {"bufferView": views[1]},
    }  # fmt: skip
    np.testing.assert_allclose(part(file, tmp_path).vertices, [*CORNERS[:2], [5, 6, 7], CORNERS[3]], atol=1e-6)


def test_materials_choose_the_set_of_coordinates(tmp_path: Path) -> None:
    file = GltfFile()
    attributes = square(file, matt(baseColorTexture={**file.texture(STRIPES), "texCoord": 1}))
    attributes["TEXCOORD_1"] = file.accessor(0.5 * TEXCOORDS, "VEC2")
    np.testing.assert_allclose(part(file, tmp_path).texcoords, 0.5 * TEXCOORDS, atol=1e-6)


def test_textures_are_transformed(tmp_path: Path) -> None:
    """A quarter of a turn: with v downwards, coordinates (1, 0) lie at (0, -1)."""
    file = GltfFile()
    transform = {"offset": [0.25, 0.5], "scale": [2, 2], "rotation": np.pi / 2}
    square(file, matt(baseColorTexture={**file.texture(STRIPES), "extensions": {"KHR_texture_transform": transform}}))
    expected = 2 * TEXCOORDS @ [[0, -1], [1, 0]] + [0.25, 0.5]
    np.testing.assert_allclose(part(file, tmp_path).texcoords, expected, atol=1e-6)


def test_gloss_is_the_contrary_of_roughness(tmp_path: Path) -> None:
    file = GltfFile()
    gloss = {"diffuseFactor": [0.6, 0.6, 0.6, 1], "diffuseTexture": file.texture(STRIPES), "glossinessFactor": 0.25}
    square(file, {"extensions": {"KHR_materials_pbrSpecularGlossiness": {**gloss, "specularFactor": [0.2, 0.2, 0.2]}}})
    file.json["extensionsUsed"] = ["KHR_materials_pbrSpecularGlossiness"]
    material = part(file, tmp_path).material
    assert (material.metallic, material.roughness) == (0, 0.75)
    np.testing.assert_array_equal(material.picture, STRIPES)
    np.testing.assert_allclose(material.colour, 0.6)


@pytest.mark.parametrize("code", [5121, 5126])
def test_colours_of_vertices_are_linear_factors(tmp_path: Path, code: int) -> None:
    file = GltfFile()
    attributes = square(file, matt(baseColorFactor=[0.6, 1, 1, 1]))
    colours = np.full((4, 4), 0.2)
    if code == 5121:
        attributes["COLOR_0"] = integers(file, (colours * 255).astype(np.uint8), "VEC4", code)
    else:
        attributes["COLOR_0"] = file.accessor(colours.astype(np.float32), "VEC4")
    np.testing.assert_allclose(part(file, tmp_path).colours, [[0.12, 0.2, 0.2]] * 4, atol=1e-6)


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_coordinates_without_a_material_do_not_darken(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    if suffix == "obj":
        path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    else:
        header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {name}\n" for name in "xyzst")
        lines = "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
        path.write_text(header + lines)
    found = import_model(path, tmp_path / "a.xml")
    text = found.scene.read_text()
    assert '<rgb name="reflectance" value="0.5, 0.5, 0.5" />' in text and "bitmap" not in text


@pytest.mark.parametrize(("change", "message"), [
    ({"asset": {"version": "1.0"}}, "it is glTF 1.0: export it as glTF 2.0"),
    ({"indices": 9}, "cannot import .*model.gltf: mesh .* has 4 vertices, but its triangles go to 9"),
    ({"view": 10**9}, "its arrays or materials are damaged"), ({"uri": "gone.bin"}, "missing"),
])  # fmt: skip
def test_files_that_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    file = GltfFile()
    attributes = square(file, matt())
    if "asset" in change:
        file.json |= change
    elif "indices" in change:
        primitive = file.json["meshes"][0]["primitives"][0]
        primitive["indices"] = file.accessor(np.array([0, 1, change["indices"]], np.uint32), "SCALAR")
    else:
        attributes["COLOR_0"] = integers(file, np.zeros((4, 4), np.uint8), "VEC4", 5121)
        if "view" in change:
            file.json["bufferViews"][-1]["byteOffset"] = change["view"]
        else:
            file.json["buffers"][-1]["uri"] = change["uri"]
    with pytest.raises(ShadowmapError, match=message) as error:
        part(file, tmp_path)
    assert "\n" not in str(error.value)
