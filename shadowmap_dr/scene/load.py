"""From a Mitsuba scene to the records that the renderer works on.

``load`` does the expensive part once (topology, tessellation, tables, validation); ``refresh`` reads again all values that
parameters may change, attached where they carry gradients.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from numbers import Integral
from typing import Any, ClassVar, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, UnsupportedShape, check_variant
from ..jit.arrays import device_array
from ..jit.pytree import StaticTuple, with_fields
from ..jit.types import Float
from .descriptions import Parts, describe_all
from .few_shapes import FewShapes
from .geometry import NOT_READ, Geometry, ShapeInfo, pack_face_info, size_guards_of, stand_ins
from .lights.area import AreaLight
from .lights.environment import Environment
from .lights.read import Light, area_lights_of, check_directions, environments_of, lights_of
from .mitsuba_objects import children, held_arrays, is_cosine, is_plain
from .naming import names_of, unique
from .sensor import Sensor, check_film, sensors_of
from .shapes.sources import CurveSource, ShapeSource, source_of
from .soup import Soup, Vertices
from .unsupported import omissions_of, warn_of

# With fewer shapes, their vertices are concatenated anew for each image.
_MANY_SHAPES = 16
#: Fields of the records that :func:`refresh` reads, and those of them that it need not read: of shapes, of lights without extent,
#: of sensors.
READ = ("geometry", "lights", "sensors", "areas", "environments")
PARTS = READ[:3]
# Most shapes that are told apart from those without gradients that are as they were.
_FEW_CHANGED = 8


@dataclass(frozen=True)
class SceneData:
    """A scene as records. A PyTree that may cross ``dr.freeze``.

    sensors       one tuple for each sensor of the scene, which holds the cameras of a batch sensor or the one camera
    lights        directional, spot and point lights, projectors and beams
    areas         area lights
    environments  constant, envmap and sunsky emitters (at most one)
    shape_ptr, bsdf_ptr   mi.ShapePtr, mi.BSDFPtr (S,), indexed by ``geometry.face_shape``
    materials     different BSDFs, and meshes whose attributes they may read: all objects that Mitsuba shades with
    variant       Mitsuba variant of the scene
    soup          the shapes' vertices, None if there are few shapes
    few           the same if there are few, else None
    needs_frames  whether any BSDF needs more than the cosines of directions: tangents, texture coordinates
    only_cosines  whether all BSDFs are the cosine of the light's direction times a factor that no direction changes
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    scene: mi.Scene
    geometry: Geometry
    sensors: tuple[tuple[Sensor, ...], ...]
    lights: tuple[Light, ...]
    areas: tuple[AreaLight, ...]
    environments: tuple[Environment, ...]
    shape_ptr: mi.ShapePtr
    bsdf_ptr: mi.BSDFPtr
    sources: tuple[ShapeSource, ...]
    materials: tuple[mi.Object, ...]
    variant: str
    needs_frames: bool = True
    only_cosines: bool = False
    soup: Soup | None = None
    few: FewShapes | None = None

    # Neither the scene nor its meshes, which Dr.Jit would walk through at each call of a recorded function: 0.1 s for 5,000
    # meshes. Images depend on the records that were read from them.
    RECORDED: ClassVar[tuple[str, ...]] = (
        *("geometry", "sensors", "lights", "areas", "environments", "shape_ptr", "bsdf_ptr", "recorded_sources", "materials"),
        *("variant", "needs_frames", "only_cosines", "soup"),
    )

    @property
    def recorded_sources(self) -> tuple[ShapeSource, ...]:
        """Sources that recorded functions read: those of curves; all of the plug-in, which gets the scene at each call."""
        return self.sources if self.scene is None else tuple(one for one in self.sources if isinstance(one, CurveSource))

    def cameras(self, sensor: int | Sensor) -> tuple[Sensor, ...]:
        """Cameras of a sensor: of the scene's sensor with that number, or the given record itself.

        Raises:
            ShadowmapError: there is no such sensor; the variant is not the scene's.
        """
        check_variant(mi.variant(), self.variant)
        if isinstance(sensor, Sensor):
            return (sensor,)
        if not isinstance(sensor, Integral):
            how = "give camera.record()" if hasattr(sensor, "record") else "give its number in the scene, or a Sensor record"
            raise ShadowmapError(f"the sensor is a {type(sensor).__name__}: {how}.")
        if not 0 <= sensor < len(self.sensors):
            raise ShadowmapError(f"There is no sensor {sensor}: the scene has {len(self.sensors)}, counted from 0.")
        return self.sensors[sensor]

    def light(self, name: str) -> Light | AreaLight:
        """The light called ``name``; raises ``ShadowmapError`` listing the known names otherwise."""
        lights = (*self.lights, *self.areas)
        for light in lights:
            if light.name == name:
                return light
        known = ", ".join(repr(light.name) for light in lights) or "none"
        raise ShadowmapError(f"There is no light '{name}' in the scene; its lights: {known}.")

    def with_attributes(self) -> list[mi.Mesh]:
        """Mitsuba's meshes that have attributes, such as colours of vertices, which materials may read."""
        return [node for node in self.materials if isinstance(node, mi.Mesh)]

    def curve_vertices(self, name: str, control_points: Float | npt.ArrayLike) -> Float:
        """See :meth:`shadowmap_dr.Renderer.curve_vertices`."""
        index = [info.name for info in self.geometry.shapes].index(self.geometry.shape(name).name)
        source = self.sources[index]
        if not isinstance(source, CurveSource):
            raise ShadowmapError(f"Shape '{name}' is no curve: give its vertices instead of control points.")
        points = mi.Float(control_points)
        if dr.width(points) != 4 * source.count:
            raise ShadowmapError(
                f"{dr.width(points)} numbers for curve '{name}': give x, y, z and radius of {source.count} control points."
            )
        return source.placed(source.with_control_points(points)).positions


