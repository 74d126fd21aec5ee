"""Arrays of glTF files that trimesh reads wrongly: integers that stand for fractions, sparse ones, texture coordinates that a
material takes from another set, or transforms. They are written anew, as floating-point numbers.

Format: Khronos, glTF 2.0, KHR_mesh_quantization and KHR_texture_transform.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from .gltf import Json
from .model import Array

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# Textures of a material, in the order in which their coordinates count: a mesh of the scene has one set.
_TEXTURES = ("baseColorTexture", "emissiveTexture", "normalTexture", "metallicRoughnessTexture")


def rewritten(path: Path, document: Json) -> bytes | None:
    """The content of a text glTF file with the same meshes, of which trimesh reads all arrays. None if it does so already.

    Raises LookupError, TypeError, ValueError or OSError if the file is damaged.
    """
    arrays = _Arrays(path, document)
    for material in arrays.json.get("materials", ()):
        _without_gloss(material)
    for primitive in arrays.primitives():
        attributes = primitive["attributes"]
        for name in [name for name in attributes if name.partition("_")[0] in ("POSITION", "NORMAL", "TEXCOORD", "COLOR")]:
            accessor = arrays.json["accessors"][attributes[name]]
            if accessor.get("normalized") or "sparse" in accessor:
                attributes[name] = arrays.add(arrays.read(attributes[name]))
        chosen, matrix = texture_coordinates(arrays.material(primitive))
        if f"TEXCOORD_{chosen}" in attributes and (chosen or matrix is not None):
            place = attributes[f"TEXCOORD_{chosen}"]
            if matrix is not None:
                place = arrays.add(arrays.read(place) @ matrix[:, :2].T + matrix[:, 2])
            attributes["TEXCOORD_0"] = place
    return arrays.written() if arrays.changed else None


def texture_coordinates(material: Json) -> tuple[int, Array | None]:
    """(number of the set, matrix (2, 3) that transforms it or None) of a material's first texture."""
    for texture in textures(material):
        transform = texture.get("extensions", {}).get("KHR_texture_transform")
        if transform is None:
            return int(texture.get("texCoord", 0)), None
        (x, y), angle = transform.get("scale", (1, 1)), float(transform.get("rotation", 0))
        cosine, sine = math.cos(angle), math.sin(angle)
        offset = transform.get("offset", (0, 0))
        matrix = np.array([[cosine * x, sine * y, offset[0]], [-sine * x, cosine * y, offset[1]]], np.float64)
        return int(transform.get("texCoord", texture.get("texCoord", 0))), matrix
    return 0, None


def textures(material: Json) -> list[Json]:
    """References to the textures of a material that an import keeps, the most important one first."""
    places = (material.get("pbrMetallicRoughness", {}), material)
    return [place[key] for key in _TEXTURES for place in places if key in place]


def _without_gloss(material: dict[str, Any]) -> None:  # Any: JSON
    """Give a material of specular colour and gloss the diffuse colour and the roughness that it has."""
    gloss = material.get("extensions", {}).pop("KHR_materials_pbrSpecularGlossiness", None)
    if gloss is None:
        return
    rough = 1.0 - float(gloss.get("glossinessFactor", 1.0))
    metal = {"baseColorFactor": gloss.get("diffuseFactor", (1, 1, 1, 1)), "metallicFactor": 0.0, "roughnessFactor": rough}
    if "diffuseTexture" in gloss:
        metal["baseColorTexture"] = gloss["diffuseTexture"]
    material["pbrMetallicRoughness"] = metal


class _Arrays:
    """Accessors of a file, which can be read and added."""

    def __init__(self, path: Path, document: Json) -> None:
        self.path, self.json = path, deepcopy(dict(document))
        self.buffers: dict[int, bytes] = {}
        self.before = json.dumps([self.json.get(key) for key in ("meshes", "materials")])

    @property
    def changed(self) -> bool:
        return json.dumps([self.json.get(key) for key in ("meshes", "materials")]) != self.before

    def primitives(self) -> Iterator[dict[str, Any]]:  # Any: JSON
        for mesh in self.json.get("meshes", ()):
            yield from mesh["primitives"]

    def material(self, primitive: Json) -> Json:
        found: Json = self.json["materials"][primitive["material"]] if "material" in primitive else {}
        return found

    def read(self, number: int) -> Array:
        """(N, width) numbers of an accessor; integers that stand for fractions are these."""
        accessor = self.json["accessors"][number]
        kind, width, count = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]], int(accessor["count"])
        values = np.zeros((count, width), kind)
        if "bufferView" in accessor:
            values = self._view(accessor["bufferView"], int(accessor.get("byteOffset", 0)), kind, width, count).copy()
        if "sparse" in accessor:
            sparse, size = accessor["sparse"], int(accessor["sparse"]["count"])
            where, what = sparse["indices"], sparse["values"]
            offset, index = int(where.get("byteOffset", 0)), np.dtype(_TYPES[where["componentType"]])
            rows = self._view(where["bufferView"], offset, index, 1, size)[:, 0].astype(np.int64)
            values[rows] = self._view(what["bufferView"], int(what.get("byteOffset", 0)), kind, width, size)
        found = values.astype(np.float64)
        return np.maximum(found / np.iinfo(kind).max, -1) if accessor.get("normalized") and kind.kind in "iu" else found

    def add(self, values: Array) -> int:
        data = np.ascontiguousarray(values, "<f4").tobytes()
        url = f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}"
        self._append("buffers", {"byteLength": len(data), "uri": url})
        view = self._append("bufferViews", {"buffer": len(self.json["buffers"]) - 1, "byteLength": len(data)})
        kind = next(name for name, width in _WIDTHS.items() if width == values.shape[1])
        return self._append("accessors", {"bufferView": view, "componentType": 5126, "count": len(values), "type": kind})

    def written(self) -> bytes:
        for number, buffer in enumerate(self.json.get("buffers", ())):
            if "uri" not in buffer:  # the part of a .glb file after its text
                content = base64.b64encode(self._buffer(number)).decode()
                buffer["uri"] = f"data:application/octet-stream;base64,{content}"
        return json.dumps(self.json).encode()

    def _append(self, key: str, entry: Json) -> int:
        self.json.setdefault(key, []).append(entry)
        return len(self.json[key]) - 1

    def _view(self, number: int, offset: int, kind: np.dtype[Any], width: int, count: int) -> Any:  # Any: (count, width)
        view = self.json["bufferViews"][number]
        start = int(view.get("byteOffset", 0)) + offset
        stride = int(view.get("byteStride", kind.itemsize * width))
        data = self._buffer(view["buffer"])
        if min(start, stride, count) < 0 or (count and start + stride * (count - 1) + kind.itemsize * width > len(data)):
            raise ValueError("an array goes beyond its buffer")
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize))

    def _buffer(self, number: int) -> bytes:
        if number not in self.buffers:
            url = self.json["buffers"][number].get("uri")
            if url is None:
                data = self.path.read_bytes()
                at = 20 + struct.unpack_from("<I", data, 12)[0]
                (length,) = struct.unpack_from("<I", data, at)
                self.buffers[number] = data[at + 8 : at + 8 + length]
            elif url.startswith("data:"):
                self.buffers[number] = base64.b64decode(url.partition(",")[2])
            else:
                self.buffers[number] = (self.path.parent / unquote(url)).read_bytes()
        return self.buffers[number]
