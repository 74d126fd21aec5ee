"""The camera pass: the triangles that a camera's samples hit, the surfaces there, and how neighbouring samples mix."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi

from ...jit.pytree import tree_map
from ...jit.types import Bool, Float, Point3f, UInt32, Vector4f
from ...raster import Crossings, RasterOutput, Topology, detach_moved_seams, visible_triangles
from ...raster.antialiasing.edge_crossings import find_crossings
from ...scene.geometry import Geometry
from ...scene.load import SceneData
from ...scene.sensor import ImageSize, Sensor
from ...shadow import TranslucentCasters
from .camera_clip import camera_clip, eye_of, least_gap, seen_points, within_far_plane, without_shapes
from .facet_normals import FlatFaces, facet_normals, mean_normals, prefilter_normals
from .shading_edges import ShadingEdges
from .surface import Surface, normals_at, surface_at
from .surface_points import pixel_hits
from .translucency import Translucency
from .translucent_layers import Layers

#: Points in world space, spread over the surfaces that cameras see; the mask of the valid ones; and the places of these cameras,
#: in homogeneous coordinates: points, or directions to orthographic ones.
VisiblePoints: TypeAlias = tuple[Point3f, Bool, Vector4f]


@dataclass(frozen=True)
class CameraView:
    """One camera's visibility: clip-space vertices and the triangle at each sample, ``factor`` x ``factor`` samples a pixel.

    ``topology``: edges of the shapes that the camera sees, at their current places. ``raster``: of opaque surfaces. ``layers``:
    translucent surfaces before them, None in scenes without any.
    """

    sensor: Sensor
    factor: int
    clip: Float
    raster: RasterOutput
    topology: Topology
    layers: Layers | None = None

    @property
    def nearest(self) -> CameraView:
        """The same view of the nearest surfaces, opaque or not."""
        return self if self.layers is None else replace(self, raster=self.layers.nearest, layers=None)

    @property
    def size(self) -> ImageSize:
        """Samples of the camera's window."""
        return ImageSize(self.raster.width, self.raster.height)

    @property
    def columns(self) -> int:
        """Samples across the whole film, also when only a crop window is rendered."""
        return self.sensor.film_size.width * self.factor


@dataclass(frozen=True)
class PlacedShapes:
    """The shapes of a scene at their current places, and all records that depend on these places alone.

    Attributes:
        geometry: the triangles.
        facets: (normals of flat faces (Float, 4 F), their sums at each place (Float, 4 V)), None without flat faces.
        creases: edges at which shading jumps, as arguments of :func:`~shadowmap_dr.raster.find_crossings`.
        seen, casting: edges of the shapes that cameras see, and of those that cast shadows.
        translucent, translucent_creases: edges of the translucent faces alone, None and nothing without any.
    """

    geometry: Geometry
    facets: tuple[Float, Float] | None
    creases: dict[str, Any]
    seen: Topology
    casting: Topology
    translucent: Topology | None = None
    translucent_creases: dict[str, Any] = field(default_factory=dict)

    @property
    def detached(self) -> PlacedShapes:
        """The same shapes without gradients to their places."""
        geometry, facets = tree_map((self.geometry, self.facets), dr.detach)
        return replace(self, geometry=geometry, facets=facets)


@dataclass(frozen=True)
class Frame:
    """The samples of one camera, N of them.

    Attributes:
        view: the camera and the triangles that it sees.
        surface: the surfaces there.
        depth: ``SurfacePoints.depth``, or None.
        sharpness: ``Float`` (N,), visibility of edges between facets, 0 to 1; None where all are fully visible.
    """

    view: CameraView
    surface: Surface
    depth: Float | None
    sharpness: Float | None


@dataclass(frozen=True)
class GBuffer:
    """Surfaces that a camera sees, H * W pixels, row-major.

    Attributes:
        sensor: the camera.
        surface: the surface at each pixel.
        points: places of visibility look-ups, spread over the pixel (Point3f, H * W each); a pixel's visibility is their mean.
        crossings: how pixels mix, None without anti-aliasing.
        seen: sample points on all surfaces that the camera sees.
    """

    sensor: Sensor
    surface: Surface
    points: list[Point3f]
    crossings: Crossings | None
    seen: VisiblePoints


