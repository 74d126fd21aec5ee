"""glTF files made by hand, by the letter of the specification: JSON with buffers and pictures within."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

# Componenttypes of accessors.
FLOAT, UNSIGNED_INT = 5126, 5125
#: A square of side 2 in the plane z = 0 that faces +z: lower left, lower right, upper right, upper left.
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
#: Texture coordinates of these corners: (0, 0) is the upper left corner of a picture.
TEXCOORDS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def png(pixels: np.ndarray) -> str:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="png")
    return uri("image/png", file.getvalue())


class GltfFile:
    """A file under construction."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": []}],
            **{key: [] for key in ("nodes", "meshes", "accessors", "bufferViews", "buffers", "materials", "textures", "images")},
        }

    def accessor(self, values: np.ndarray, kind: str) -> int:
        data = np.ascontiguousarray(values).tobytes()
        found = self.json
        found["buffers"].append({"byteLength": len(data), "uri": uri("application/octet-stream", data)})
        found["bufferViews"].append({"buffer": len(found["buffers"]) - 1, "byteLength": len(data)})
        entry: dict[str, Any] = {
            "bufferView": len(found["bufferViews"]) - 1,
            "componentType": UNSIGNED_INT if values.dtype == np.uint32 else FLOAT,
            "count": values.size if kind == "SCALAR" else len(values),
            "type": kind,
        }
        if kind == "VEC3":
            entry |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        found["accessors"].append(entry)
        return len(found["accessors"]) - 1

    def texture(self, pixels: np.ndarray) -> dict[str, int]:
        self.json["images"].append({"uri": png(pixels), "mimeType": "image/png"})
        self.json["textures"].append({"source": len(self.json["images"]) - 1})
        return {"index": len(self.json["textures"]) - 1}

    def material(self, name: str = "paint", **values: Any) -> int:
        self.json["materials"].append({"name": name, **values})
        return len(self.json["materials"]) - 1

    def square(self, material: int | None = None, colours: np.ndarray | None = None, normals: bool = True) -> int:
        attributes = {"POSITION": self.accessor(CORNERS, "VEC3"), "TEXCOORD_0": self.accessor(TEXCOORDS, "VEC2")}
        if normals:
            attributes["NORMAL"] = self.accessor(np.tile(np.array([0, 0, 1], np.float32), (4, 1)), "VEC3")
        if colours is not None:
            attributes["COLOR_0"] = self.accessor(colours.astype(np.float32), "VEC3")
        primitive: dict[str, Any] = {"attributes": attributes, "indices": self.accessor(FACES.ravel(), "SCALAR")}
        if material is not None:
            primitive["material"] = material
        self.json["meshes"].append({"primitives": [primitive]})
        return len(self.json["meshes"]) - 1

    def node(self, name: str, top: bool = True, **values: Any) -> int:
        self.json["nodes"].append({"name": name, **values})
        if top:
            self.json["scenes"][0]["nodes"].append(len(self.json["nodes"]) - 1)
        return len(self.json["nodes"]) - 1

    def camera(self, distance: float = 4.0, **lens: Any) -> int:
        """A camera on the z axis that looks at the origin."""
        lens = lens or {"yfov": 0.8, "aspectRatio": 1.0, "znear": 0.1}
        self.json.setdefault("cameras", []).append({"type": "perspective", "perspective": lens})
        return self.node("eye", camera=len(self.json["cameras"]) - 1, translation=[0, 0, distance])

    def light(self, kind: str, name: str = "lamp", node: dict[str, Any] | None = None, **values: Any) -> int:
        used = self.json.setdefault("extensions", {}).setdefault("KHR_lights_punctual", {"lights": []})["lights"]
        self.json["extensionsUsed"] = ["KHR_lights_punctual"]
        used.append({"type": kind, **values})
        return self.node(name, extensions={"KHR_lights_punctual": {"light": len(used) - 1}}, **(node or {}))

    def write(self, path: Path) -> Path:
        kept = {key: value for key, value in self.json.items() if value != []}
        path.write_text(json.dumps(kept))
        return path
