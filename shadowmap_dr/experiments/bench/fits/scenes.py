"""Scenes as records, and as the XML files that a user would write."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar, cast
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ....io.images import write_exr, write_image
from ....io.meshes import write_ply
from ....jit.threads import second_thread
from ....scene.mitsuba_meshes import make_mesh
from . import space
from .meshes import mesh

Array = npt.NDArray[np.float64]
Values = Mapping[str, tuple[float, ...]]
#: Corners of Mitsuba's `rectangle`.
_CORNERS = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])


@dataclass(frozen=True, eq=False)
class Material:
    """A Mitsuba material: its plug-in, colours and numbers, and textures (H, W, 3), linear, top row first."""

    kind: str
    values: Values
    textures: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Body:
    """A shape: a mesh by its name, or Mitsuba's `rectangle`.

    Attributes:
        place: (4, 4) from the mesh to the world.
        radiance: of an area lamp.
        vertices: in place of those of the mesh.
        backdrop: a floor or a wall. Other bodies stand before and above it.
    """

    id: str
    mesh: str
    place: Array
    material: Material
    radiance: tuple[float, ...] | None = None
    vertices: Array | None = None
    backdrop: bool = False

    def local(self) -> Array:
        """(V, 3) vertices before `place`."""
        if self.vertices is not None:
            return self.vertices
        return _CORNERS if self.mesh == "rectangle" else mesh(self.mesh).vertices

    def world(self) -> Array:
        """(V, 3) vertices."""
        return space.applied(self.place, self.local())

    def middle(self) -> Array:
        """The middle (3,) of its box before `place`."""
        local = self.local()
        return (local.min(0) + local.max(0)) / 2

    def centre(self) -> Array:
        """The middle (3,) of its box in the world."""
        world = self.world()
        return (world.min(0) + world.max(0)) / 2


@dataclass(frozen=True, eq=False)
class Lamp:
    """A light without a shape: `directional`, `point`, `spot`, `constant`, `envmap` or `sunsky`.

    Attributes:
        place: (4, 4): a spot shines along its z axis, a sun comes from there; a point light has its position alone.
        values: radiometric ones, which may vary.
        settings: others.
        image: (H, W, 3) of an `envmap`.
    """

    id: str
    kind: str
    place: Array
    values: Values
    settings: Values = field(default_factory=dict)
    image: Array | None = None

    @property
    def position(self) -> Array:
        return self.place[:3, 3]

    @property
    def direction(self) -> Array:
        """Direction (3,) in which the light travels."""
        return self.place[:3, 2]


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera; ``place`` (4, 4), ``fov`` in degrees along x."""

    id: str
    place: Array
    fov: float
    width: int
    height: int


_Part = TypeVar("_Part", Body, Lamp, Camera)


@dataclass(frozen=True, eq=False)
class Scene:
    """All of a scene."""

    bodies: tuple[Body, ...]
    lamps: tuple[Lamp, ...]
    cameras: tuple[Camera, ...]

    def body(self, name: str) -> Body:
        return next(body for body in self.bodies if body.id == name)

    def lamp(self, name: str) -> Lamp:
        return next(lamp for lamp in self.lamps if lamp.id == name)

    def camera(self, name: str) -> Camera:
        return next(camera for camera in self.cameras if camera.id == name)

    def holds(self, name: str) -> str:
        """``body``, ``lamp`` or ``camera``: the part of this name."""
        return next(type(part).__name__.lower() for part in self.parts() if part.id == name)

    def replaced(self, part: Body | Lamp | Camera) -> Scene:
        """The scene with another part of the same name."""

        def swapped(parts: tuple[_Part, ...]) -> tuple[_Part, ...]:
            return tuple(cast(_Part, part) if old.id == part.id else old for old in parts)

        return Scene(swapped(self.bodies), swapped(self.lamps), swapped(self.cameras))

    def parts(self) -> tuple[Body | Lamp | Camera, ...]:
        """All that has a name."""
        return (*self.bodies, *self.lamps, *self.cameras)

    def diameter(self) -> float:
        """Diagonal of the box around all shapes."""
        points = np.concatenate([body.world() for body in self.bodies])
        return float(np.linalg.norm(points.max(0) - points.min(0)))


#: Depth of paths in pictures with light that bounces.
MAX_DEPTH = 8


