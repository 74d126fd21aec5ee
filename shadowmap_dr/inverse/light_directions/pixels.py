"""A static scene under directional lights that change: everything that their shading needs, computed once."""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import cast

import drjit as dr
import mitsuba as mi

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.types import Bool, Float, Normal3f, Point3f, UInt32, Vector3f
from ...raster import Topology, build_topology, drawing_order, outward_faces
from ...raster.antialiasing.edge_crossings import Crossings
from ...raster.antialiasing.neighbour_weights import around, neighbours
from ...rendering.gbuffer.camera_view import VisiblePoints
from ...rendering.renderer import GBuffer, Renderer
from ...rendering.shadow_pass import boxes_of, shape_planes
from ...scene.lights.punctual import DirectionalLight
from ...shadow import Boxes, ShadowSettings

_KINDS = "plain diffuse materials under directional lights only"


@dataclass(frozen=True)
class Pixels:
    """Surfaces that the camera sees in P pixels. All arrays are detached and evaluated.

    Attributes:
        height, width: of the image; P = height * width.
        points: points of the visibility look-ups, world space (list of Point3f, P each).
        n_shading, n_world: (P,), shading and geometric unit normals on the camera's side.
        colours: reflected radiance for unit irradiance at normal incidence, one Float (P,) for each channel; 0 on the background.
        active: Bool (P,), pixels that show a surface.
        incoming, outgoing: Float (4 P,), anti-aliasing of the image: shares of the right, lower, left and upper neighbours in a
            pixel's colour, and shares of the pixel's colour in these neighbours.
    """

    height: int
    width: int
    points: list[Point3f]
    n_shading: Normal3f
    n_world: Normal3f
    colours: list[Float]
    active: Bool
    incoming: Float
    outgoing: Float

    @property
    def count(self) -> int:
        """Number P of pixels."""
        return self.height * self.width

    @property
    def channels(self) -> int:
        """Number of colour channels."""
        return len(self.colours)


@dataclass(frozen=True)
class StillScene:
    """A static scene: only the directions of its n directional lights change. A PyTree that may cross ``dr.freeze``.

    Attributes:
        pixels: surfaces that the camera sees.
        irradiance: of each light, a Float of width 1 for each channel.
        shadow: settings of the shadow maps.
        p_world, faces, topology: merged mesh of all S shapes.
        outward: Bool, faces that shadow maps show from the front only.
        vertex_shape, shapes: number of each vertex's shape, and S.
        planes, planar, boxes: extents of the shapes, see :func:`shadowmap_dr.shadow.casting_shapes`.
        seen: visible points, a mask of the valid ones, and the places of cameras.
    """

    pixels: Pixels
    irradiance: list[list[Float]]
    shadow: ShadowSettings
    p_world: Point3f
    faces: UInt32
    topology: Topology
    outward: Bool
    vertex_shape: UInt32
    shapes: int
    planes: tuple[Vector3f, Point3f]
    planar: Bool
    boxes: Boxes
    seen: VisiblePoints

    @property
    def lights(self) -> int:
        """Number n of lights."""
        return len(self.irradiance)

    @classmethod
    def of(cls, renderer: Renderer, sensor: int = 0) -> StillScene:
        """Extract the arrays of a renderer's scene.

        Raises ShadowmapError for anything but plain diffuse materials under directional lights, for shadow maps that are not
        pre-filtered, and for a film whose filter is not a box.
        """
        data, settings = renderer.data, renderer.settings
        if data.areas or data.environments or settings.ambient > 0 or settings.aovs:
            raise ShadowmapError(f"the scene has extended or ambient light, or AOVs: batches of lights know {_KINDS}.")
        lights: list[DirectionalLight] = []
        for light in data.lights:
            if not isinstance(light, DirectionalLight):
                raise ShadowmapError(f"light '{light.name}' is a {type(light).__name__}: batches of lights know {_KINDS}.")
            lights.append(light)
        if not lights:
            raise ShadowmapError("the scene has no light: add a directional light.")
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
            irradiance = [[mi.Float(light.irradiance[c]) for c in range(channels)] for light in lights]
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


def mixed_pixels(pixels: Pixels, colours: list[Float]) -> Float:
    """Anti-alias an image of one Float (P,) for each channel. Returns Float (P C,), interleaved. Attached to ``colours``."""
    dr.eval(colours)
    pixel = dr.arange(mi.UInt32, pixels.count)
    share = dr.gather(mi.Vector4f, pixels.incoming, pixel)
    result = [(1 - sum(share)) * colour for colour in colours]
    for k, neighbour in enumerate((pixel + 1, pixel + pixels.width, pixel - 1, pixel - pixels.width)):
        taken = share[k] > 0
        result = [r + share[k] * dr.gather(mi.Float, c, neighbour, taken) for c, r in zip(colours, result, strict=True)]
    return cast(Float, dr.ravel(mi.Vector3f(*result))) if len(result) == 3 else result[0]


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
        incoming, outgoing = _shares(buffer.crossings, camera.width, count)
    colours = [dr.select(surface.active, colour[c], 0) for c in range(channels)]
    points = [mi.Point3f(point) for point in buffer.points]
    active = mi.Bool(surface.active)
    return Pixels(camera.height, camera.width, points, shading, n_world, colours, active, incoming, outgoing)


def _shares(crossings: Crossings, width: int, count: int) -> tuple[Float, Float]:
    """``incoming`` and ``outgoing`` of :class:`Pixels`."""
    pixel = dr.arange(mi.UInt32, count)
    right, down = crossings.right, crossings.down
    incoming, outgoing = around(right, down, width, 1), around(right, down, width, -1)
    total: Float = functools.reduce(operator.add, incoming)
    scale = dr.rcp(dr.maximum(1, total))
    dr.eval(scale)
    given = [
        weight * dr.gather(mi.Float, scale, neighbour, weight > 0)
        for weight, neighbour in zip(outgoing, neighbours(pixel, width), strict=True)
    ]
    shares = mi.Vector4f(*(weight * scale for weight in incoming)), mi.Vector4f(*given)
    return cast(Float, dr.ravel(shares[0])), cast(Float, dr.ravel(shares[1]))
