"""A still scene under lights that change: all that shading by directional lights needs to know of it, computed once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...raster import Topology, build_topology, drawing_order, outward_faces
from ...raster.antialiasing.blend import Mixer
from ...rendering.renderer import GBuffer, Renderer
from ...rendering.shadow_pass import boxes_of, shape_planes
from ...scene.lights.punctual import DirectionalLight
from ...shadow import Boxes, ShadowSettings

_KINDS = "plain diffuse materials under directional lights only"


@dataclass(frozen=True)
class Pixels:
    """Surfaces that the camera sees, P pixels. All arrays are detached and evaluated.

    Attributes:
        height, width: of the image; P = height * width.
        points: where visibility is looked up (list of Point3f, P each).
        n_shading, n_world: Vector3f (P,), shading and geometric unit normals on the camera's side.
        colours: reflected radiance for unit irradiance at normal incidence, one Float (P,) for each channel; 0 where nothing is.
        active: Bool (P,), whether there is anything.
        incoming, outgoing: Float (4 P,), shares of the right, lower, left and upper neighbours in a pixel's colour, and of a
            pixel's colour in these neighbours' (anti-aliasing of the image).
    """

    height: int
    width: int
    points: list[Any]
    n_shading: Any
    n_world: Any
    colours: list[Any]
    active: Any
    incoming: Any
    outgoing: Any

    @property
    def count(self) -> int:
        """P."""
        return self.height * self.width

    @property
    def channels(self) -> int:
        """Colour channels."""
        return len(self.colours)


@dataclass(frozen=True)
class StillScene:
    """A scene in which nothing but the directions of its n directional lights changes. A PyTree that may cross ``dr.freeze``.

    Attributes:
        pixels: what the camera sees.
        irradiance: for each light its colour, Float of width 1 for each channel.
        shadow: how shadows are computed.
        p_world, faces, topology, outward, vertex_shape, shapes: the mesh of all S shapes, and its faces that hide their backs.
        planes, planar, boxes: what is known about the shapes, see :func:`shadowmap_dr.shadow.casting_shapes`.
        seen: points on what is in view, and which of them there are.
    """

    pixels: Pixels
    irradiance: list[list[Any]]
    shadow: ShadowSettings
    p_world: Any
    faces: Any
    topology: Topology
    outward: Any
    vertex_shape: Any
    shapes: int
    planes: Any
    planar: Any
    boxes: Boxes
    seen: Any

    @property
    def lights(self) -> int:
        """n."""
        return len(self.irradiance)

    @classmethod
    def of(cls, renderer: Renderer, sensor: int = 0) -> StillScene:
        """Take a scene apart that a renderer holds.

        Raises ShadowmapError for anything but plain diffuse materials under directional lights, shadow maps that are not
        pre-filtered, and a film with another filter than a box.
        """
        data, settings = renderer.data, renderer.settings
        if data.areas or data.environments or settings.ambient > 0 or settings.aovs:
            raise ShadowmapError(f"the scene has extended or ambient light, or AOVs: batches of lights know {_KINDS}.")
        for light in data.lights:
            if not isinstance(light, DirectionalLight):
                raise ShadowmapError(f"light '{light.name}' is a {type(light).__name__}: batches of lights know {_KINDS}.")
        if not data.lights:
            raise ShadowmapError("the scene has no light: give it directional ones.")
        if data.needs_frames or any(info.see_through for info in data.geometry.shapes):
            raise ShadowmapError(f"the scene has textures, gloss or transparency: batches of lights know {_KINDS}.")
        shadow = settings.shadow
        if shadow.method != "none" and (shadow.compat or not shadow.filterable):
            raise ShadowmapError(f"shadow method {shadow.method!r} with compat={shadow.compat}: use a pre-filtered one, or none.")
        with dr.suspend_grad():
            geometry = data.geometry
            positions = dr.detach(geometry.positions)
            p_world = dr.gather(mi.Point3f, positions, dr.arange(mi.UInt32, geometry.vertex_count))
            planes, planar = shape_planes(renderer.plan, geometry)
            buffer = renderer.g_buffer(sensor)
            vertices = positions.numpy().reshape(-1, 3)
            faces = geometry.faces.numpy().reshape(-1, 3)
            faces = faces[drawing_order(faces, vertices)]
            topology = build_topology(faces, vertices, mi.UInt32)
            channels = buffer.sensor.channels
            irradiance = [[mi.Float(light.irradiance[c]) for c in range(channels)] for light in data.lights]
            scene = cls(
                _pixels(buffer, channels),
                irradiance,
                shadow,
                p_world,
                device_array(mi.UInt32, faces),
                topology,
                device_array(mi.Bool, outward_faces(topology, vertices)),
                geometry.vertex_shape,
                len(geometry.shapes),
                planes,
                planar,
                boxes_of(geometry),
                buffer.seen,
            )
            dr.eval(scene)
            return scene


def mixed_pixels(pixels: Pixels, colours: list[Any]) -> Any:
    """Anti-aliased image, flat with interleaved channels, of the colours of its pixels (Float (P,) each). Attached to them."""
    dr.eval(colours)
    pixel = dr.arange(mi.UInt32, pixels.count)
    share = dr.gather(mi.Vector4f, pixels.incoming, pixel)
    result = [(1 - sum(share)) * colour for colour in colours]
    for k, neighbour in enumerate((pixel + 1, pixel + pixels.width, pixel - 1, pixel - pixels.width)):
        taken = share[k] > 0
        result = [r + share[k] * dr.gather(mi.Float, c, neighbour, taken) for c, r in zip(colours, result, strict=True)]
    return dr.ravel(mi.Vector3f(*result)) if len(result) == 3 else result[0]


def _pixels(buffer: GBuffer, channels: int) -> Pixels:
    surface, camera = buffer.surface, buffer.sensor
    if channels != dr.size_v(mi.UnpolarizedSpectrum):
        raise ShadowmapError("a film of luminance under a colour variant: use a film of RGB, or a monochromatic variant.")
    if camera.alpha:
        raise ShadowmapError("the film has an alpha channel, which no light changes: use a film without.")
    side = dr.select(surface.si.wi.z < 0, mi.Float(-1), 1)
    colour = surface.evaluate(mi.Vector3f(0, 0, side), surface.active)
    n_world = mi.Vector3f(surface.n_world)
    n_world = dr.select(dr.dot(n_world, surface.wi_world) < 0, -n_world, n_world)
    shading = mi.Vector3f(surface.si.sh_frame.n) * side
    count = camera.width * camera.height
    incoming, outgoing = dr.zeros(mi.Float, 4 * count), dr.zeros(mi.Float, 4 * count)
    if buffer.crossings is not None:
        incoming, outgoing = _shares(buffer, camera.width, count)
    colours = [dr.select(surface.active, colour[c], 0) for c in range(channels)]
    points = [mi.Point3f(point) for point in buffer.points]
    active = mi.Bool(surface.active)
    return Pixels(camera.height, camera.width, points, shading, n_world, colours, active, incoming, outgoing)


def _shares(buffer: GBuffer, width: int, count: int) -> tuple[Any, Any]:
    mixer = Mixer([dr.zeros(mi.Float, count)], width, buffer.crossings)
    pixel = dr.arange(mi.UInt32, count)
    right, down = buffer.crossings.right, buffer.crossings.down
    incoming, outgoing = mixer.around(right, down, 1), mixer.around(right, down, -1)
    scale = dr.rcp(dr.maximum(1, sum(incoming)))
    dr.eval(scale)
    given = [
        weight * dr.gather(mi.Float, scale, neighbour, weight > 0)
        for weight, neighbour in zip(outgoing, mixer.neighbours(pixel), strict=True)
    ]
    return dr.ravel(mi.Vector4f(*(weight * scale for weight in incoming))), dr.ravel(mi.Vector4f(*given))
