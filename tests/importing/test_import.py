"""Models of other programs as scenes, rendered by Mitsuba: colours and places follow from the specification of glTF."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image

from shadowmap_dr import ShadowmapError
from shadowmap_dr.importing import Imported, ImportOptions, import_model
from tests.importing.gltf_files import GltfFile

FRONT = {"intensity": math.pi, "node": {"translation": [0, 0, 5]}}


def rendered(found: Imported, integrator: str = "direct", **options: Any) -> np.ndarray:
    scene = mi.load_file(str(found.scene), optimize=False)
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": integrator, **options}), spp=16))


def scene_of(file: GltfFile, folder: Path, **options: Any) -> Imported:
    return import_model(file.write(folder / "model.gltf"), folder / "scene.xml", ImportOptions(size=64, **options))


def matt(**values: Any) -> dict[str, Any]:
    return {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1, **values}}


def quarters(image: np.ndarray) -> np.ndarray:
    """Mean colours (2, 2, 3) within the four quarters of a picture."""
    height, width = image.shape[:2]
    return np.array([[image[int(height * y) - 3 : int(height * y) + 3, int(width * x) - 3 : int(width * x) + 3].mean((0, 1))
                      for x in (0.38, 0.62)] for y in (0.38, 0.62)])  # fmt: skip


@pytest.mark.parametrize("integrator", ["direct", "shadowmap"])
def test_pictures_are_the_right_way_up(variant: str, tmp_path: Path, integrator: str) -> None:
    """A picture of four colours on a square that faces the camera: its upper left corner is that of the image."""
    pixels = np.zeros((8, 8, 3), np.uint8)
    pixels[:4, :4], pixels[:4, 4:], pixels[4:, :4], pixels[4:, 4:] = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)
    file = GltfFile()
    file.node("wall", mesh=file.square(file.material(**matt(baseColorTexture=file.texture(pixels)))))
    file.camera()
    file.light("directional", **FRONT)
    found = scene_of(file, tmp_path)
    assert (found.shapes, found.triangles, found.cameras, found.lights, found.notes) == (1, 2, 1, 1, ())
    colours = quarters(rendered(found, integrator))
    expected = np.array([[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [1, 1, 0]]])
    # The principled material adds a grey reflection, and darkens a little.
    np.testing.assert_allclose(colours, expected, atol=0.12)
    assert mi.load_file(str(found.scene)).shapes()[0].id() == "wall"


def test_colours_are_linear_factors_of_pictures(variant: str, tmp_path: Path) -> None:
    """Half of a half-bright sRGB grey, beside a plain colour of the same value."""
    grey = np.full((4, 4, 3), 188, np.uint8)  # 0.5 linear
    values = []
    for name, material in (
        ("both", lambda file: matt(baseColorTexture=file.texture(grey), baseColorFactor=[0.5, 0.5, 0.5, 1])),
        ("plain", lambda file: matt(baseColorFactor=[0.25, 0.25, 0.25, 1])),
    ):
        file = GltfFile()
        file.node("wall", mesh=file.square(file.material(**material(file))))
        file.camera()
        file.light("directional", **FRONT)
        (tmp_path / name).mkdir()
        values.append(float(rendered(scene_of(file, tmp_path / name))[24:40, 24:40].mean()))
    # Pictures have 8 bits.
    assert values[0] == pytest.approx(values[1], rel=0.02) and values[1] == pytest.approx(0.25, abs=0.04)


def test_nodes_move_their_children(variant: str, tmp_path: Path) -> None:
    """A node that turns by 90 degrees about z and scales; within it one that is moved along x, which is upwards then."""
    file = GltfFile()
    child = file.node("small", top=False, mesh=file.square(), translation=[1.5, 0, 0])
    half = math.sqrt(0.5)
    file.node("arm", children=[child], rotation=[0, 0, half, half], scale=[0.4, 0.4, 0.4])
    file.camera()
    file.light("directional", **FRONT)
    found = scene_of(file, tmp_path)
    params = mi.traverse(mi.load_file(str(found.scene), optimize=False))
    place = np.array(params["small.vertex_positions"]).reshape(-1, 3)
    np.testing.assert_allclose(place.mean(0), [0, 0.6, 0], atol=1e-6)
    np.testing.assert_allclose(np.ptp(place, axis=0), [0.8, 0.8, 0], atol=1e-6)
    image = rendered(found)
    rows = np.nonzero(image.mean(-1) > 0.1)[0]
    # Above the middle of the image: y = 0.6 at a distance of 4.
    assert abs((rows.mean() + 0.5) / 64 - (0.5 - 0.5 * 0.6 / 4 / math.tan(0.4))) < 0.01


def test_mirrored_nodes_keep_their_normals(variant: str, tmp_path: Path) -> None:
    file = GltfFile()
    file.node("wall", mesh=file.square(file.material(**matt())), scale=[-1, 1, 1])
    file.camera()
    file.light("directional", **FRONT)
    assert rendered(scene_of(file, tmp_path))[24:40, 24:40].mean() > 0.5


def test_cameras_look_where_they_do(variant: str, tmp_path: Path) -> None:
    """Against a projection by hand: a camera to the right of the z axis, turned towards it, twice as wide as high."""
    file = GltfFile()
    file.node("wall", mesh=file.square(), translation=[0.5, 0.25, 0], scale=[0.05, 0.05, 1])
    turn = math.radians(30)
    file.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 2.0, "znear": 0.1}}]
    file.node("eye", camera=0, translation=[2, 0, 3], rotation=[0, math.sin(turn / 2), 0, math.cos(turn / 2)])
    file.light("directional", **FRONT)
    image = rendered(scene_of(file, tmp_path))
    assert image.shape[:2] == (32, 64)
    shift = np.array([0.5, 0.25, 0]) - [2, 0, 3]
    right, back = np.array([math.cos(turn), 0, -math.sin(turn)]), np.array([math.sin(turn), 0, math.cos(turn)])
    x, y, z = shift @ right, shift[1], -shift @ back
    expected = (0.5 + 0.5 * x / z / math.tan(0.35) / 2) * 64, (0.5 - 0.5 * y / z / math.tan(0.35)) * 32
    weight = image.mean(-1)
    row, column = np.mgrid[:32, :64] + 0.5
    assert ((column * weight).sum() / weight.sum(), (row * weight).sum() / weight.sum()) == pytest.approx(expected, abs=0.3)


@pytest.mark.parametrize("kind", ["point", "spot"])
def test_lights_have_their_intensity(variant: str, tmp_path: Path, kind: str) -> None:
    """pi / d^2 times a reflectance of a half over pi, below a light that hangs at a distance of 2."""
    file = GltfFile()
    file.node("wall", mesh=file.square(file.material(**matt(baseColorFactor=[0.5, 0.5, 0.5, 1]))))
    file.camera()
    spot = {"spot": {"innerConeAngle": 0.2, "outerConeAngle": 0.35}} if kind == "spot" else {}
    file.light(kind, color=[1, 0.5, 0.25], intensity=4 * math.pi, node={"translation": [0, 0, 2]}, **spot)
    image = rendered(scene_of(file, tmp_path))
    np.testing.assert_allclose(image[31:33, 31:33].mean((0, 1)), [0.5, 0.25, 0.125], rtol=0.15)
    lit = image.mean(-1) > 0.01
    # The whole square, or a disk: the radius of a cone of 0.35 radians at a distance of 2, on a square of side 2.
    share = math.pi * (2 * math.tan(0.35)) ** 2 / 4 if kind == "spot" else 1.0
    square = (32 / math.tan(0.4) / 4 * 2) ** 2
    assert lit.sum() == pytest.approx(share * square, rel=0.06)


def test_holes_are_holes(variant: str, tmp_path: Path) -> None:
    pixels = np.full((8, 8, 4), 255, np.uint8)
    pixels[:, :4, 3] = 100
    file = GltfFile()
    material = file.material(alphaMode="MASK", alphaCutoff=0.5, **matt(baseColorTexture=file.texture(pixels)))
    file.node("wall", mesh=file.square(material))
    file.camera()
    file.light("directional", **FRONT)
    image = rendered(scene_of(file, tmp_path))
    assert image[28:36, 20:26].mean() < 0.01 and image[28:36, 38:44].mean() > 0.5


@pytest.mark.parametrize("integrator", ["direct", "shadowmap"])
def test_normal_maps_lean_the_right_way(variant: str, tmp_path: Path, integrator: str) -> None:
    """Normals that lean upwards in the picture are brighter under a light from above."""
    values = []
    for green in (200, 56):
        pixels = np.full((4, 4, 3), (128, green, 230), np.uint8)
        file = GltfFile()
        file.node("wall", mesh=file.square(file.material(normalTexture=file.texture(pixels), **matt())))
        file.camera()
        half = math.sin(math.radians(-20)), math.cos(math.radians(-20))
        file.light("directional", intensity=math.pi, node={"rotation": [half[0], 0, 0, half[1]]})
        folder = tmp_path / str(green)
        folder.mkdir()
        values.append(float(rendered(scene_of(file, folder), integrator)[24:40, 24:40].mean()))
    assert values[0] > 1.3 * values[1]


def test_roughness_and_metal_have_channels_of_their_own(tmp_path: Path) -> None:
    pixels = np.zeros((4, 4, 3), np.uint8)
    pixels[..., 1], pixels[:2, :, 2] = 200, 100
    file = GltfFile()
    rough = {"metallicRoughnessTexture": file.texture(pixels), "roughnessFactor": 0.5}
    file.node("wall", mesh=file.square(file.material("steel", pbrMetallicRoughness=rough)))
    found = scene_of(file, tmp_path)
    text = found.scene.read_text()
    assert 'name="roughness" value="0.392' in text and "steel-metallic.png" in text
    metallic = np.array(mi.Bitmap(str(tmp_path / "scene_files" / "steel-metallic.png")))
    assert (metallic[:2] == 100).all() and (metallic[2:] == 0).all()


def test_glowing_surfaces_are_lights(variant: str, tmp_path: Path) -> None:
    file = GltfFile()
    file.node("screen", mesh=file.square(file.material(emissiveFactor=[1, 0.5, 0], **matt())))
    file.camera()
    assert any("a sun and a dim sky were added" in note for note in scene_of(file, tmp_path).notes)
    found = scene_of(file, tmp_path, daylight=False)
    assert not found.notes
    np.testing.assert_allclose(rendered(found)[24:40, 24:40].mean((0, 1)), [1, 0.5, 0], atol=0.01)


def test_colours_of_vertices(variant: str, tmp_path: Path) -> None:
    file = GltfFile()
    file.node("wall", mesh=file.square(colours=np.array([[1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0]])))
    file.camera()
    file.light("directional", **FRONT)
    image = rendered(scene_of(file, tmp_path))
    left, right = image[28:36, 18:22].mean((0, 1)), image[28:36, 42:46].mean((0, 1))
    assert left[0] > 2 * left[1] and right[1] > 2 * right[0]


def test_names_are_kept_where_mitsuba_takes_them(tmp_path: Path) -> None:
    file = GltfFile()
    for name in ("left hand", "left.hand", "body", "body"):
        file.node(name, mesh=file.square())
    found = scene_of(file, tmp_path)
    scene = mi.load_file(str(found.scene), optimize=False)
    assert (
        sorted(shape.id() for shape in scene.shapes()) == ["body", "body_2", "left_hand", "left_hand_2"]
        or len(scene.shapes()) == 4
    )
    assert any("names that Mitsuba does not take" in note for note in found.notes)


@pytest.mark.parametrize("up", ["y", "z"])
def test_models_without_camera_and_light_are_seen_and_lit(variant: str, tmp_path: Path, up: str) -> None:
    path = tmp_path / "box.ply"
    trimesh.creation.box((3, 1, 1)).export(path)
    found = import_model(path, tmp_path / "box.xml", ImportOptions(up=up, size=64))
    assert [note.split(":")[0] for note in found.notes] == ["the file has no camera", "the file has no light"]
    scene = mi.load_file(str(found.scene))
    depth = np.array(mi.render(scene, integrator=mi.load_dict({"type": "aov", "aovs": "d:depth"}), spp=4))[..., 0] > 0
    assert 0.15 < depth.mean() < 0.8 and not depth[0].any() and not depth[-1].any() and not depth[:, 0].any()


@pytest.mark.parametrize("up", ["y", "z"])
def test_floors_catch_shadows(variant: str, tmp_path: Path, up: str) -> None:
    path = tmp_path / "box.ply"
    trimesh.creation.box((1, 1, 1)).export(path)
    found = import_model(path, tmp_path / "box.xml", ImportOptions(up=up, size=64, floor=True))
    scene = mi.load_file(str(found.scene), optimize=False)
    floor = next(shape for shape in scene.shapes() if shape.id() == "floor")
    axis = "yz".index(up) + 1
    assert floor.bbox().max[axis] == pytest.approx(-0.5, abs=1e-5) and floor.bbox().max[0] > 2
    image = rendered(found).mean(-1)
    assert image[image > 0].min() < 0.5 * np.median(image[image > 0])


@pytest.mark.parametrize(("suffix", "normals", "smooth"), [
    ("ply", "auto", True), ("stl", "auto", False), ("glb", "auto", False), ("ply", "flat", False), ("stl", "smooth", True),
])  # fmt: skip
def test_shading_of_meshes_without_normals(tmp_path: Path, suffix: str, normals: Any, smooth: bool) -> None:
    path = tmp_path / f"box.{suffix}"
    trimesh.creation.box((1, 1, 1)).export(path)
    found = import_model(path, tmp_path / "box.xml", ImportOptions(normals=normals))
    assert mi.load_file(str(found.scene), optimize=False).shapes()[0].has_vertex_normals() == smooth


def test_objects_of_obj_files_have_their_materials(variant: str, tmp_path: Path) -> None:
    (tmp_path / "two.mtl").write_text("newmtl red\nKd 0.8 0 0\n\nnewmtl green\nKd 0 0.8 0\n")
    (tmp_path / "two.obj").write_text(
        "mtllib two.mtl\nv -1 -1 0\nv 0 -1 0\nv 0 1 0\nv -1 1 0\nv 1 -1 0\nv 1 1 0\n"
        "o left\nusemtl red\nf 1 2 3 4\no right\nusemtl green\nf 2 5 6 3\n"
    )
    found = import_model(tmp_path / "two.obj", tmp_path / "two.xml", ImportOptions(size=64))
    assert (found.shapes, found.triangles) == (2, 4)
    image = rendered(found)
    colourful = image[np.ptp(image, axis=-1) > 0.05]
    assert ((colourful[:, 0] > colourful[:, 1]).sum() > 100) and ((colourful[:, 1] > colourful[:, 0]).sum() > 100)
    names = {shape.id() for shape in mi.load_file(str(found.scene), optimize=False).shapes()}
    assert any("left" in name for name in names) or names == {"red", "green"}


@pytest.mark.parametrize("suffix", ["stl", "off", "ply", "obj", "glb"])
def test_formats_of_meshes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"ball.{suffix}"
    trimesh.creation.icosphere(2).export(path)
    found = import_model(path, tmp_path / "out" / "ball.xml")
    shape = mi.load_file(str(found.scene), optimize=False).shapes()[0]
    assert found.triangles == 320 and shape.bbox().max.x == pytest.approx(1, abs=0.01)
    assert all(file.exists() for file in found.files)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.fbx", b"", "the suffix '.fbx' is not one of .glb"),
        ("a.glb", b"", "is no glTF file, or it is damaged"),
        ("a.gltf", b"[]", "is no glTF file, or it is damaged"),
        (
            "a.gltf",
            b'{"asset": {"version": "2.0"}, "extensionsRequired": ["KHR_draco_mesh_compression"]}',
            "compressed with Draco",
        ),
        (
            "a.gltf",
            b'{"asset": {"version": "2.0"}, "accessors": [{"count": 1e30}]}',
            "announces 1e.30 values, but its buffers have",
        ),
        ("a.gltf", b'{"asset": {"version": "2.0"}, "nodes": [{"camera": 3}]}', "nodes, cameras or lights are damaged"),
        ("a.gltf", b'{"asset": {"version": "2.0"}}', "has no triangles|is no model"),
        ("a.obj", b"v 0 0 0\n", "has no triangles|is no model"),
        ("a.ply", b"ply\n", "no mesh, or it is damaged|no header"),
        ("a.stl", b"solid", "no triangles|no mesh"),
    ],
)
def test_files_that_cannot_be_imported(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ShadowmapError, match=message) as error:
        import_model(path, tmp_path / "scene.xml")
    assert "\n" not in str(error.value) and not (tmp_path / "scene.xml").exists()


def test_wrong_options(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere(1).export(path)
    for options, message in (({"up": "x"}, "give one of y, z"), ({"size": 0}, "size"), ({"normals": "no"}, "auto, smooth, flat")):
        with pytest.raises(ShadowmapError, match=message):
            import_model(path, tmp_path / "scene.xml", ImportOptions(**options))
    with pytest.raises(ShadowmapError, match="the suffix '.json' is not one of .xml"):
        import_model(path, tmp_path / "scene.json")
    with pytest.raises(ShadowmapError, match="none.ply"):
        import_model(tmp_path / "none.ply", tmp_path / "scene.xml")


@pytest.mark.parametrize(
    ("uri", "words"), [("none.png", "there is no file 'none.png'"), ("bad.png", "'bad.png' is left out"), ("my%20paint.png", "")]
)
def test_pictures_beside_gltf_files(tmp_path: Path, uri: str, words: str) -> None:
    mesh = trimesh.creation.box()
    paint = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (200, 100, 50)), name="paint")
    mesh.visual = trimesh.visual.TextureVisuals(np.random.default_rng(0).random((8, 2)), material=paint)
    for name, content in trimesh.Scene([mesh]).export(file_type="gltf").items():
        (tmp_path / name.replace("buffer_0", "buffer 0")).write_bytes(content)
    document = json.loads((tmp_path / "model.gltf").read_text())
    document["images"][0] = {"uri": uri}
    document["buffers"][0]["uri"] = document["buffers"][0]["uri"].replace("buffer_0", "buffer%200")
    (tmp_path / "model.gltf").write_text(json.dumps(document))
    (tmp_path / "bad.png").write_bytes(b"no picture")
    Image.new("RGB", (4, 4), (200, 100, 50)).save(tmp_path / "my paint.png")
    found = import_model(tmp_path / "model.gltf", tmp_path / "model.xml")
    assert found.triangles == 12 and ((tmp_path / "model_files" / "paint-colour.png").exists() == (not words))
    assert any(words in note for note in found.notes) if words else not any("left out" in note for note in found.notes)