def load(scene: mi.Scene, *, tessellation: int = 64, warn: bool = True) -> SceneData:
    """Read a ``mi.Scene``. Needs a variant ``*_ad_rgb`` or ``*_ad_mono``.

    Args:
        scene: the scene.
        tessellation: triangles around the circumference of spheres, disks and cylinders; curves have fewer in proportion
            (``sources.source_of``).
        warn: name all unsupported parts, which are left out, in one ``UserWarning``.

    Raises:
        ShadowmapError: a part is broken (the message names the plug-in and its id), or no shape is supported.
    """
    if not ("_ad_" in mi.variant() and mi.variant().endswith(("_rgb", "_mono"))):
        raise ShadowmapError(
            f"Mitsuba variant '{mi.variant()}' is not supported: set one whose name ends in _ad_rgb or _ad_mono, "
            "for instance llvm_ad_rgb."
        )
    if not isinstance(scene, mi.Scene):
        given = repr(scene) if isinstance(scene, str) else f"a {type(scene).__name__}"
        raise ShadowmapError(f"{given} is no mi.Scene of the variant {mi.variant()}: load it with mi.load_file or mi.load_dict.")
    if not isinstance(tessellation, Integral) or tessellation < 3:
        raise ShadowmapError(f"tessellation is {tessellation!r}, but must be an integer of at least 3.")
    names, sources, faces, unsupported = [], [], [], []
    known: dict[Any, Any] = {}
    for name, shape, instance in named_shapes(scene):
        try:
            source, own_faces = source_of(name, shape, instance, tessellation, known)
        except UnsupportedShape as error:
            unsupported.append(str(error).rstrip("."))
            continue
        names.append(name)
        sources.append(source)
        faces.append(own_faces)
    if not sources:
        why = "; ".join(unsupported) or "it has no shapes"
        raise ShadowmapError(f"There is nothing to render in the scene: {why}.")
    soup, infos = _described(names, sources, faces)
    face_counts, vertex_counts = [i.face_count for i in infos], [i.vertex_count for i in infos]
    shape_index = np.arange(len(infos), dtype=np.uint32)
    starts = np.array([i.vertex_start for i in infos], np.uint32)
    merged, vertex_shape = np.concatenate(faces) + np.repeat(starts, face_counts)[:, None], np.repeat(shape_index, vertex_counts)
    settled = stand_ins(merged, vertex_shape, infos, np.array([isinstance(s.shape, mi.Mesh) for s in sources]))
    geometry = Geometry(
        positions=NOT_READ,
        normals=NOT_READ,
        texcoords=NOT_READ,
        rest_positions=NOT_READ,
        faces=device_array(mi.UInt32, merged),
        face_shape=device_array(mi.UInt32, np.repeat(shape_index, face_counts)),
        face_info=device_array(mi.UInt32, pack_face_info(infos)),
        vertex_shape=device_array(mi.UInt32, vertex_shape),
        shape_face_start=device_array(mi.UInt32, [i.face_start for i in infos]),
        shapes=StaticTuple(infos),
        stand_ins=None if settled is None else device_array(mi.UInt32, settled),
        size_guards=size_guards_of(infos),
    )
    bsdfs = [source.shape.bsdf() for source in sources]
    different = list(dict.fromkeys(bsdfs))
    attributed = [source.shape for source, info in zip(sources, infos, strict=True) if info.reads_attributes]
    data = SceneData(
        scene=scene,
        geometry=geometry,
        sensors=(),
        lights=(),
        areas=(),
        environments=(),
        shape_ptr=_pointers(mi.ShapePtr, [source.shape for source in sources]),
        bsdf_ptr=_pointers(mi.BSDFPtr, bsdfs),
        sources=tuple(sources),
        materials=(*different, *attributed),
        variant=mi.variant(),
        needs_frames=not all(is_plain(bsdf) for bsdf in different),
        only_cosines=all(is_cosine(bsdf) for bsdf in different),
        soup=soup if len(sources) >= _MANY_SHAPES else None,
    )
    check_directions(scene)
    if data.soup is None:
        data = replace(data, few=FewShapes(sources, [k for k, info in enumerate(infos) if info.planar or info.faceted]))
    data = refresh(data)
    for sensor in scene.sensors():
        check_film(sensor)
    if warn:
        shapes = [(info.name, source.shape) for info, source in zip(infos, sources, strict=True)]
        warn_of(omissions_of(scene, shapes, unsupported))
    return replace(data, geometry=replace(data.geometry, as_loaded=True, moved=()))


