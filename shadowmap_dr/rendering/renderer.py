"""The passes in order: shadow maps, G-buffer, shading, anti-aliasing. The functional path, and the core of the plug-in."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError
from ..jit.call_data import rewrite_scalars
from ..jit.frozen import take_apart
from ..jit.gpu import keep_registers
from ..jit.kernel_cache import note_size
from ..raster import RasterOutput, Topology, antialias, build_topology, detach_moved_seams, outward_faces, visible_triangles
from ..raster.antialiasing.edge_crossings import find_crossings
from ..scene.geometry import Geometry
from ..scene.lights.area import AreaLight
from ..scene.lights.environment import UniformRadiance
from ..scene.lights.punctual import SpotLight, SquareSpot
from ..scene.lights.read import Light
from ..scene.lights.soft_outline import softened
from ..scene.load import SceneData, load, refresh
from ..scene.sensor import Sensor
from ..scene.untracked import UntrackedState
from ..shadow import Frusta, ShadowSettings
from .direct_light import ambient_light, background, direct_light, emission
from .extended_lights import SoftFrusta, SoftPlan, make_soft_maps, samples_of, soft_light
from .film.aovs import collect_aovs
from .film.film import Margin, develop, film_channels, interleave, sample_grid, sample_windows
from .gbuffer.camera_pass import camera_clip, least_gap, seen_points, within_far_plane, without_shapes
from .gbuffer.camera_view import CameraView, GBuffer
from .gbuffer.facet_normals import facet_normals, flat_faces, mean_normals, prefilter_normals
from .gbuffer.pixel_footprint import FootprintSamples, footprint_points
from .gbuffer.shading_edges import ShadingEdges
from .gbuffer.surface import Surface, normals_at, opacity, surface, surface_at
from .gbuffer.surface_points import pixel_hits
from .light_loops import MANY_LIGHTS, many_lights
from .light_pass import Lighting, plan_extended_lights
from .settings import RenderSettings
from .shadow_pass import MapPlan, check_sizes, light_visibility, make_maps, plan_maps

# Directions over which the light of environments is summed.
_AMBIENT_DIRECTIONS = 16


@dataclass
class Renderer:
    """Renders one scene again and again, with other vertices, lights or cameras.

    A PyTree: pass it to functions decorated with ``dr.freeze``. A step touches neither Mitsuba's meshes nor its acceleration
    structures. The only state is the fit of the shadow maps (``frusta``, ``soft_frusta``): it stays as it is while the casters
    move within it.

    Attributes:
        data: records of the scene.
        topology: edges of the merged mesh.
        plan: which shadow maps there are.
        settings: how to render.
        flat: faces that are shaded flat, or None.
        creases: edges of faces at which shading jumps. Attributes and textures of meshes count as they were when the scene was
            read.
        outward: ``Bool`` (F,), faces that shadow maps show from the front only, or None.
        soft: how extended lights (area lights, environments) are sampled, and which maps these samples have.
        frusta: fit of the shadow maps in the last rendering, None before the first. ``soft_frusta``: of those of extended lights.
        untracked: what recordings do not see of the scene, or None if whoever records takes care of it.
    """

    data: SceneData
    topology: Topology
    plan: MapPlan
    settings: RenderSettings
    flat: Any = None
    creases: ShadingEdges | None = None
    outward: Any = None
    soft: tuple[SoftPlan, ...] = ()
    frusta: Frusta | None = None
    soft_frusta: SoftFrusta = (None, None)
    untracked: UntrackedState | None = None

    # All that Dr.Jit is to know of, instead of the fields: see ``frozen``.
    DRJIT_STRUCT: ClassVar[dict[str, type]] = {"recording_parts": tuple}

    @property
    def recording_parts(self) -> tuple[str, list[Any]]:
        """Text for what a recording holds, arrays and objects of Mitsuba's. Read by ``dr.freeze``."""
        return take_apart([getattr(self, part.name) for part in fields(self)])

    @classmethod
    def from_scene(
        cls,
        scene: Any,
        *,
        shadow_map_resolution: int = 256,
        shadow_method: str = "auto",
        shadow_filter: str = "gaussian",
        shadow_filter_size: int = 3,
        shadow_antialias: bool = True,
        shadow_bleeding: float = 0.0,
        shadow_order: int = 4,
        shadow_supersampling: int = 1,
        shadow_receiver_range: bool = True,
        shadow_cull_backfaces: bool = False,
        compat: bool = False,
        tessellation: int = 64,
        **settings: Any,
    ) -> Renderer:
        """Build a renderer for a ``mi.Scene``.

        The scene's meshes are read now, for the last time. ``settings`` are those of :class:`RenderSettings`, ``tessellation`` is
        the number of triangles around spheres, disks and cylinders.

        Raises:
            ShadowmapError: what the scene has and this renderer does not support, by name; invalid settings.
        """
        known = [setting.name for setting in fields(RenderSettings) if setting.name != "shadow"]
        for name in settings:
            if name not in known:
                raise ShadowmapError(f"There is no setting '{name}'; beside those of shadow maps there are {', '.join(known)}.")
        try:
            shadow = ShadowSettings(
                method=shadow_method,
                resolution=shadow_map_resolution,
                filter=shadow_filter,
                filter_size=shadow_filter_size,
                antialias=shadow_antialias,
                compat=compat,
                bleeding=shadow_bleeding,
                order=shadow_order,
                supersampling=shadow_supersampling,
                receiver_range=shadow_receiver_range,
                cull_backfaces=shadow_cull_backfaces,
            )
        except ValueError as error:
            raise ShadowmapError(str(error)) from None
        return cls.from_data(load(scene, tessellation=tessellation), RenderSettings(shadow, **settings))

    @classmethod
    def from_data(cls, data: SceneData, settings: RenderSettings) -> Renderer:
        """Build a renderer for scene records."""
        geometry = data.geometry
        positions = dr.detach(geometry.positions).numpy()
        see_through_faces = np.array([info.see_through for info in geometry.shapes])[geometry.face_shape.numpy()]
        topology = build_topology(
            geometry.faces.numpy(),
            positions,
            mi.UInt32,
            geometry.vertex_shape.numpy(),
            see_through_faces if see_through_faces.any() else None,
        )
        if not topology.count:
            raise ShadowmapError("There is nothing to render: all triangles of the scene have two corners at the same place.")
        plan, creases = plan_maps(data.lights, geometry), ShadingEdges.of(geometry, topology, data.sources)
        soft = plan_extended_lights(data, settings)
        if settings.shadow.method != "none":
            texels = settings.shadow.resolution * settings.shadow.supersampling
            check_sizes(plan.maps, texels, geometry, "lights", "lower shadow_map_resolution, or leave out lights")
        outward = mi.Bool(outward_faces(topology, positions.reshape(-1, 3))) if settings.shadow.cull_backfaces else None
        renderer = cls(data, topology, plan, settings, flat_faces(geometry, topology), creases, outward, soft)
        renderer.untracked = UntrackedState((*data.scene.emitters(), *data.materials()))
        # The first fit is made here, so that a step which is recorded later always starts from one.
        if data.sensors:
            with dr.suspend_grad():
                seen, casting = renderer._topologies(geometry)
                views = [renderer._view(camera, geometry, seen, 1) for camera in sample_windows(data.sensors[0])]
                renderer._lighting(views, geometry, casting, None)
        return renderer

    def with_data(self, data: SceneData) -> Renderer:
        """The same renderer for re-read records (:func:`shadowmap_dr.scene.load.refresh`) of the same scene."""
        return replace(self, data=data)

    def with_replanned_lights(self) -> Renderer:
        """The same renderer with area lights and environments divided, and their maps aimed, as its records are now."""
        return replace(self, soft=plan_extended_lights(self.data, self.settings), soft_frusta=(None, None))

    @property
    def texels(self) -> int:
        """Of all shadow maps, before supersampled ones are made smaller."""
        if self.settings.shadow.method == "none":
            return 0
        side = self.settings.shadow.resolution * self.settings.shadow.supersampling
        return self.plan.maps * side**2 + sum(plan.maps for plan in self.soft) * self.settings.soft_map_resolution**2

    def with_updated_shading_edges(self) -> Renderer:
        """The same renderer with the edges at which colours of meshes jump as they are now."""
        sources = self.data.sources
        return replace(self, creases=self.creases and self.creases.with_colours(self.data.geometry, sources))

    def refresh(self) -> Renderer:
        """The same renderer with the scene's current vertices, lights and sensors, attached where they carry gradients."""
        return self.with_data(refresh(self.data))

    def render(
        self,
        vertex_positions: Mapping[str, Any] | None = None,
        lights: Mapping[str, Light] | None = None,
        sensor: int | Sensor = 0,
        spp: int = 1,
    ) -> Any:
        """Render an image.

        Args:
            vertex_positions: new world-space vertices by the name of their shape: ``Float`` (3V,), tensor (V, 3) or ``Point3f``.
            lights: new records by the name of the light (start from ``renderer.light(name)`` and ``dataclasses.replace``).
            sensor: number of the scene's sensor, or a camera record.
            spp: samples per pixel, a grid of ``ceil(sqrt(spp)) ** 2``, at most 16 x 16 and
                4096 along the longer side of the image. Each is anti-aliased.

        Returns:
            ``mi.TensorXf`` (H, W, C): linear colour (1 or 3 channels, as the film), then alpha if the film has it, then the AOVs.
            Colour and alpha have passed through the film's reconstruction filter.
            Attached to vertices, lights, cameras, and the BSDFs and textures of the scene.
        """
        keep_registers()
        self.note_kernels(spp, sensor)
        cameras, geometry = self.data.cameras(sensor), self.data.geometry
        rewrite_scalars(self.data.materials())
        if vertex_positions is not None:
            geometry = geometry.with_positions(vertex_positions)
        windows = sample_windows(cameras)
        factor = sample_grid(spp, windows)
        samples = max(window.width * window.height for window in windows) * factor**2
        # Before all else that is attached: derivatives are taken in the reverse order, and pixels should need one pass only.
        geometry = geometry.in_packets(samples)
        facets = self._facets(geometry)
        margin = Margin.of(cameras, factor) if self.settings.antialias else Margin()
        seen, casting = self._topologies(geometry)
        views = [self._view(margin.around(window), geometry, seen, factor) for window in windows]
        lighting = self._lighting(views, geometry, casting, lights).for_points(samples)
        shapes = (geometry, facets, self._creases(geometry, facets))
        pictures = [margin.cut(self._camera_image(view, lighting, *shapes), factor) for view in views]
        return develop(pictures, windows[0], factor)

    def note_kernels(self, spp: int, sensor: int | Sensor = 0) -> None:
        """Before an image is taken: let kernels of others go, if there have been many sizes."""
        cameras = self.data.cameras(sensor)
        sizes = [(camera.film_size, camera.crop_size, camera.crop_offset) for camera in cameras]
        note_size((*sizes, spp, self.settings.shadow.resolution))

    def light(self, name: str) -> Light | AreaLight:
        """Record of a light of the scene."""
        return self.data.light(name)

    def curve_vertices(self, name: str, control_points: Any) -> Any:
        """World-space vertices of a `bsplinecurve` or `linearcurve` for ``vertex_positions`` of :meth:`render`.

        Args:
            name: of the curve.
            control_points: ``Float`` (4P,): x, y, z and radius of all its control points, in the curve's own space.

        Returns:
            ``Float`` (3V,), attached to the control points.

        Raises:
            ShadowmapError: there is no such curve; it has another number of control points.
        """
        return self.data.curve_vertices(name, control_points)

    def _replaced(self, lights: tuple[Any, ...], replacements: Mapping[str, Any] | None) -> tuple[Any, ...]:
        for name in replacements or ():
            old, new = self.data.light(name), replacements[name]
            if type(old) is not type(new):
                raise ShadowmapError(f"Light '{name}' is a {type(old).__name__}, not a {type(new).__name__}.")
        return tuple((replacements or {}).get(light.name, light) for light in lights)

    def _lighting(
        self, views: list[CameraView], geometry: Geometry, topology: Topology, replacements: Mapping[str, Any] | None
    ) -> Lighting:
        """All lights and their shadow maps."""
        data, settings = self.data, self.settings
        if not settings.lit:
            return Lighting((), None, data.areas, (), None)
        lights, areas = self._replaced(data.lights, replacements), self._replaced(data.areas, replacements)
        extended = (*areas, *data.environments)
        samples = tuple(samples_of(light, plan, geometry) for light, plan in zip(extended, self.soft, strict=True))
        maps = soft_maps = None
        if settings.shadow.method != "none" and (lights or samples):
            transparent, seen = self._transparent(geometry, views[0].sensor), self._seen(views, geometry)
            common = (geometry, topology)
            if lights:
                maps = make_maps(self.plan, lights, *common, settings.shadow, self.frusta, transparent, seen, self.outward)
                self.frusta = maps.frusta
            if samples:
                shadow = settings.soft_shadow
                soft_maps = make_soft_maps(self.soft, samples, self.plan, *common, shadow, self.soft_frusta, transparent, seen)
                self.soft_frusta = soft_maps.frusta
        return Lighting(lights, maps, areas, samples, soft_maps)

    def _seen(self, views: list[CameraView], geometry: Geometry) -> tuple[Any, Any]:
        """Points on what the cameras see, and which of them there are."""
        found = [seen_points(view.sensor, view.raster, geometry) for view in views]
        if len(found) == 1:
            return found[0]
        points = mi.Point3f(*(dr.concat([p[c] for p, _ in found]) for c in range(3)))
        return points, dr.concat([mi.Bool(hit) for _, hit in found])

    def _transparent(self, geometry: Geometry, camera: Sensor) -> Callable[[RasterOutput], Any] | None:
        """Alpha test for cameras and shadow maps (from whichever side); None where no material lets one look through."""
        if not any(info.see_through for info in geometry.shapes):
            return None

        def transparent(raster: RasterOutput) -> Any:
            return opacity(surface(self.data, geometry, camera, raster.triangle, raster.u, raster.v)) < 0.5

        return transparent

    def _view(self, sensor: Sensor, geometry: Geometry, topology: Topology, factor: int) -> CameraView:
        clip = camera_clip(sensor, geometry)
        if self._hidden():
            clip = without_shapes(clip, geometry, self._hidden())
        dr.eval(clip)
        size = (sensor.height * factor, sensor.width * factor)
        transparent = self._transparent(geometry, sensor)
        raster = visible_triangles(clip, geometry.faces, size, transparent=transparent)
        return CameraView(sensor, factor, clip, raster, topology)

    def _hidden(self) -> list[int]:
        """Shapes that cameras do not see."""
        return [light.shape for light in self.data.areas] if self.settings.hide_emitters else []

    def _topologies(self, geometry: Geometry) -> tuple[Topology, Topology]:
        """The topology of shapes where they are now: of those that cameras see, and of those that cast shadows."""
        casting, hidden, shape = self.topology, self._hidden(), geometry.vertex_shape
        points = dr.gather(mi.Point3f, dr.detach(geometry.positions), dr.arange(mi.UInt32, geometry.vertex_count))
        if not (geometry.as_loaded and geometry.positions is self.data.geometry.positions):
            casting = detach_moved_seams(casting, points, shape)
        return detach_moved_seams(self.topology, points, shape, hidden) if hidden else casting, casting

    def _surface(self, view: CameraView, geometry: Geometry, facets: Any, frames: bool) -> tuple[Surface, Any, Any]:
        """(what a camera sees, its depth as ``Hits.depth``, how much edges between facets still show or None for all)."""
        sensor, raster = view.sensor, view.raster
        hits = pixel_hits(geometry, sensor, raster.triangle, (raster.width, raster.height))
        hits = replace(hits, active=hits.active & within_far_plane(sensor, hits.depth))
        normals, sharpness = normals_at(geometry, hits), None
        if self.flat is not None:
            normals, sharpness = prefilter_normals(hits, normals, self.topology, facets[1])
        return surface_at(self.data, geometry, sensor, hits, *normals, frames=frames), hits.depth, sharpness

    def g_buffer(self, sensor: int = 0) -> GBuffer:
        """What a camera sees of the scene as it is, for those who shade it themselves again and again. Detached.

        Raises:
            ShadowmapError: there is no such sensor, or it has several cameras, or a reconstruction filter that is not a box.
        """
        with dr.suspend_grad():
            windows = sample_windows(self.data.cameras(sensor))
            if len(windows) != 1 or not windows[0].filter.is_box:
                raise ShadowmapError(f"sensor {sensor} is no single camera whose film has a box filter: use another one.")
            geometry = self.data.geometry.in_packets(windows[0].width * windows[0].height)
            facets = self._facets(geometry)
            view = self._view(windows[0], geometry, self._topologies(geometry)[0], 1)
            seen, depth, sharpness = self._surface(view, geometry, facets, self.data.needs_frames)
            size, samples = (view.raster.width, view.raster.height), self.settings.look_ups(view.columns)
            points = footprint_points(windows[0], size, depth, seen.p_world, seen.n_world, samples)
            crossings = None
            if self.settings.antialias:
                dr.eval(sharpness)
                crossings = find_crossings(
                    view.clip,
                    view.topology,
                    view.raster,
                    geometry.vertex_count,
                    crease_weights=sharpness,
                    meetings=True,
                    gap=least_gap(windows[0]),
                    **self._creases(geometry, facets),
                )
            return GBuffer(windows[0], seen, points, crossings, self._seen([view], geometry))

    def _facets(self, geometry: Geometry) -> Any:
        """(normals of flat faces, their sums at each place), None if there are none."""
        if self.flat is None:
            return None
        normals = facet_normals(geometry, self.flat)
        return dr.detach(normals), mean_normals(normals, self.topology, self.flat)

    def _creases(self, geometry: Geometry, facets: Any) -> dict[str, Any]:
        """Edges at which shading jumps, if images are anti-aliased and there are any, as arguments of ``find_crossings``."""
        if self.creases is None or not self.settings.antialias:
            return {}
        return {"creases": self.creases.now(geometry), "folds": self.creases.folds_of(facets and facets[0])}

    def _camera_image(self, view: CameraView, lighting: Lighting, geometry: Geometry, facets: Any, creases: Any) -> Any:
        sensor, raster = view.sensor, view.raster
        height, width = raster.height, raster.width
        textured = any(light.textured for light in lighting.areas)
        frames = self.data.needs_frames or self.settings.ambient > 0 or textured
        seen, depth, sharpness = self._surface(view, geometry, facets, frames)
        around = lambda: footprint_points(sensor, (width, height), depth, seen.p_world, seen.n_world, 2)  # noqa: E731
        compat = self.settings.shadow.compat
        looped, written = self._in_tables(lighting, seen, view, depth, around)
        lighting = replace(lighting, lights=tuple(lighting.lights[k] for k in written))
        lights = lighting.lights
        visible = self._visibilities(lighting, written, seen, view, depth)
        shining = [SquareSpot(light) if compat and isinstance(light, SpotLight) else light for light in lights]
        lighting = replace(lighting, lights=softened(shining, seen.p_world, around))
        color = looped + self._radiance(seen, lighting, visible, sensor, raster)
        channels = film_channels(color, seen.active & (self.settings.max_depth != 0), sensor)
        named = collect_aovs(self.settings.aovs, seen, raster, lights, visible)
        if self.settings.antialias:
            # In one pass over the pixels, since both need much of the same.
            dr.eval(channels, sharpness)
            flat = antialias(
                *(channels, raster, view.clip, view.topology),
                **creases,
                crease_weights=sharpness,
                meetings=True,
                gap=least_gap(sensor),
                continued=True,
            )
            image = mi.TensorXf(flat, shape=(height, width, len(channels)))
        else:
            image = mi.TensorXf(interleave(channels), shape=(height, width, len(channels)))
        if named:
            image = dr.concat([image, mi.TensorXf(interleave(named), shape=(height, width, len(named)))], axis=2)
        return image

    def _in_tables(
        self, lighting: Lighting, seen: Surface, view: CameraView, depth: Any, around: Callable[[], list[Any]]
    ) -> tuple[Any, list[int]]:
        """(radiance of lights of kinds of which there are many, numbers of the other lights)."""
        every = list(range(len(lighting.lights)))
        if len(every) < MANY_LIGHTS or self.settings.shadow.compat or self.settings.aovs:
            return 0, every
        spots = FootprintSamples([seen.p_world], seen.active, 1) if lighting.maps is None else self._spots(seen, view, depth)
        if spots.copies > 1:  # they are lanes of their own
            return 0, every
        return many_lights(seen, lighting.lights, self.plan, lighting.maps, spots.points, around, self.data.materials())

    def _spots(self, seen: Surface, view: CameraView, depth: Any) -> FootprintSamples:
        size, count = (view.raster.width, view.raster.height), self.settings.look_ups(view.columns)
        return FootprintSamples.of(view.sensor, size, depth, seen.p_world, seen.n_world, seen.active, count)

    def _visibilities(self, lighting: Lighting, numbers: list[int], seen: Surface, view: CameraView, depth: Any) -> list[Any]:
        """Of each light, from all pixels. ``numbers``: of the lights in the plan."""
        maps = lighting.maps
        if maps is None or not numbers:
            return [mi.Float(1) for _ in lighting.lights]
        spots, lights = self._spots(seen, view, depth), zip(numbers, lighting.lights, strict=True)
        return [spots.mean(partial(light_visibility, maps, self.plan, light, index)) for index, light in lights]

    def _radiance(self, seen: Surface, lighting: Lighting, visible: list[Any], sensor: Sensor, raster: RasterOutput) -> Any:
        compat = self.settings.shadow.compat
        color = dr.zeros(mi.UnpolarizedSpectrum, dr.width(seen.shape))
        nodes = self.data.materials()
        for light, fraction in zip(lighting.lights, visible, strict=True):
            color += direct_light(seen, light, fraction, nodes, gate=not compat)
        soft = self.soft if self.settings.lit else ()
        for plan, samples in zip(soft, lighting.samples, strict=True):
            color += soft_light(seen, plan, samples, lighting.soft_maps, nodes, gate=not compat)
        for uniform in self._uniform_ambient():
            color += ambient_light(seen, uniform, _AMBIENT_DIRECTIONS, nodes)
        if not self.settings.hide_emitters and self.settings.max_depth != 0:
            color += emission(seen, lighting.areas)
            for environment in self.data.environments:
                sky = background(environment, sensor, raster.width, raster.height)
                color = dr.select(seen.active, color, sky)
        return color

    def _uniform_ambient(self) -> tuple[Any, ...]:
        return (UniformRadiance(self.settings.ambient),) if self.settings.ambient > 0 and self.settings.lit else ()