@dataclass(frozen=True)
class CameraPass:
    """Renders the surfaces that cameras see.

    Attributes:
        data: records of the scene.
        topology: edges of the merged mesh.
        flat: faces that are shaded flat, or None.
        creases: edges of faces at which shading jumps, None if images are not anti-aliased.
        hidden: shapes that cameras do not see.
        translucency: the faces that are not opaque, None if all are.
    """

    data: SceneData
    topology: Topology
    flat: FlatFaces | None
    creases: ShadingEdges | None
    hidden: tuple[int, ...] = ()
    translucency: Translucency | None = None

    def placed(self, geometry: Geometry) -> PlacedShapes:
        """Records of the shapes at the places that a geometry gives them. Attached to the geometry."""
        facets = self._facets(geometry)
        creases = {}
        if self.creases is not None:
            creases = {"creases": self.creases.now(geometry), "folds": self.creases.folds_of(facets and facets[0])}
        faces = None if self.translucency is None else self.translucency.faces
        own = {} if faces is None else faces.creases(creases)
        return PlacedShapes(geometry, facets, creases, *self._topologies(geometry), own)

    def view(self, sensor: Sensor, shapes: PlacedShapes, factor: int) -> CameraView:
        """Rasterize the scene. Clip-space vertices are attached to vertices and camera."""
        geometry = shapes.geometry
        clip = camera_clip(sensor, geometry)
        if self.hidden:
            clip = without_shapes(clip, geometry, self.hidden)
            dr.eval(clip)
        size = (sensor.height * factor, sensor.width * factor)
        translucency = self.translucency
        if translucency is None:
            return CameraView(sensor, factor, clip, visible_triangles(clip, geometry.faces, size), shapes.seen)
        raster = visible_triangles(clip, geometry.faces, size, drawn=translucency.opaque)
        return CameraView(
            sensor, factor, clip, raster, shapes.seen, translucency.layers(self.data, geometry, sensor, clip, raster)
        )

    def casters(self, shapes: PlacedShapes, camera: Sensor) -> tuple[Bool | None, TranslucentCasters | None]:
        """Mask of the opaque faces (Bool, F), and the casters that are not, None each without any. ``camera``: any camera."""
        if self.translucency is None:
            return None, None
        return self.translucency.opaque, self.translucency.casters(self.data, shapes.geometry, camera, shapes.translucent)

    def seen(self, views: Sequence[CameraView], geometry: Geometry) -> VisiblePoints:
        """Points on surfaces that cameras see. Detached."""
        found = [
            seen_points(each.sensor, each.raster, geometry)
            for view in views
            for each in ((view,) if view.layers is None else (view, view.nearest))
        ]
        points, hits = found[0]
        if len(found) > 1:
            points = mi.Point3f(*(dr.concat([p[c] for p, _ in found]) for c in range(3)))
            hits = dr.concat([mi.Bool(hit) for _, hit in found])
        eyes = [eye_of(view.sensor) for view in views]
        return points, hits, mi.Vector4f(*(dr.concat([mi.Float(eye[c]) for eye in eyes]) for c in range(4)))

    def frame(self, view: CameraView, shapes: PlacedShapes, frames: bool, triangle: UInt32 | None = None) -> Frame:
        """The surfaces that a camera sees, attached.

        ``frames``: as for :func:`surface_at`; ``triangle``: triangles of the scene if the view shows a part of them alone.
        """
        sensor, geometry = view.sensor, shapes.geometry
        hits = pixel_hits(geometry, sensor, view.raster.triangle if triangle is None else triangle, view.size)
        hits = replace(hits, active=hits.active & within_far_plane(sensor, hits.depth))
        normals, sharpness = normals_at(geometry, hits), None
        if shapes.facets is not None:
            normals, sharpness = prefilter_normals(hits, normals, self.topology, shapes.facets[1])
        return Frame(view, surface_at(self.data, geometry, sensor, hits, *normals, frames=frames), hits.depth, sharpness)

    def crossings(self, view: CameraView, sharpness: Float | None, shapes: PlacedShapes) -> Crossings:
        """Edges through which the samples of a camera mix. ``sharpness``: that of its :class:`Frame`. Detached."""
        dr.eval(sharpness)
        return find_crossings(
            view.clip,
            view.topology,
            view.raster,
            shapes.geometry.vertex_count,
            crease_weights=sharpness,
            meetings=True,
            gap=least_gap(view.sensor),
            front=None if view.layers is None else view.layers.front,
            **shapes.creases,
        )

    def _facets(self, geometry: Geometry) -> tuple[Float, Float] | None:
        if self.flat is None:
            return None
        normals = facet_normals(geometry, self.flat)
        return dr.detach(normals), mean_normals(normals, self.topology, self.flat)

    def _topologies(self, geometry: Geometry) -> tuple[Topology, Topology, Topology | None]:
        """The topology of the shapes that cameras see, of those that cast shadows, and of translucent faces."""
        casting, shape = self.topology, geometry.vertex_shape
        translucent = None if self.translucency is None else self.translucency.topology
        points = dr.gather(mi.Point3f, dr.detach(geometry.positions), dr.arange(mi.UInt32, geometry.vertex_count))
        if not (geometry.as_loaded and geometry.positions is self.data.geometry.positions):
            casting = detach_moved_seams(casting, points, shape)
            translucent = translucent and detach_moved_seams(translucent, points, shape)
        seen = detach_moved_seams(self.topology, points, shape, self.hidden) if self.hidden else casting
        return seen, casting, translucent