def refresh(
    data: SceneData,
    sensors: tuple[mi.Sensor, ...] | None = None,
    known: Mapping[str, Any] | None = None,  # Any: fields of different types
) -> SceneData:
    """Read again all values that scene parameters may have changed: vertices, normals, texture coordinates, lights, sensors.

    ``sensors``: Mitsuba's sensors to read instead of all sensors of the scene. ``known``: those of the :data:`PARTS` that still
    hold.
    Values are attached where the scene's parameters are. Topology must be that of ``load``. BSDFs need no refresh: Mitsuba itself
    evaluates them. With few shapes nothing is read back to the host. With many, vertices and transformations without gradients
    are read back when they have been given other values.
    """
    known, scene = known or {}, data.scene
    chosen = scene.sensors() if sensors is None else sensors
    return with_fields(
        data,
        geometry=known["geometry"] if "geometry" in known else _geometry_now(data),
        sensors=known["sensors"] if "sensors" in known else tuple(map(sensors_of, chosen, names_of(chosen, "camera"))),
        lights=known["lights"] if "lights" in known else lights_of(scene),
        areas=area_lights_of(scene, [source.shape for source in data.sources]),
        environments=environments_of(scene),
    )


def _geometry_now(data: SceneData) -> Geometry:
    """The current vertices of a scene. Attached."""
    vertices, attached, moved = _vertices(data)
    changed = {*attached, *(moved or ())}
    # Not an empty array: one among the arguments of a frozen function ends the process (Dr.Jit 1.5).
    rest = vertices.rest if any(info.reads_attributes for info in data.geometry.shapes) else None
    return with_fields(
        data.geometry,
        positions=data.geometry.settled(vertices.positions),
        normals=vertices.normals,
        texcoords=vertices.texcoords,
        rest_positions=rest,
        changed=data.geometry.names_of(sorted(changed)) if attached and len(changed) <= _FEW_CHANGED else None,
        as_loaded=False,
        moved=None if moved is None else data.geometry.names_of(moved),
        packets=None,
    )


def named_shapes(scene: mi.Scene) -> Iterator[tuple[str, mi.Shape, mi.Shape | None]]:
    """(unique name, shape, instance or None) of all shapes, shape groups resolved."""
    groups = _Groups(scene)
    taken: set[str] = set()
    shapes = scene.shapes()
    for name, shape in zip(names_of(shapes, "shape"), shapes, strict=True):
        if shape.class_name() == "Instance":
            for child_index, child in enumerate(groups.shapes_of(shape, name)):
                yield unique(f"{name}.{child.id() or child_index}", taken), child, shape
        else:
            yield unique(name, taken), shape, None


