"""Fitted scenes as glTF: read by trimesh, and imported again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image

from shadowmap_dr.errors import OutputError, ShadowmapError
from shadowmap_dr.fitting.glb import write_glb
from shadowmap_dr.importing import ImportOptions, import_model
from shadowmap_dr.io.images import to_linear, to_srgb
from shadowmap_dr.scene.load import load

SCENES = Path(__file__).resolve().parents[2] / "scenes"


def described(**shapes: Any) -> mi.Scene:
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


def written(scene: Any, folder: Path) -> tuple[trimesh.Scene, list[str]]:
    notes = write_glb(scene, folder / "a.glb")
    return trimesh.load_scene(folder / "a.glb", process=False), notes


def placed(scene: trimesh.Scene, name: str) -> trimesh.Trimesh:
    """A mesh in world space."""
    matrix, geometry = scene.graph[name]
    mesh = scene.geometry[geometry].copy()
    mesh.apply_transform(matrix)
    return mesh


@pytest.mark.parametrize("name", ["gallery", "pavilion", "still_life"])
def test_our_scenes(tmp_path: Path, variant: str, name: str) -> None:
    scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False)
    found, notes = written(scene, tmp_path)
    data = load(scene, warn=False)
    assert sorted(found.graph.nodes_geometry) == sorted(info.name for info in data.geometry.shapes)
    assert notes[-1] == "lights and cameras are not in the file"
    points = np.array(data.geometry.positions).reshape(-1, 3)
    for info in data.geometry.shapes:
        own = points[info.vertex_start : info.vertex_start + info.vertex_count]
        mesh = placed(found, info.name)
        np.testing.assert_allclose(mesh.vertices, own, atol=1e-5)
        assert len(mesh.faces) == info.face_count


def test_vertices_of_the_records_are_taken(tmp_path: Path, variant: str) -> None:
    scene = described(a={"type": "cube"})
    data = load(scene, warn=False)
    moved = np.array(data.geometry.positions).reshape(-1, 3) * 2 + 1
    found, _ = written(replace(data, geometry=data.geometry.with_positions({"a": moved})), tmp_path)
    np.testing.assert_allclose(placed(found, "a").vertices, moved, atol=1e-6)


def test_colours(tmp_path: Path, variant: str) -> None:
    materials = {
        "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.2, 0.8]}},
        "twosided": {
            "type": "twosided",
            "bsdf": {"type": "plastic", "diffuse_reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}},
        },
        "principled": {
            "type": "principled",
            "base_color": {"type": "rgb", "value": [0.7, 0.1, 0.2]},
            "roughness": 0.3,
            "metallic": 0.9,
        },
        "gold": {"type": "roughconductor", "material": "Au", "alpha": 0.09},
        "uniform": {"type": "diffuse"},
    }
    found, notes = written(described(**{name: {"type": "sphere", "bsdf": bsdf} for name, bsdf in materials.items()}), tmp_path)
    colours = {name: placed(found, name).visual.material for name in materials}
    for name, expected in (("diffuse", [0.1, 0.2, 0.8]), ("twosided", [0.5, 0.4, 0.3]), ("principled", [0.7, 0.1, 0.2])):
        np.testing.assert_allclose(colours[name].baseColorFactor[:3] / 255, expected, atol=0.5 / 255)
    assert (colours["uniform"].baseColorFactor[:3] == 128).all()
    assert (colours["principled"].roughnessFactor, colours["principled"].metallicFactor) == pytest.approx((0.3, 0.9), abs=1e-6)
    gold = colours["gold"].baseColorFactor[:3] / 255
    np.testing.assert_allclose(gold, [1.0, 0.78, 0.34], atol=0.05)  # measured: Akenine-Moeller et al., Real-Time Rendering
    assert (colours["gold"].roughnessFactor, colours["gold"].metallicFactor) == pytest.approx((0.3, 1.0), abs=1e-6)
    assert not notes


def test_pictures_come_back(tmp_path: Path, variant: str) -> None:
    """Written and imported: the picture lies as before."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:4, :4], pixels[:4, 4:], pixels[4:, :4] = (200, 30, 30), (30, 200, 30), (30, 30, 200)
    Image.fromarray(pixels).save(tmp_path / "t.png")
    texture = {"type": "bitmap", "filename": str(tmp_path / "t.png"), "filter_type": "nearest"}
    texture["to_uv"] = mi.ScalarTransform4f().scale([2, 1, 1])
    scene = described(a={"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}})
    notes = write_glb(scene, tmp_path / "a.glb")
    assert not notes
    imported = import_model(tmp_path / "a.glb", tmp_path / "b.xml", ImportOptions(size=32))
    table = mi.traverse(mi.load_file(str(imported.scene), optimize=False))
    key = next(name for name in table.keys() if name.endswith("base_color.data"))
    assert abs(np.array(table[key], np.float64) - pixels).max() <= 1
    shapes = [mi.load_file(str(imported.scene), optimize=False).shapes()[0], scene.shapes()[0]]
    # Coordinates where rays meet the square, of both: Mitsuba's bitmap applies the map itself.
    x, y = (values.ravel().astype(np.float32) for values in np.meshgrid(np.linspace(-0.9, 0.9, 7), np.linspace(-0.9, 0.9, 7)))
    seen = []
    for shape in shapes:
        ray = mi.Ray3f(mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(np.full_like(x, 3))), mi.Vector3f(0, 0, -1))
        seen.append(np.array(mi.load_dict({"type": "scene", "shape": shape}).ray_intersect(ray).uv))
    np.testing.assert_allclose(seen[0], seen[1] * np.array([[2], [1]]), atol=1e-5)


def test_linear_pictures_and_colours_of_vertices(tmp_path: Path, variant: str) -> None:
    values = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "format": "variant"}
    pavilion = mi.load_file(str(SCENES / "pavilion.xml"), optimize=False)
    found, _ = written(pavilion, tmp_path)
    drape = next(shape for shape in pavilion.shapes() if shape.id() == "drape")
    colours = np.array(mi.traverse(drape)["vertex_color"]).reshape(-1, 3)
    np.testing.assert_allclose(placed(found, "drape").visual.vertex_colors[:, :3] / 255, colours.clip(0, 1), atol=0.51 / 255)
    found, notes = written(described(a={"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}), tmp_path)
    shown = np.asarray(placed(found, "a").visual.material.baseColorTexture)
    np.testing.assert_allclose(shown, 255 * to_srgb(values), atol=0.51)
    assert np.abs(to_linear(shown / 255) - values).max() < 0.01 and not notes


@pytest.mark.parametrize(
    ("bsdf", "words"),
    [
        ({"type": "dielectric"}, "its material SmoothDielectric has no colour that glTF knows; it is grey"),
        ({"type": "diffuse", "reflectance": {"type": "checkerboard"}}, "its reflectance is a Checkerboard; it is grey"),
        ({"type": "mask", "nested": {"type": "diffuse"}}, "MaskBSDF around its material is left out"),
        (
            {"type": "principled", "base_color": {"type": "bitmap", "bitmap": np.full((2, 2, 3), 0.2, np.float32)}},
            "no texture coordinates",
        ),
    ],
)
def test_notes(tmp_path: Path, variant: str, bsdf: dict[str, Any], words: str) -> None:
    if "base_color" in bsdf:
        bsdf["base_color"]["bitmap"] = mi.Bitmap(bsdf["base_color"]["bitmap"])
    mesh = {"type": "ply", "filename": str(SCENES / "meshes" / "spot.ply")}
    found, notes = written(described(a=mesh | {"bsdf": bsdf}, sun={"type": "directional"}), tmp_path)
    assert notes[0].startswith("a: ") and words in notes[0]
    assert notes[1:] == ["lights and cameras are not in the file"]
    assert list(found.graph.nodes_geometry) == ["a"]


def test_bad_input(tmp_path: Path, variant: str) -> None:
    with pytest.raises(ShadowmapError):
        write_glb(described(sun={"type": "directional"}), tmp_path / "a.glb")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_glb(described(a={"type": "cube"}), tmp_path / "file" / "a.glb")
