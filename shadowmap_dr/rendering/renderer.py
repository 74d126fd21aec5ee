"""The passes in order: shadow maps, G-buffer, shading, anti-aliasing. The functional path, and the core of the plug-in."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError, warn
from ..jit.call_data import rewrite_scalars
from ..jit.frozen import take_apart
from ..jit.gpu import keep_registers
from ..jit.kernel_cache import note_size
from ..jit.kernel_inputs import shared_inputs
from ..jit.pytree import attached_arrays, tree_map
from ..jit.types import Bool, Float, Point3f, TensorXf
from ..raster import Topology, build_topology, outward_faces
from ..scene.geometry import Geometry
from ..scene.lights.area import AreaLight
from ..scene.lights.read import Light
from ..scene.load import SceneData, load, refresh
from ..scene.origin import SceneOrigin
from ..scene.sensor import Sensor
from ..scene.untracked import UntrackedState
from ..shadow import Frusta
from .extended_lights import SoftFrusta, SoftPlan
from .film.film import Margin, check_samples, develop, sample_grid, sample_windows
from .gbuffer.camera_view import CameraPass, CameraView, GBuffer, PlacedShapes
from .gbuffer.facet_normals import FlatFaces, flat_faces
from .gbuffer.pixel_footprint import footprint_points
from .gbuffer.shading_edges import ShadingEdges
from .gbuffer.translucency import Translucency
from .image_pass import ImagePass
from .light_pass import Lighting, LightPass, plan_extended_lights
from .light_slices import LightSlice, plan_slices
from .light_tiles import texel_density, with_tiles
from .pass_cache import CacheLevel, PassCache
from .settings import RenderSettings
from .shadow_pass import MapPlan, check_sizes, plan_maps


@dataclass
class Renderer:
    """Renders one scene again and again, with other vertices, lights or cameras.

    A PyTree: pass it to functions decorated with ``dr.freeze``. A step touches neither Mitsuba's meshes nor its acceleration
    structures. The only state is the fit of the shadow maps (``frusta``, ``soft_frusta``). It stays the same while casters move
    within it.

    Attributes:
        data: records of the scene.
        topology: edges of the merged mesh.
        plan: shadow maps of lights without extent.
        settings: settings of the rendering.
        flat: faces that are shaded flat, or None.
        creases: edges of faces at which shading jumps. Attributes and textures of meshes count as they were when the scene was
            read.
        outward: ``Bool`` (F,), faces that shadow maps show from the front only, or None.
        soft: samples of extended lights (area lights, environments), and the shadow maps of the samples.
        frusta: fit of the shadow maps in the last rendering, None before the first. ``soft_frusta``: for extended lights.
        untracked: parameters of the scene that recordings do not see, or None if the caller watches them.
        slices: of the lights, whose shadow maps are in memory one slice after the other; none if all fit together.
        translucency: surfaces that let light through, None if all are opaque.
        origin: file or dictionary of the scene, None if the scene was given.

    ``copy.deepcopy`` shares the scene, which Mitsuba cannot copy, and all records; the copy has a fit of its own. ``pickle``
    works for renderers of :meth:`from_file` and :meth:`from_dict`: it stores the file's name or the dictionary, the settings and
    the fit, and loads the scene again. Parameters that were changed since then are not stored.
    """

    data: SceneData
    topology: Topology
    plan: MapPlan
    settings: RenderSettings
    flat: FlatFaces | None = None
    creases: ShadingEdges | None = None
    outward: Bool | None = None
    soft: tuple[SoftPlan, ...] = ()
    frusta: Frusta | None = None
    soft_frusta: SoftFrusta = (None, None)
    untracked: UntrackedState | None = None
    slices: tuple[LightSlice, ...] = ()
    translucency: Translucency | None = None
    origin: SceneOrigin | None = None

    # All that Dr.Jit is to know of, instead of the fields: see ``frozen``.
    DRJIT_STRUCT: ClassVar[dict[str, type]] = {"recording_parts": tuple}

    @property
    def recording_parts(self) -> tuple[str, list[Any]]:
        """(text of everything that a recording depends on, arrays and objects of Mitsuba's). ``dr.freeze`` reads it."""
        return take_apart([getattr(self, part.name) for part in fields(self)])

    @classmethod
    def from_scene(cls, scene: mi.Scene, *, tessellation: int = 64, **settings: object) -> Renderer:
        """Build a renderer for a ``mi.Scene``.

        The scene's meshes are read now, for the last time.

        Args:
            scene: the ``mi.Scene``.
            tessellation: number of triangles around spheres, disks and cylinders.
            settings: by the names of the plug-in's parameters (``help(shadowmap_dr.integrator.options.Options)``): fields of
                :class:`RenderSettings`, and ``shadow_map_resolution``, ``shadow_method``, ... for those of
                :class:`~shadowmap_dr.shadow.ShadowSettings`.

        Raises:
            ShadowmapError: the scene has parts that are not supported, by name; a setting is unknown or invalid.
        """
        chosen = RenderSettings.of(**settings)
        return cls.from_data(load(scene, tessellation=tessellation), chosen)

    @classmethod
    def from_file(
        cls,
        path: str | os.PathLike[str],
        parameters: Mapping[str, str] | None = None,
        *,
        tessellation: int = 64,
        **settings: object,
    ) -> Renderer:
        """Build a renderer for a scene file. Shapes keep their names (``optimize=False``).

        Args:
            path: the scene file.
            parameters: values of ``$name`` in the file, by name.
            tessellation, settings: as for :meth:`from_scene`.

        Raises:
            ShadowmapError: the file cannot be loaded; otherwise as :meth:`from_scene`.
        """
        return cls._of_origin(SceneOrigin(path, None, parameters, tessellation), settings)

    @classmethod
    def from_dict(cls, description: Mapping[str, Any], *, tessellation: int = 64, **settings: object) -> Renderer:
        """Build a renderer for a dictionary that describes a scene (``mi.load_dict``). Otherwise as :meth:`from_file`."""
        return cls._of_origin(SceneOrigin(None, description, None, tessellation), settings)

    @classmethod
    def _of_origin(cls, origin: SceneOrigin, settings: Mapping[str, object]) -> Renderer:
        renderer = cls.from_scene(origin.load(), tessellation=origin.tessellation, **settings)
        renderer.origin = origin
        return renderer

    def __copy__(self) -> Renderer:
        return replace(self)

    def __deepcopy__(self, memo: dict[int, object]) -> Renderer:
        fits = tree_map((self.frusta, self.soft_frusta), lambda array: type(array)(array))
        return replace(self, frusta=fits[0], soft_frusta=fits[1])

    def __reduce__(self) -> tuple[Callable[..., Renderer], tuple[object, ...]]:
        if self.origin is None:
            raise ShadowmapError(
                "Renderer: Mitsuba's scenes cannot be pickled; make the renderer by Renderer.from_file or Renderer.from_dict."
            )
        return _loaded_again, (self.origin, self.settings, self.frusta, self.soft_frusta)

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
        plan, creases = plan_maps(data.lights, geometry, data.materials), ShadingEdges.of(geometry, topology, data.sources)
        soft = plan_extended_lights(data, settings)
        if settings.shadow.method != "none":
            texels = settings.shadow.resolution * settings.shadow.supersampling
            check_sizes(plan.maps, texels, geometry, "lights", "lower shadow_map_resolution, or leave out lights")
        outward = mi.Bool(outward_faces(topology, positions.reshape(-1, 3))) if settings.shadow.cull_backfaces else None
        slices = plan_slices(data, plan, soft, settings)
        renderer = cls(data, topology, plan, settings, flat_faces(geometry, topology), creases, outward, soft, slices=slices)
        renderer.translucency = Translucency.of(data, positions.reshape(-1, 3), _layers_of(settings))
        renderer.untracked = UntrackedState((*data.scene.emitters(), *data.materials))
        # The first fit is made here, so that a step which is recorded later always starts from one.
        return renderer.with_maps_for() if data.sensors else renderer

    def with_maps_for(self, samples: int | None = None, *, spp: int = 1) -> Renderer:
        """The same renderer with as many maps of each light as images of so many samples are worth, fitted to its first sensor.

        Args:
            samples: of an image; None for images of the first sensor with ``spp`` samples of a pixel.
            spp: samples of a pixel.
        """
        data, plan = self.data, self.plan.undivided
        made = replace(self, plan=plan, slices=plan_slices(data, plan, self.soft, self.settings))
        with dr.suspend_grad():
            cameras = made.camera_pass
            shapes = cameras.placed(data.geometry)
            views = [cameras.view(camera, shapes, 1) for camera in sample_windows(data.sensors[0])]
            seen, pixels = cameras.seen(views, data.geometry), _pixels(data.sensors[0])
            made.frusta, made.soft_frusta = made.light_pass.for_image(pixels).fit(shapes, seen)
            undivided = made.frusta
            samples = samples or spp * sum(view.size.width * view.size.height for view in views)
            plan = with_tiles(plan, data, self.settings, made.frusta, seen, samples, made.light_pass.layers)
            if plan.maps > made.plan.maps:
                made.plan, made.slices = plan, plan_slices(data, plan, self.soft, self.settings)
                made.frusta, made.soft_frusta = made.light_pass.for_image(pixels).fit(shapes, seen)
            if made.translucency is not None:
                bare = [replace(view, layers=None) for view in views]
                density = texel_density(
                    self.plan.undivided, data, self.settings.shadow, undivided, cameras.seen(bare, data.geometry)
                )
                made.translucency = replace(made.translucency, texel_density=density)
                others = [cameras.view(camera, shapes, 1) for each in data.sensors[1:] for camera in sample_windows(each)]
                pictures = [(view.clip, view.raster) for view in (*views, *others)]
                maps = made.light_pass.for_image(pixels).map_vertices(shapes.geometry, (made.frusta, made.soft_frusta))
                camera = data.sensors[0][0]
                made.translucency = made.translucency.counted(data, shapes.geometry, camera, pictures, maps)
                made.slices = made.light_pass.for_image(pixels).slices
        return made

    def with_data(self, data: SceneData) -> Renderer:
        """The same renderer for re-read records (:func:`shadowmap_dr.scene.load.refresh`) of the same scene."""
        return replace(self, data=data)

    def with_replanned_lights(self) -> Renderer:
        """The same renderer with area lights and environments divided, and their maps aimed, as its records are now."""
        soft = plan_extended_lights(self.data, self.settings)
        slices = plan_slices(self.data, self.plan, soft, self.settings)
        return replace(self, soft=soft, soft_frusta=(None, None), slices=slices)

    @property
    def texels(self) -> int:
        """Most texels of all shadow maps, in large images, before supersampled maps are averaged."""
        if self.settings.shadow.method == "none":
            return 0
        side = self.settings.shadow.resolution * self.settings.shadow.supersampling
        return self.plan.maps * side**2 + sum(plan.maps for plan in self.soft) * self.settings.soft_map_resolution**2

    @property
    def is_one_pass(self) -> bool:
        """True if an image and its derivatives need each shadow map once, and all of them together."""
        return not self.slices

    def with_updated_shading_edges(self) -> Renderer:
        """The same renderer with the edges at which colours of meshes jump, found again."""
        sources = self.data.sources
        return replace(self, creases=self.creases and self.creases.with_colours(self.data.geometry, sources))

    def refresh(self) -> Renderer:
        """The same renderer with the scene's current vertices, lights and sensors, attached where they carry gradients.

        Raises:
            ShadowmapError: in a function that is being frozen, which would keep what it reads of the scene now.
        """
        if dr.flag(dr.JitFlag.FreezingScope):
            raise ShadowmapError("refresh(): a frozen function does not read the scene; call it before, and pass the renderer.")
        return self.with_data(refresh(self.data))

    @shared_inputs()
    def render(
        self,
        vertex_positions: Mapping[str, Any] | None = None,
        lights: Mapping[str, Light] | None = None,
        sensor: int | Sensor = 0,
        spp: int = 1,
        cache: PassCache | None = None,
        transforms: Mapping[str, Any] | None = None,
    ) -> TensorXf:
        """Render an image.

        Args:
            vertex_positions: new world-space vertices by the name of their shape: ``Float`` (3V,), tensor (V, 3) or ``Point3f``.
            lights: new records by the name of the light (start from ``renderer.light(name)`` and ``dataclasses.replace``).
            sensor: number of the scene's sensor, or a camera record.
            spp: samples per pixel, rounded up to a square grid: 5 are 3 x 3. More than 16 x 16, or than 4096 along the longer
                side of the image, are lowered to these. Each sample is anti-aliased.
            cache: results of earlier passes that still hold, with the same ``spp``, for the scene as it is. The image leaves its
                own there. Only without ``vertex_positions``, ``transforms`` and ``lights``, and not in recordings.
            transforms: affine maps of world space, ``Transform4f`` or ``Matrix4f``, by the name of the shape that they move.
                Vertex normals move along, whereas those of ``vertex_positions`` are computed from the new vertices. New vertices
                of shapes that have both are moved. A map that mirrors turns a shape inside out, as mirrored vertices do.

        Returns:
            ``mi.TensorXf`` (H, W, C): linear colour (1 or 3 channels, as the film), then alpha if the film has it, then the AOVs.
            Colour and alpha have passed through the film's reconstruction filter.
            Attached to vertices, lights, cameras, and the BSDFs and textures of the scene.
        """
        keep_registers()
        check_samples(spp)
        self.note_kernels(spp, sensor)
        cameras, geometry = self.data.cameras(sensor), self.data.geometry
        rewrite_scalars(self.data.materials)
        if vertex_positions is not None:
            geometry = geometry.with_positions(vertex_positions)
            _warn_of_lost_vertices(geometry, vertex_positions)
        if transforms is not None:
            geometry = geometry.with_transforms(transforms)
        windows = sample_windows(cameras)
        factor = sample_grid(spp, windows)
        margin = Margin.of(cameras, factor) if self.settings.antialias else Margin()
        cache = cache or PassCache()
        attached = self.translucency is not None and (
            self.translucency.attached(geometry) or bool(attached_arrays((lights, self.data.lights, self.data.areas)))
        )
        light = self.light_pass.for_image(_pixels(cameras), factor**2, attached)
        if light.slices:
            cache.keep(min(cache.level, CacheLevel.VIEW))  # maps of lights in slices are not kept
        images = ImagePass(self.camera_pass, light)
        samples = max(window.width * window.height for window in windows) * factor**2
        views: Sequence[CameraView] = cache.views
        lighting, shapes = None, cache.shapes
        if shapes is None:
            # Before all else that is attached: derivatives are taken in the reverse order, and pixels should need one pass only.
            shapes = images.cameras.placed(geometry.in_packets(samples))
        if cache.lit:
            images.fill_crossings(cache, shapes, cache.lit)
        else:
            views = views or [images.cameras.view(margin.around(window), shapes, factor) for window in windows]
            if cache.maps is None:
                lighting = self._lighting(light, views, shapes, lights).for_points(samples)
            else:
                lighting = images.light.relit(cache.maps, shapes.geometry)
            images.fill(cache, shapes, views, lighting)
        crossings = cache.crossings or (None,) * len(windows)
        if cache.lit:
            pictures = [images.coloured_image(*each) for each in zip(cache.lit, crossings, strict=True)]
        else:
            assert lighting is not None, "made above where surfaces are to be lit"
            visible = cache.visible or (None,) * len(views)
            pictures = [images.image(*each, lighting, shapes) for each in zip(views, crossings, visible, strict=True)]
        return develop([margin.cut(picture, factor) for picture in pictures], windows[0], factor)

    def note_kernels(self, spp: int, sensor: int | Sensor = 0) -> None:
        """Let kernels of other image sizes go, if there were many. Call before an image is rendered."""
        cameras = self.data.cameras(sensor)
        sizes = [(camera.film_size, camera.crop_size, camera.crop_offset) for camera in cameras]
        note_size((*sizes, spp, self.settings.shadow.resolution))

    def light(self, name: str) -> Light | AreaLight:
        """Record of a light of the scene."""
        return self.data.light(name)

    def vertices(self, name: str) -> Point3f:
        """World-space vertices of a shape, Point3f (Vs,), detached: as the scene has them, or had them at the last ``refresh``.

        Raises:
            ShadowmapError: The scene has no such shape.
        """
        return mi.Point3f(dr.detach(self.data.geometry.shape_positions(name)))

    def curve_vertices(self, name: str, control_points: Float) -> Float:
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

    @property
    def camera_pass(self) -> CameraPass:
        """The pass that renders visible surfaces."""
        hidden = tuple(light.shape for light in self.data.areas) if self.settings.hide_emitters else ()
        creases = self.creases if self.settings.antialias else None
        return CameraPass(self.data, self.topology, self.flat, creases, hidden, self.translucency)

    @property
    def light_pass(self) -> LightPass:
        """The pass that renders shadow maps and light."""
        made = LightPass(self.data, self.settings, self.plan, self.soft, self.outward, self.slices)
        translucent = self.translucency
        if translucent is None or translucent.faces is None:
            return made
        return replace(made, texel_density=translucent.texel_density, layers=translucent.maps.layers)

    def _lighting(
        self, light: LightPass, views: Sequence[CameraView], shapes: PlacedShapes, replacements: Mapping[str, Any] | None
    ) -> Lighting:
        """All lights and their shadow maps."""
        cameras, fits = self.camera_pass, (self.frusta, self.soft_frusta)
        seen = partial(cameras.seen, views, shapes.geometry)
        lighting = light.lighting(shapes, replacements, fits, cameras.casters(shapes, views[0].sensor), seen)
        frusta, soft_frusta = lighting.fits
        if frusta is not None:
            self.frusta = frusta
        if soft_frusta != (None, None):
            self.soft_frusta = soft_frusta
        return lighting

    def g_buffer(self, sensor: int = 0) -> GBuffer:
        """Opaque surfaces of the current scene that a camera sees, for callers who shade them themselves. Detached.

        Raises:
            ShadowmapError: there is no such sensor, or it has several cameras, or a reconstruction filter that is not a box.
        """
        with dr.suspend_grad():
            windows = sample_windows(self.data.cameras(sensor))
            if len(windows) != 1 or not windows[0].filter.is_box:
                raise ShadowmapError(f"sensor {sensor} is no single camera whose film has a box filter: use another one.")
            geometry = self.data.geometry.in_packets(windows[0].width * windows[0].height)
            cameras = self.camera_pass
            shapes = cameras.placed(geometry)
            view = cameras.view(windows[0], shapes, 1)
            frame = cameras.frame(view, shapes, self.data.needs_frames)
            seen, samples = frame.surface, self.settings.look_ups(view.columns)
            points = footprint_points(windows[0], view.size, frame.depth, seen.p_world, seen.n_world, samples)
            crossings = cameras.crossings(view, frame.sharpness, shapes) if self.settings.antialias else None
            return GBuffer(windows[0], seen, points, crossings, cameras.seen([view], geometry))


def _pixels(cameras: Sequence[Sensor]) -> int:
    """Pixels of all cameras."""
    return sum(camera.width * camera.height for camera in cameras)


def _layers_of(settings: RenderSettings) -> int | None:
    """Number of translucent layers that was asked for, None for as many as there are."""
    return settings.translucent_layers if isinstance(settings.translucent_layers, int) else None


def _loaded_again(origin: SceneOrigin, settings: RenderSettings, frusta: Frusta | None, soft_frusta: SoftFrusta) -> Renderer:
    """The renderer that was pickled."""
    renderer = Renderer.from_data(load(origin.load(), tessellation=origin.tessellation, warn=False), settings)
    return replace(renderer, origin=origin, frusta=frusta, soft_frusta=soft_frusta)


def _warn_of_lost_vertices(geometry: Geometry, names: Iterable[str]) -> None:
    """Name the shapes that have vertices that are not finite: their triangles are left out. Reads back; not in recordings."""
    if dr.flag(dr.JitFlag.FreezingScope) or dr.flag(dr.JitFlag.SymbolicScope):
        return
    with dr.suspend_grad():
        good = dr.isfinite(dr.detach(geometry.positions))
        if dr.all(good):
            return
        finite = np.asarray(good.numpy().reshape(-1, 3).all(1))
    for name in names:
        info = geometry.shape(name)
        lost = int(np.count_nonzero(~finite[info.vertex_start : info.vertex_start + info.vertex_count]))
        if lost:
            count = f"{lost} of {info.vertex_count} vertices of shape '{info.name}'"
            warn(f"{count} are not finite (NaN or infinite): the triangles at these are left out.")
