"""Cameras and lights of glTF files, which trimesh does not read. Format: Khronos, glTF 2.0 and KHR_lights_punctual."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from .model import Array, PlacedCamera, PlacedLight

# glTF's cameras and lights look along -z, with y up; Mitsuba's cameras along +z, with x to the left.
_TO_MITSUBA = np.diag([-1.0, 1.0, -1.0, 1.0])
_LIGHTS = "KHR_lights_punctual"
#: Extensions that change what is seen, and that are not heeded.
_LEFT_OUT = {
    "KHR_materials_transmission": "materials that transmit light are opaque",
    "KHR_materials_clearcoat": "clear coats are left out",
    "KHR_materials_sheen": "sheen is left out",
    "KHR_materials_unlit": "unlit materials are lit",
    "KHR_materials_pbrSpecularGlossiness": "specular colours are left out",
    "KHR_techniques_webgl": "shaders are left out, and with them colours",
    "EXT_mesh_gpu_instancing": "instances are left out",
}
#: Extensions without which a file cannot be read, and what to do.
UNREADABLE = {
    "KHR_draco_mesh_compression": "compressed with Draco: export it without compression",
    "EXT_meshopt_compression": "compressed with meshopt: export it without compression",
    "KHR_texture_basisu": "with textures in KTX2: export it with PNG or JPEG",
}

Json = Mapping[str, Any]


def document(data: bytes) -> Json:
    """The JSON of a `.glb` or `.gltf` file. Raises ValueError or struct.error if there is none."""
    if data[:4] == b"glTF":
        (length,) = struct.unpack_from("<I", data, 12)
        data = data[20 : 20 + length]
    found = json.loads(data.decode("utf-8", "replace"))
    if not isinstance(found, dict):
        raise ValueError("no glTF")
    return found


def cameras_and_lights(gltf: Json) -> tuple[list[PlacedCamera], list[PlacedLight]]:
    """All cameras and lights of the file's scene, in world space."""
    cameras, lights = [], []
    defined = gltf.get("extensions", {}).get(_LIGHTS, {}).get("lights", ())
    for node, matrix in _nodes(gltf):
        name = str(node.get("name") or "")
        if "camera" in node:
            cameras.append(_camera(gltf["cameras"][node["camera"]], name, matrix))
        light = node.get("extensions", {}).get(_LIGHTS)
        if light is not None:
            lights.append(_light(defined[light["light"]], name, matrix))
    return cameras, lights


def notes(gltf: Json) -> list[str]:
    """Sentences about parts of the file that are not heeded."""
    used = gltf.get("extensionsUsed", ())
    found = [sentence for extension, sentence in _LEFT_OUT.items() if extension in used]
    if gltf.get("skins"):
        found.append("skins are left out: meshes stand as they were modelled")
    if gltf.get("animations"):
        found.append("animations are left out")
    return found


def _nodes(gltf: Json) -> Iterator[tuple[Json, Array]]:
    """Nodes of the scene and their matrices to world space. A node that is its own ancestor is entered once."""
    nodes: Sequence[Json] = gltf.get("nodes", ())
    scenes: Sequence[Json] = gltf.get("scenes", ())
    roots = scenes[gltf.get("scene", 0)].get("nodes", ()) if scenes else range(len(nodes))
    waiting, seen = [(int(root), np.eye(4)) for root in roots], set[int]()
    while waiting:
        number, parent = waiting.pop()
        if number in seen:
            continue
        seen.add(number)
        matrix = parent @ _local(nodes[number])
        yield nodes[number], matrix
        waiting += [(int(child), matrix) for child in nodes[number].get("children", ())]


def _local(node: Json) -> Array:
    from trimesh.transformations import quaternion_matrix

    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = (float(value) for value in node.get("rotation", (0, 0, 0, 1)))
    matrix = np.array(quaternion_matrix([w, x, y, z]))
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def _rigid(matrix: Array) -> Array:
    """The matrix without scale: cameras and lights have none."""
    found = matrix.copy()
    found[:3, :3] /= np.maximum(np.linalg.norm(matrix[:3, :3], axis=0), 1e-12)
    return found


def _camera(camera: Json, name: str, matrix: Array) -> PlacedCamera:
    to_world = _rigid(matrix) @ _TO_MITSUBA
    label = name or str(camera.get("name") or "camera")
    if camera.get("type") == "orthographic":
        across, up = (abs(float(camera["orthographic"][key])) for key in ("xmag", "ymag"))
        found = PlacedCamera(label, to_world, None, across / up, 2 * up)
    else:
        lens = camera["perspective"]
        found = PlacedCamera(label, to_world, math.degrees(float(lens["yfov"])), float(lens.get("aspectRatio", 4 / 3)))
    if not 1e-3 <= found.aspect <= 1e3 or not 0 < (90.0 if found.fov is None else found.fov) < 179:
        raise ValueError(f"camera {label!r} has an angle of view or an aspect that none has")
    return found


def _light(light: Json, name: str, matrix: Array) -> PlacedLight:
    rigid, spot = _rigid(matrix), light.get("spot", {})
    cone = (float(spot.get("innerConeAngle", 0.0)), float(spot.get("outerConeAngle", math.pi / 4)))
    return PlacedLight(
        name=name or str(light.get("name") or light["type"]),
        kind=str(light["type"]),
        colour=np.array(light.get("color", (1, 1, 1)), np.float64) * float(light.get("intensity", 1.0)),
        place=rigid[:3, 3],
        direction=-rigid[:3, 2],
        cone=(math.degrees(cone[0]), math.degrees(cone[1])),
    )
