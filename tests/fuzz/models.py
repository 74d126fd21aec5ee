"""Models of other programs, most of them damaged, made into scenes; and files of cameras."""

from __future__ import annotations

import functools
import json
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np

from shadowmap_dr import cameras
from shadowmap_dr.importing import ImportOptions, import_model
from tests.importing.gltf_files import GltfFile

from . import mesh_files
from .outcome import check
from .values import chance, changed_json, mutated, mutated_text, pick

COLMAP = Path(__file__).parents[1] / "cameras" / "colmap"
# A damaged scale may make a mesh large: it must still be written and read as it is.
_MOST_BYTES = 20_000_000


def run(rng: np.random.Generator, folder: Path) -> str:
    """Give a file to the importer, or to a reader of cameras."""
    return pick(rng, (_gltf, _gltf, _gltf, _gltf_bytes, _mesh, _materials, _colmap, _nerf))(rng, folder)


@functools.cache
def _document() -> str:
    """A glTF file with all that is read."""
    file = GltfFile()
    pixels = np.random.default_rng(0).integers(0, 256, (4, 4, 4), np.uint8)
    texture, plain = file.texture(pixels), file.texture(pixels[..., :3])
    paint = {"baseColorTexture": texture, "baseColorFactor": [1, 0.5, 0.2, 0.9], "metallicRoughnessTexture": plain}
    first = file.material("paint", alphaMode="MASK", normalTexture=plain, emissiveFactor=[1, 1, 1], pbrMetallicRoughness=paint)
    second = file.material("glass", alphaMode="BLEND", pbrMetallicRoughness={"baseColorFactor": [1, 1, 1, 0.3]})
    child = file.node("child", top=False, mesh=file.square(second, normals=False), scale=[0.5, 0.5, 0.5])
    file.node("parent", children=[child], rotation=[0, 0.6, 0, 0.8], mesh=file.square(first))
    file.node("painted", mesh=file.square(colours=np.eye(4)[:, :3]), translation=[0, 1, 0])
    file.camera()
    file.light("point", color=[1, 0.5, 0.2], intensity=10, node={"translation": [0, 2, 1]})
    file.light("spot", spot={"innerConeAngle": 0.1, "outerConeAngle": 0.4}, node={"translation": [0, 0, 3]})
    file.light("directional", intensity=2)
    with tempfile.TemporaryDirectory() as place:
        return file.write(Path(place) / "model.gltf").read_text()


def _gltf(rng: np.random.Generator, folder: Path) -> str:
    sound = chance(rng, 0.05)
    values = json.loads(_document())
    path = folder / "model.gltf"
    path.write_text(json.dumps(values if sound else changed_json(rng, values)))
    return _imported(path, folder, 6 if sound else None)


def _gltf_bytes(rng: np.random.Generator, folder: Path) -> str:
    path = folder / "model.gltf"
    path.write_bytes(mutated(rng, _document().encode()))
    return _imported(path, folder)


def _mesh(rng: np.random.Generator, folder: Path) -> str:
    suffix, data = mesh_files.files()[pick(rng, tuple(mesh_files.files()))]
    path = folder / f"model{suffix}"
    sound = chance(rng, 0.1)
    path.write_bytes(data if sound else mutated(rng, data))
    return _imported(path, folder, 12 if sound else None)


def _materials(rng: np.random.Generator, folder: Path) -> str:
    text = "newmtl red\nKd 0.8 0 0\nNs 10\nd 0.5\nmap_Kd picture.png\nillum 2\n"
    (folder / "m.mtl").write_text(mutated_text(rng, text))
    (folder / "model.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl red\nf 1/1 2/1 3/1\n")
    return _imported(folder / "model.obj", folder, 1)


def _imported(path: Path, folder: Path, triangles: int | None = None) -> str:
    found = import_model(path, folder / "scene.xml", ImportOptions(size=16))
    check(all(file.is_file() for file in found.files), "a file that was written is not there")
    check(triangles in (None, found.triangles), f"{found.triangles} triangles instead of {triangles}")
    if sum(file.stat().st_size for file in found.files) < _MOST_BYTES:
        scene = mi.load_file(str(found.scene), optimize=False)
        check(len(scene.shapes()) == found.shapes, f"{len(scene.shapes())} shapes instead of {found.shapes}")
    return f"{path.suffix}: {found.shapes} shapes, {found.triangles} triangles"


def _colmap(rng: np.random.Generator, folder: Path) -> str:
    kind = pick(rng, ("binary", "text"))
    damaged = pick(rng, ("cameras", "images"))
    for source in (COLMAP / kind).iterdir():
        data = source.read_bytes()
        (folder / source.name).write_bytes(mutated(rng, data) if source.stem == damaged else data)
    return _sound(cameras.from_colmap(folder))


def _nerf(rng: np.random.Generator, folder: Path) -> str:
    matrix = np.eye(4).tolist()
    values = {"fl_x": 60.0, "w": 100, "h": 80, "k1": -0.1, "frames": [{"file_path": "a", "transform_matrix": matrix}]}
    (folder / "transforms.json").write_text(json.dumps(changed_json(rng, values)))
    return _sound(cameras.from_nerf(folder / "transforms.json"))


def _sound(found: dict[str, cameras.Camera]) -> str:
    for camera in found.values():
        check(np.isfinite(camera.K).all() and camera.fx > 0 and camera.fy > 0, f"a camera of {camera.K}")
        check(np.abs(camera.rotation @ camera.rotation.T - np.eye(3)).max() < 0.01, "a rotation that is none")
    return f"{len(found)} cameras"
