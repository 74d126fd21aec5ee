"""The fitted scene as a binary glTF file: meshes in world space, with colours and textures where these are simple."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import OutputError, ShadowmapError
from ..io.files import atomic
from ..io.images import to_linear, to_srgb
from ..scene.geometry import ShapeInfo
from ..scene.load import SceneData, load
from ..scene.mitsuba_objects import attributes, children, parameters
from .changes import Array

# Parameters that are the colour of a material, best first.
_COLOURS = ("base_color", "reflectance", "diffuse_reflectance", "specular_reflectance")
# Materials within which another one lies that has the colour.
_AROUND = ("TwoSidedBRDF", "MaskBSDF", "BumpMap", "NormalMap")
# Colour of what has none.
_GREY = np.full(3, 0.5)


@dataclass
class _Material:
    """A material of glTF: linear colour, or picture of 8 bits with the map to its coordinates, roughness, metal."""

    colour: Array = field(default_factory=lambda: _GREY)
    picture: Array | None = None
    to_uv: Array = field(default_factory=lambda: np.eye(3))
    vertex_colours: str = ""
    roughness: float = 1.0
    metallic: float = 0.0
    note: str = ""


def write_glb(scene: mi.Scene | SceneData, path: Path) -> list[str]:
    """Write all shapes of a scene: a node for each, of its name, with its vertices in world space.

    Spheres and other shapes without triangles are tessellated as for rendering. Colours, pictures of colours, roughness and metal
    are written; lights and cameras are not.

    Args:
        scene: the scene, or its records, whose vertices are taken then.
        path: file to write.

    Returns:
        Notes about what is not as in the scene.

    Raises:
        ShadowmapError: The scene has no shape that can be drawn.
        OutputError: The file cannot be written.
    """
    import trimesh

    data = scene if isinstance(scene, SceneData) else load(scene, warn=False)
    geometry, notes = data.geometry, list[str]()
    points, normals, texcoords = (
        np.array(buffer).reshape(-1, width)
        for buffer, width in ((geometry.positions, 3), (geometry.normals, 3), (geometry.texcoords, 2))
    )
    faces = np.array(geometry.faces).reshape(-1, 3)
    result = trimesh.Scene()
    for info, source in zip(geometry.shapes, data.sources, strict=True):
        own = slice(info.vertex_start, info.vertex_start + info.vertex_count)
        triangles = faces[info.face_start : info.face_start + info.face_count].astype(np.int64) - info.vertex_start
        material = _material(source.shape)
        if material.note:
            notes.append(f"{info.name}: {material.note}")
        if info.flip_geometric:
            triangles = triangles[:, ::-1]
        mesh = trimesh.Trimesh(
            points[own].astype(np.float64),
            triangles,
            vertex_normals=normals[own].astype(np.float64) * (-1 if info.flip_shading else 1) if info.has_normals else None,
            process=False,
        )
        mesh.visual = _visual(material, info, source.shape, texcoords[own], notes)
        result.add_geometry(mesh, node_name=info.name, geom_name=info.name)
    if not result.geometry:
        raise ShadowmapError(f"cannot write {path}: the scene has no shapes.")
    if data.lights or data.areas or data.environments:
        notes.append("lights and cameras are not in the file")
    content = result.export(file_type="glb", include_normals=True)
    with atomic(path) as temporary:
        try:
            temporary.write_bytes(content)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror or error}.") from error
    return notes


def _visual(material: _Material, info: ShapeInfo, shape: mi.Shape, texcoords: Array, notes: list[str]) -> Any:
    """Trimesh's description of a shape's material."""
    import trimesh
    from PIL import Image

    values: dict[str, Any] = {"name": info.name, "roughnessFactor": material.roughness, "metallicFactor": material.metallic}
    if material.vertex_colours and isinstance(shape, mi.Mesh):
        colours = attributes(shape).get(material.vertex_colours)
        if colours is not None and material.vertex_colours.startswith("vertex_"):
            linear = np.array(colours).reshape(info.vertex_count, -1)[:, :3]
            # glTF's colours of vertices are linear.
            return trimesh.visual.ColorVisuals(vertex_colors=np.rint(255 * linear.clip(0, 1)).astype(np.uint8))
        notes.append(f"{info.name}: its colours {material.vertex_colours!r} are not those of vertices; it is grey")
    if material.picture is not None and not info.has_texcoords:
        notes.append(f"{info.name}: it has a picture, but no texture coordinates; it has the picture's mean colour")
    elif material.picture is not None:
        picture = Image.fromarray(material.picture)
        ones = np.ones((len(texcoords), 1))
        uv = (np.concatenate([texcoords, ones], 1) @ material.to_uv.T)[:, :2]
        uv[:, 1] = 1 - uv[:, 1]  # Mitsuba and glTF count rows of pictures from above, trimesh from below
        return trimesh.visual.TextureVisuals(
            uv, material=trimesh.visual.material.PBRMaterial(baseColorTexture=picture, baseColorFactor=[255] * 4, **values)
        )
    # Trimesh keeps factors as bytes.
    factor = [*np.rint(255 * material.colour.clip(0, 1)).astype(int).tolist(), 255]
    return trimesh.visual.TextureVisuals(material=trimesh.visual.material.PBRMaterial(baseColorFactor=factor, **values))


def _material(shape: mi.Shape) -> _Material:
    bsdf: Any = shape.bsdf()
    around = []
    while bsdf is not None and bsdf.class_name() in _AROUND:
        if bsdf.class_name() != "TwoSidedBRDF":
            around.append(bsdf.class_name())
        bsdf = next((part for _, part in children(bsdf) if isinstance(part, mi.BSDF)), None)
    if bsdf is None:
        return _Material(note="it has no material; it is grey")
    parts, values = dict(children(bsdf)), parameters(bsdf)
    found = _Material()
    name = next((one for one in _COLOURS if one in parts), None)
    if "eta.value" in values and "k.value" in values:
        # Fresnel's reflectance at normal incidence.
        eta, k = (np.resize(np.ravel(np.array(values[f"{key}.value"], np.float64)), 3) for key in ("eta", "k"))
        found.colour, found.metallic = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2), 1.0
    elif name is None:
        found.note = f"its material {bsdf.class_name()} has no colour that glTF knows; it is grey"
    else:
        _read_colour(found, name, parts[name], values)
    for key in ("roughness", "metallic"):
        value = values.get(f"{key}.value")
        if value is not None:
            setattr(found, key, float(np.ravel(np.array(value)).mean()))
    if "alpha.value" in values or "alpha" in values:
        alpha = values.get("alpha.value", values.get("alpha"))
        found.roughness = float(np.sqrt(np.ravel(np.array(alpha)).mean()))  # glTF's is the root of Mitsuba's
    elif bsdf.class_name() in ("SmoothConductor", "SmoothPlastic"):
        found.roughness = 0.0
    if around:
        found.note = "; ".join(filter(None, [found.note, f"{' and '.join(around)} around its material is left out"]))
    return found


def _read_colour(found: _Material, name: str, texture: Any, values: dict[str, Any]) -> None:
    if f"{name}.data" in values:
        data = np.array(values[f"{name}.data"])
        matrix = np.array(values[f"{name}.to_uv"].matrix, np.float64) if f"{name}.to_uv" in values else np.eye(3)
        found.to_uv = matrix.reshape(matrix.shape[:2])
        raw = data.dtype == np.uint8
        encoded: Array = data / 255 if raw else to_srgb(data.astype(np.float32))
        encoded = np.repeat(encoded, 3, -1) if encoded.shape[-1] == 1 else encoded[..., :3]
        found.picture = np.rint(255 * encoded.clip(0, 1)).astype(np.uint8)
        if not raw and data.max() > 1:
            found.note = "its picture is brighter than 1 and was cut off there"
        found.colour = to_linear(found.picture.mean((0, 1)) / 255)
    elif f"{name}.value" in values:
        value = np.ravel(np.array(values[f"{name}.value"], np.float64))
        found.colour = np.resize(value, 3)
        if value.max() > 1:
            found.note = "its colour is brighter than 1 and was cut off there"
    elif texture.class_name().startswith("MeshAttribute"):
        found.vertex_colours = _attribute_name(texture)
    else:
        found.note = f"its {name} is a {texture.class_name()}; it is grey"


def _attribute_name(texture: Any) -> str:
    """The name of the mesh's attribute that a texture reads."""
    for line in str(texture).splitlines():
        key, _, value = line.partition("=")
        if key.strip() == "name":
            return value.strip().strip('",')
    return "vertex_color"