class _Groups:
    """The shape groups of a scene.

    Mitsuba does not tell the group of an instance. But instances and groups list the arrays that they hold, and an instance holds
    all arrays of its group.
    """

    def __init__(self, scene: mi.Scene) -> None:
        nodes = [node for _, node in children(scene) if node.class_name().startswith("ShapeGroup")]
        self._groups = [
            (held_arrays(node), [child for _, child in children(node) if isinstance(child, mi.Shape)]) for node in nodes
        ]

    def shapes_of(self, instance: mi.Shape, name: str) -> list[mi.Shape]:
        """Shapes of the group that an instance shows. ``name``: of the instance, for messages."""
        if len(self._groups) == 1:
            return self._groups[0][1]
        held = held_arrays(instance)
        shown = [(len(arrays), shapes) for arrays, shapes in self._groups if arrays and arrays <= held]
        if not shown:
            raise ShadowmapError(f"The shape group of instance '{name}' was not found in the scene.")
        # The arrays of a group may be a part of those of another group, which has the same shapes and more.
        return max(shown, key=lambda group: group[0])[1]


def with_positions(data: SceneData) -> Geometry:
    """The geometry with the current vertex positions, attached. Normals and texture coordinates stay as they were read."""
    return replace(data.geometry, positions=data.geometry.settled(_vertices(data)[0].positions))


def _described(names: list[str], sources: list[ShapeSource], faces: list[np.ndarray]) -> tuple[Soup, tuple[ShapeInfo, ...]]:
    """The soup of shapes with these faces, and the description of each shape."""
    with dr.suspend_grad():
        soup = Soup(names, sources)
    points, normals = (buffer.numpy().reshape(-1, 3) for buffer in soup.own())
    parts = Parts(points, normals, np.concatenate(faces), soup.counts, np.array([len(own) for own in faces]))
    return soup, describe_all(names, sources, soup.held, soup.mirrored(), parts)


def _pointers(kind: type, objects: list[mi.Object]) -> mi.ShapePtr | mi.BSDFPtr:
    """Pointers to Mitsuba's objects, evaluated."""
    # Joined on the host, as numbers: Dr.Jit would compile another kernel for each number of shapes.
    numbers = [mi.UInt32(dr.reinterpret_array(mi.UInt32, kind(one)))[0] for one in objects]
    return dr.reinterpret_array(kind, device_array(mi.UInt32, numbers))


def _vertices(data: SceneData) -> tuple[Vertices, list[int], list[int] | None]:
    """(the current vertices of all shapes, attached; numbers of shapes with gradients; those of planar and faceted shapes that
    may not be as they were when the scene was loaded, None if that is not known)."""
    sources, infos = data.sources, data.geometry.shapes

    def single(k: int) -> tuple[Float, Float, Float, Float]:
        return _vertex_buffers(sources[k], infos[k])

    if dr.flag(dr.JitFlag.FreezingScope):  # a replay would not read again the vertices that are kept
        buffers = [single(k) for k in range(len(sources))]
        attached = [k for k, own in enumerate(buffers) if dr.grad_enabled(own)]
        return Vertices(*(dr.concat(list(parts)) for parts in zip(*buffers, strict=True))), attached, None
    if data.soup is not None:
        return *data.soup.vertices(single), None
    assert data.few is not None, "made where there is no soup"
    return data.few.vertices(single)


def _vertex_buffers(source: ShapeSource, info: ShapeInfo) -> tuple[Float, Float, Float, Float]:
    """(positions, normals, texcoords, rest positions) of one shape: flat, world space (rest: own space), attached."""
    own = source.own()
    if len(own.positions) != 3 * info.vertex_count:
        now = len(own.positions) // 3
        raise ShadowmapError(f"Shape '{info.name}' now has {now} vertices instead of {info.vertex_count}: load the scene again.")
    world = source.placed(own)
    normals = world.normals if info.has_normals else dr.zeros(mi.Float, 3 * info.vertex_count)
    texcoords = world.texcoords if info.has_texcoords else dr.zeros(mi.Float, 2 * info.vertex_count)
    return world.positions, cast(Float, normals), cast(Float, texcoords), own.positions
