"""Model files, read with trimesh into records."""

from __future__ import annotations

import contextlib
import io
import logging
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import numpy as np

from ..errors import ShadowmapError
from ..io import obj
from ..io.files import check_readable
from ..io.images import check_size, to_linear
from ..io.meshes import MOST_BYTES, MOST_TRIANGLES, read_placed_mesh
from . import gltf, gltf_arrays, obj_materials
from .model import Array, Material, Model, Part, Picture, PlacedCamera, PlacedLight

if TYPE_CHECKING:
    import PIL.Image
    import trimesh

    from .named_files import NamedFiles

#: Suffixes of files that can be imported.
SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl", ".off")
_Look = tuple[Material | None, Array | None, Array | None]
# Formats whose files are one mesh without materials.
_PLAIN = (".stl", ".off")


def read_model(path: Path, normals: str = "auto") -> Model:
    """All meshes, materials, cameras and lights of a file.

    ``normals`` is that of `ImportOptions`. Raises ShadowmapError if the file cannot be read or has no triangles.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ShadowmapError(f"cannot import {path}: the suffix {suffix!r} is not one of {', '.join(SUFFIXES)}.")
    check_readable(path)
    if path.stat().st_size > MOST_BYTES:
        raise ShadowmapError(f"cannot import {path}: it has more than {MOST_BYTES / 1e6:.0f} MB; decimate its meshes.")
    cameras, lights, notes, content = list[PlacedCamera](), list[PlacedLight](), list[str](), None
    if suffix in (".glb", ".gltf"):
        document = _document(path)
        try:
            cameras, lights = gltf.cameras_and_lights(document)
            notes = gltf.notes(document)
        except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            raise ShadowmapError(f"cannot import {path}: its nodes, cameras or lights are damaged ({error}).") from error
        content = _rewritten(path, document)
    smooth = normals == "smooth" or (normals == "auto" and suffix not in (".glb", ".gltf", ".stl"))
    parts, more = _parts(path, suffix, content)
    parts, notes = [replace(part, smooth=smooth) for part in parts], [*notes, *more]
    kinds = {light.kind for light in lights}
    lights = [light for light in lights if light.kind in ("directional", "point", "spot")]
    notes += [f"lights of the kind {kind!r} are left out" for kind in sorted(kinds - {light.kind for light in lights})]
    return Model(tuple(parts), tuple(cameras), tuple(lights), tuple(notes))


def _document(path: Path) -> gltf.Json:
    try:
        document = gltf.document(path.read_bytes())
    except Exception as error:
        raise ShadowmapError(f"cannot import {path}: it is no glTF file, or it is damaged.") from error
    version = str(document.get("asset", {}).get("version", "2.0")) if isinstance(document.get("asset", {}), dict) else "2.0"
    if version.startswith(("0", "1")):
        raise ShadowmapError(f"cannot import {path}: it is glTF {version}: export it as glTF 2.0.")
    for extension, reason in gltf.UNREADABLE.items():
        if extension in document.get("extensionsRequired", ()):
            raise ShadowmapError(f"cannot import {path}: it is {reason}.")
    try:
        _check_counts(path, document)
    except ShadowmapError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ShadowmapError(f"cannot import {path}: its accessors or buffers are damaged.") from error
    return document


def _rewritten(path: Path, document: gltf.Json) -> bytes | None:
    try:
        return gltf_arrays.rewritten(path, document)
    except OSError as error:
        raise ShadowmapError(f"cannot import {path}: a file that it names is missing ({error.filename}).") from error
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, struct.error) as error:
        raise ShadowmapError(f"cannot import {path}: its arrays or materials are damaged ({error}).") from error


def _check_counts(path: Path, document: gltf.Json) -> None:
    """ShadowmapError if the file announces more values than its buffers hold: the loader would make room for them."""
    beside = [str(buffer.get("uri", "")) for buffer in document.get("buffers", ())]
    files = [path.parent / unquote(uri) for uri in beside if uri and not uri.startswith("data:")]
    held = path.stat().st_size + sum(file.stat().st_size for file in files if file.is_file())
    for accessor in document.get("accessors", ()):
        count = accessor.get("count", 0)
        if isinstance(count, bool) or not isinstance(count, (int, float)) or not 0 <= count <= held:
            raise ShadowmapError(f"cannot import {path}: it announces {count} values, but its buffers have {held} bytes.")


def _parts(path: Path, suffix: str, content: bytes | None) -> tuple[list[Part], list[str]]:
    """(all meshes of a file, notes). ``content`` is that of a text glTF file instead of its own."""
    if suffix in _PLAIN:
        return [_plain(path)], []
    from .named_files import NamedFiles

    files = NamedFiles(path)
    try:
        scene = _loaded(path, suffix, files) if content is None else _loaded(path, ".gltf", files, content)
        instances = [scene.graph[node] for node in scene.graph.nodes_geometry]
        count = sum(len(getattr(scene.geometry[name], "faces", ())) for _, name in instances)
        if count > MOST_TRIANGLES:
            raise ShadowmapError(f"cannot import {path}: its {count} triangles are more than {MOST_TRIANGLES}; decimate them.")
        materials: dict[int, Material | None] = {}
        found = list(_placed(scene, path, materials))
    except ShadowmapError:
        raise
    except MemoryError:
        raise ShadowmapError(f"cannot import {path}: its content does not fit into memory; it may be damaged.") from None
    except Exception as error:  # loaders of these formats raise errors of many kinds
        if suffix == ".ply":
            return [_plain(path)], []  # of what trimesh refuses, some can be read
        raise ShadowmapError(
            f"cannot import {path}: it is no model, or it is damaged, or a file that it names is missing."
        ) from error
    if not found:
        raise ShadowmapError(f"{path} has no triangles: give a triangle mesh, no points and no curves.")
    for part in found:
        if not np.isfinite(part.vertices).all():
            raise ShadowmapError(f"{path}: mesh {part.name!r} has vertices that are not finite (NaN or inf): repair the file.")
    sources = {id(source): source for mesh in scene.geometry.values() if (source := getattr(mesh.visual, "material", None))}
    kinds = sorted({kind for source in sources.values() for kind in obj_materials.left_out(getattr(source, "kwargs", {}))})
    return found, [*files.notes, *(f"{kind} are left out" for kind in kinds)]


def _plain(path: Path) -> Part:
    vertices, faces, (middle, scale) = read_placed_mesh(path)
    return Part(path.stem, vertices.astype(np.float64) * scale + middle, faces.astype(np.int64))


def _loaded(path: Path, suffix: str, files: NamedFiles, content: bytes | None = None) -> trimesh.Scene:
    import trimesh

    from .named_files import with_one_library

    options: dict[str, Any] = {"split_objects": True, "group_material": True} if suffix == ".obj" else {}
    data = path.read_bytes() if content is None else content
    if suffix == ".obj":
        data = obj.split_concave_faces(with_one_library(data))
    with _quiet(logging.getLogger("trimesh")):
        # glTF's nodes are kept apart: their names are those of the scene.
        return trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=files, process=False, **options)


@contextlib.contextmanager
def _quiet(log: logging.Logger) -> Iterator[None]:
    """Context in which a logger and those below it write nothing: notes and errors are ours."""
    handler, before = logging.NullHandler(), log.propagate
    log.addHandler(handler)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.propagate = before


def _placed(scene: trimesh.Scene, path: Path, materials: dict[int, Material | None]) -> Iterator[Part]:
    linear = path.suffix.lower() in (".glb", ".gltf")
    names = {name: str(getattr(getattr(mesh.visual, "material", None), "name", "")) for name, mesh in scene.geometry.items()}
    objects = obj_materials.objects_of(names) if path.suffix.lower() == ".obj" else {}
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        mesh = scene.geometry[name]
        faces = np.asarray(getattr(mesh, "faces", np.empty((0, 3))), np.int64).reshape(-1, 3)
        if not len(faces):
            continue  # points and lines
        label = objects.get(str(node), str(node)) if len(scene.geometry) > 1 or "." not in str(node) else path.stem
        if faces.min() < 0 or faces.max() >= len(mesh.vertices):
            raise ShadowmapError(
                f"cannot import {path}: mesh {label!r} has {len(mesh.vertices)} vertices, but its triangles go to {faces.max()}."
            )
        yield _part(mesh, label, np.asarray(matrix, np.float64), faces, _look(mesh, materials, linear))


def _part(mesh: trimesh.Trimesh, name: str, matrix: Array, faces: Any, look: _Look) -> Part:  # Any: indices
    linear = matrix[:3, :3]
    with np.errstate(invalid="ignore"):  # infinite ones, which are refused later
        vertices = np.asarray(mesh.vertices, np.float64) @ linear.T + matrix[:3, 3]
    normals = None
    if "vertex_normals" in mesh._cache:  # those of the file; trimesh would make others
        normals = np.asarray(mesh.vertex_normals, np.float64) @ np.linalg.inv(linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = normals / np.where(length > 0, length, 1) if (length > 0).all() and np.isfinite(normals).all() else None
    if np.linalg.det(linear) < 0:
        faces = faces[:, ::-1]
    material, colours, texcoords = look
    return Part(name, vertices, faces, normals, texcoords, colours, material)


def _look(mesh: trimesh.Trimesh, materials: dict[int, Material | None], linear: bool) -> _Look:
    """Material, colours of the vertices and texture coordinates of a mesh. ``linear`` says that bytes of colours are so."""
    visual: Any = mesh.visual  # Any: one of trimesh's classes, told apart by their kind
    if visual.kind == "texture" and getattr(visual, "material", None) is not None:
        uv = visual.uv
        texcoords = None if uv is None or np.shape(uv) != (len(mesh.vertices), 2) else np.array(uv, np.float64) * [1, -1] + [0, 1]
        if _is_stand_in(visual.material):
            return None, None, texcoords
        made = materials.setdefault(id(visual.material), None) or _material(visual.material)
        materials[id(visual.material)] = made
        colours = visual.vertex_attributes.get("color") if made.picture is None else None
        return made, None if colours is None else _linear_colours(colours, linear) * made.colour, texcoords
    if visual.kind == "vertex":
        return None, _linear_colours(visual.vertex_colors, linear), None
    return None, None, None


def _is_stand_in(material: Any) -> bool:  # Any: a material of trimesh
    """True for the dark grey that trimesh gives to meshes with texture coordinates and no material."""
    from trimesh.visual.material import color_image

    picture = getattr(material, "image", None)
    return picture is not None and picture.size == (2, 2) and picture.tobytes() == color_image().tobytes()


def _linear_colours(colours: Any, linear: bool) -> Array:  # Any: (V, 3 or 4) bytes or numbers
    """Colours (V, 3), linear: bytes are sRGB if they are not ``linear``, floating-point numbers are linear already."""
    values = np.asarray(colours)[:, :3]
    if values.dtype.kind not in "ui":
        return values.astype(np.float64)
    fractions = values / np.iinfo(values.dtype).max
    return np.asarray(fractions if linear else to_linear(fractions))


def _material(source: Any) -> Material:  # Any: a material of trimesh
    from trimesh.visual.material import PBRMaterial

    pbr = source if isinstance(source, PBRMaterial) else source.to_pbr()
    factor = _factor(pbr.baseColorFactor, 4, np.ones(4))
    picture = _picture(pbr.baseColorTexture, "RGBA")
    emission = _factor(pbr.emissiveFactor, 3, np.zeros(3))
    glow = _picture(pbr.emissiveTexture, "RGB")
    rough = _picture(pbr.metallicRoughnessTexture, "RGB")
    metallic, roughness = (1.0 if value is None else float(value) for value in (pbr.metallicFactor, pbr.roughnessFactor))
    if not isinstance(source, PBRMaterial):
        metallic = 0.0  # other formats know no metal
    opacity: Picture | float = 1.0
    mode = pbr.alphaMode or "OPAQUE"
    if mode != "OPAQUE":
        opacity = float(factor[3])
        if picture is not None and picture[..., 3].min() < 255:
            opacity = np.clip(np.rint(picture[..., 3] * factor[3]), 0, 255).astype(np.uint8)
    cutoff = float(0.5 if pbr.alphaCutoff is None else pbr.alphaCutoff) if mode == "MASK" else None
    made = Material(
        name=str(source.name or "material"),
        colour=factor[:3],
        picture=None if picture is None else picture[..., :3],
        opacity=opacity,
        cutoff=cutoff,
        roughness=roughness if rough is None else _scaled(rough[..., 1], roughness),
        metallic=metallic if rough is None else _scaled(rough[..., 2], metallic),
        normals=_picture(pbr.normalTexture, "RGB"),
        emission=emission,
        emission_picture=glow if emission.any() else None,
    )
    return obj_materials.completed(made, getattr(source, "kwargs", {}))


def _factor(values: Any, count: int, default: Array) -> Array:  # Any: a sequence, bytes or None
    """A colour of 0 to 1, linear; trimesh has bytes where files of other formats have them."""
    if values is None:
        return default
    array = np.asarray(values)
    numbers = array.astype(np.float64).ravel() / (255.0 if array.dtype.kind in "ui" else 1.0)
    return np.concatenate([numbers, default])[:count] if len(numbers) < count else numbers[:count]


def _picture(image: PIL.Image.Image | None, mode: str) -> Picture | None:
    if image is None:
        return None
    check_size("a texture of the model", image.width, image.height, 4)
    return np.asarray(image.convert(mode), np.uint8)


def _scaled(channel: Picture, factor: float) -> Picture | float:
    """Bytes times a factor; a number where all are equal."""
    values = np.clip(np.rint(channel * factor), 0, 255).astype(np.uint8)
    return float(values.flat[0]) / 255 if values.min() == values.max() else values