def write_scene(scene: Scene, folder: Path, suffix: str = ".png", integrator: str = "direct") -> Path:
    """Write ``scene.xml`` into a folder, with the meshes and pictures that it names. Returns its path.

    Args:
        suffix: of textures. Mitsuba keeps those of ``.png`` as bytes, to which no derivatives flow; ``.exr`` become floats.
        integrator: of the scene: `direct` or `path`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    root = ElementTree.Element("scene", version="3.0.0")
    element = ElementTree.SubElement(root, "integrator", type=integrator)
    if integrator == "path":
        ElementTree.SubElement(element, "integer", name="max_depth", value=str(MAX_DEPTH))
    for camera in scene.cameras:
        _camera(root, camera)
    for lamp in scene.lamps:
        _lamp(root, lamp, folder)
    for body in scene.bodies:
        _body(root, body, folder, suffix)
    ElementTree.indent(root, "    ")
    path = folder / "scene.xml"
    path.write_text('<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return path


def load_scene(path: Path) -> mi.Scene:
    """The scene of a file of :func:`write_scene`."""
    with second_thread():
        return mi.load_file(str(path))


def _camera(root: ElementTree.Element, camera: Camera) -> None:
    element = ElementTree.SubElement(root, "sensor", type="perspective", id=camera.id)
    _value(element, "fov", (camera.fov,))
    _look_at(element, camera.place)
    film = ElementTree.SubElement(element, "film", type="hdrfilm")
    for name, size in (("width", camera.width), ("height", camera.height)):
        ElementTree.SubElement(film, "integer", name=name, value=str(size))
    ElementTree.SubElement(film, "string", name="pixel_format", value="rgb")
    ElementTree.SubElement(film, "rfilter", type="box")


def _lamp(root: ElementTree.Element, lamp: Lamp, folder: Path) -> None:
    element = ElementTree.SubElement(root, "emitter", type=lamp.kind, id=lamp.id)
    if lamp.kind == "directional":
        _vector(element, "vector", "direction", lamp.direction)
    elif lamp.kind == "point":
        _vector(element, "point", "position", lamp.position)
    elif lamp.kind == "spot":
        _look_at(element, lamp.place)
    elif lamp.kind == "sunsky":  # its zenith is z
        transform = ElementTree.SubElement(element, "transform", name="to_world")
        ElementTree.SubElement(transform, "rotate", x="1", angle="-90")
        _vector(element, "vector", "sun_direction", -lamp.direction)
    elif lamp.image is not None:
        file = f"{lamp.id}.exr"
        write_exr(folder / file, {name: lamp.image[..., k].astype(np.float32) for k, name in enumerate("RGB")})
        ElementTree.SubElement(element, "string", name="filename", value=file)
    for name, value in (*lamp.settings.items(), *lamp.values.items()):
        _value(element, name, value)


def _body(root: ElementTree.Element, body: Body, folder: Path, suffix: str) -> None:
    kind = "rectangle" if body.mesh == "rectangle" else "ply"
    element = ElementTree.SubElement(root, "shape", type=kind, id=body.id)
    if kind == "ply":
        file = f"{body.id}.ply"
        shape = mesh(body.mesh)
        write_ply(folder / file, make_mesh(body.id, body.local(), shape.faces))
        ElementTree.SubElement(element, "string", name="filename", value=file)
        if not shape.smooth:
            ElementTree.SubElement(element, "boolean", name="face_normals", value="true")
    transform = ElementTree.SubElement(element, "transform", name="to_world")
    ElementTree.SubElement(transform, "matrix", value=space.text(body.place).replace(",", ""))
    bsdf = ElementTree.SubElement(element, "bsdf", type=body.material.kind)
    for name, value in body.material.values.items():
        _value(bsdf, name, value)
    for name, image in body.material.textures.items():
        file = f"{body.id}{suffix}"
        write_image(folder / file, image)
        texture = ElementTree.SubElement(bsdf, "texture", type="bitmap", name=name)
        ElementTree.SubElement(texture, "string", name="filename", value=file)
    if body.radiance is not None:
        emitter = ElementTree.SubElement(element, "emitter", type="area")
        _value(emitter, "radiance", body.radiance)


def _value(parent: ElementTree.Element, name: str, value: tuple[float, ...]) -> None:
    ElementTree.SubElement(parent, "float" if len(value) == 1 else "rgb", name=name, value=space.text(value))


def _vector(parent: ElementTree.Element, kind: str, name: str, vector: Array) -> None:
    ElementTree.SubElement(parent, kind, name=name, value=space.text(vector))


def _look_at(parent: ElementTree.Element, place: Array) -> None:
    transform = ElementTree.SubElement(parent, "transform", name="to_world")
    origin = place[:3, 3]
    target = space.text(origin + place[:3, 2])
    ElementTree.SubElement(transform, "lookat", origin=space.text(origin), target=target, up=space.text(place[:3, 1]))
