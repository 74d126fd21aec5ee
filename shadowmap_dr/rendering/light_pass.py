"""The light pass: shadow maps of all lights of a scene, and the light that surfaces send towards a camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import ShadowmapError
from ..jit.broadcast import broadcast_differentiable
from ..jit.checkpoint import Term, checkpointed_sum
from ..jit.handover import stored
from ..jit.types import AnyArray, Bool, Color3f, Float, PyTree
from ..jit.vectors import mean_of
from ..scene.geometry import Geometry
from ..scene.lights.area import AreaLight
from ..scene.lights.environment import UniformRadiance
from ..scene.lights.punctual import SpotLight, SquareSpot
from ..scene.lights.read import Light
from ..scene.lights.soft_outline import softened
from ..scene.load import SceneData
from ..scene.sensor import ImageSize, Sensor
from ..scene.sums import attached_parameters
from ..shadow import Frusta, ShadowMaps, ShadowSettings, TranslucentCasters
from .direct_light import ambient_light, background, direct_light, emission
from .extended_lights import (
    LightSamples,
    SoftFrusta,
    SoftLight,
    SoftMaps,
    SoftPlan,
    check_soft_sizes,
    fit_soft_maps,
    interleaving_of,
    make_soft_maps,
    plan_soft,
    sample_visibilities,
    samples_of,
    soft_light,
    soft_map_vertices,
)
from .extended_lights.interleaving import Interleaving
from .extended_lights.sample_counts import MOST
from .gbuffer.camera_view import CameraView, Frame, PlacedShapes, VisiblePoints
from .gbuffer.pixel_footprint import FootprintSamples, footprint_points, footprints
from .gbuffer.surface import Surface
from .light_colours import white_area_light, white_light
from .light_loops import MANY_LIGHTS, many_lights
from .light_slices import LightSlice, TexelLayers, joined_fits, plan_slices, shining_objects
from .light_tiles import sized, with_transmittance
from .settings import RenderSettings
from .shadow_pass import MapPlan, arriving_light, fit_maps, light_through, make_maps, map_vertices, visibility_of

# Directions over which the light of environments is summed.
_AMBIENT_DIRECTIONS = 16
#: Mask of the opaque faces (Bool, F), and the casters that are not opaque; None each without such casters.
Casters = tuple[Bool | None, TranslucentCasters | None]


@dataclass(frozen=True)
class Lighting:
    """The lights of one rendering and their shadow maps, or None without maps.

    ``sliced``: with lights in slices, their fits, and the function that makes the lighting of a slice; there are no maps then.
    ``lanes``: lights with numbers for each lane, see :meth:`in_lanes`.
    """

    lights: tuple[Light, ...]
    maps: ShadowMaps | None
    areas: tuple[AreaLight, ...]
    samples: tuple[LightSamples, ...]
    soft_maps: SoftMaps | None
    sliced: SlicedLighting | None = None
    lanes: tuple[Light, ...] | None = None

    @property
    def wide(self) -> tuple[Light, ...]:
        """The lights with numbers for each lane (:meth:`in_lanes`), or the lights themselves."""
        return self.lights if self.lanes is None else self.lanes

    @property
    def fits(self) -> tuple[Frusta | None, SoftFrusta]:
        """The fit of the maps."""
        if self.sliced is not None:
            return joined_fits(self.sliced.fits)
        frusta = None if self.maps is None else self.maps.frusta
        return frusta, (None, None) if self.soft_maps is None else self.soft_maps.frusta

    def for_points(self, count: int) -> Lighting:
        """The same maps, prepared for look-ups by this many points (:meth:`~shadowmap_dr.shadow.ShadowMaps.for_points`)."""
        if self.sliced is not None:
            return replace(self, sliced=replace(self.sliced, points=count))
        return self if self.maps is None else replace(self, maps=self.maps.for_points(count))

    def in_lanes(self, count: int) -> Lighting:
        """The same lights, prepared for ``count`` lanes that are computed from now on.

        Later, the backward pass would compute the lanes twice: for the sums of gradients to the lights' numbers, and for others.
        """
        if self.sliced is not None or len(self.lights) >= MANY_LIGHTS:
            return self
        return replace(self, lanes=broadcast_differentiable(self.lights, count))


@dataclass(frozen=True)
class SlicedLighting:
    """The lights of one rendering in slices.

    Attributes:
        fits: of the maps of each slice.
        casters, seen: as for :meth:`LightPass.lighting`.
        points: number of points that look the maps up, see :meth:`Lighting.for_points`.
    """

    fits: list[tuple[Frusta | None, SoftFrusta]]
    casters: Casters
    seen: VisiblePoints
    points: int = 1


@dataclass(frozen=True)
class Visibilities:
    """Visibility of lights from the samples of a camera, N of them. Detached.

    Attributes:
        lights: ``Float`` (N,) of each light without extent.
        parts: for each extended light ``Float`` (K N,), all pixels for its first sample, then for the second, ..., or None.
    """

    lights: list[Any]
    parts: tuple[Any, ...]


@dataclass(frozen=True)
class IncidentLight:
    """The light that reaches the samples of a frame, N of them.

    Attributes:
        lights: lights that are added one by one, with soft outlines.
        visible: visibility of each of these lights, ``Float`` (N,), or a colour (N,) with translucent casters.
        looped: radiance (colour, N) towards the camera from all other lights without extent, or 0.
        parts: see :attr:`Visibilities.parts`; None: look visibility up in the maps.
        kept: whether values are :func:`~shadowmap_dr.jit.handover.stored` for derivatives.
    """

    lights: tuple[Any, ...]
    visible: Sequence[Float | Color3f]
    looped: Color3f | int
    parts: tuple[Any, ...]
    kept: bool = False

    def stored(self) -> IncidentLight:
        """The same light, of which derivatives read the visibilities that the image has found."""
        return replace(self, visible=stored("visibilities", list(self.visible)), kept=True)


@dataclass(frozen=True)
class LightPass:
    """Shadow maps of all lights, and the light that reaches surfaces.

    Attributes:
        data: records of the scene.
        settings: settings of the rendering.
        plan: shadow maps of lights without extent.
        soft: samples of extended lights, and the shadow maps of the samples.
        outward: ``Bool`` (F,), faces that shadow maps show from the front only, or None.
        slices: slices of the lights, whose maps are in memory one after the other; none if all fit together.
        shadow: settings of the maps of lights without extent, None for those of ``settings``.
        texel_density: of transmittance maps (:func:`~.light_tiles.texel_density`), None without translucent casters.
        layers: number of translucent layers of a texel, 0 without translucent casters.
    """

    data: SceneData
    settings: RenderSettings
    plan: MapPlan
    soft: tuple[SoftPlan, ...]
    outward: Bool | None
    slices: tuple[LightSlice, ...] = ()
    shadow: ShadowSettings | None = None
    texel_density: float | None = None
    layers: int = 0

    def for_image(self, pixels: int, spp: int = 1, attached: bool = False) -> LightPass:
        """The same pass with maps as large as images of so many pixels, with ``spp`` samples each, need.

        ``attached``: True if transmittance maps carry gradients.
        """
        shadow = sized(self.settings.shadow, self.plan, pixels)
        if self.texel_density is not None:
            shadow = with_transmittance(self.settings, shadow, pixels * spp, self.texel_density)
        slices = self.slices
        # Slices were planned for larger maps, but without translucent layers.
        if self.layers or (slices and shadow is not self.settings.shadow):
            layers = TexelLayers(self.layers, attached)
            slices = plan_slices(self.data, self.plan, self.soft, self.settings, shadow, layers)
        return replace(self, shadow=shadow, slices=slices)

    @property
    def _maps(self) -> ShadowSettings:
        """Settings of the maps of lights without extent."""
        return self.shadow or self.settings.shadow

    @property
    def needs_frames(self) -> bool:
        """True if light has to know tangents and texture coordinates of surfaces."""
        textured = any(light.textured for light in self.data.areas)
        return self.data.needs_frames or self.settings.ambient > 0 or textured

    def lighting(
        self,
        shapes: PlacedShapes,
        replacements: Mapping[str, Any] | None,
        fits: tuple[Frusta | None, SoftFrusta],
        casters: Casters,
        seen: Callable[[], VisiblePoints],
    ) -> Lighting:
        """All lights and their shadow maps.

        Args:
            shapes: where they are now.
            replacements: records of lights, by name, that replace those of the scene.
            fits: fit of the shadow maps, and of the maps of extended lights, in an earlier rendering.
            casters: mask of the opaque faces, and the other casters, None each without any.
            seen: returns points on visible surfaces, see :meth:`CameraPass.seen`.
        """
        data, settings = self.data, self.settings
        if not settings.lit:
            return Lighting((), None, data.areas, (), None)
        lights, areas = self._replaced(data.lights, replacements), self._replaced(data.areas, replacements)
        if self.slices:
            points = seen()
            made = [self._part(one, lights, areas).fit(shapes, points, one.fits(fits)) for one in self.slices]
            return Lighting(lights, None, areas, (), None, SlicedLighting(made, casters, points))
        samples = self._samples(areas, shapes.geometry)
        maps = soft_maps = None
        if settings.shadow.method != "none" and (lights or samples):
            points, common = seen(), (shapes.geometry, shapes.casting)
            if lights:
                maps = make_maps(self.plan, lights, *common, self._maps, fits[0], points, self.outward, *casters)
            if samples:
                shadow = settings.soft_shadow
                soft_maps = make_soft_maps(self.soft, samples, self.plan, *common, shadow, fits[1], points, *casters)
        return Lighting(lights, maps, areas, samples, soft_maps)

    def fit(
        self, shapes: PlacedShapes, seen: VisiblePoints, previous: tuple[Frusta | None, SoftFrusta] = (None, (None, None))
    ) -> tuple[Frusta | None, SoftFrusta]:
        """Fit the maps of all lights. ``previous``: an earlier fit; others as of :meth:`lighting`. Detached."""
        data, settings, geometry = self.data, self.settings, shapes.geometry
        if not settings.lit or settings.shadow.method == "none":
            return None, (None, None)
        if self.slices:
            parts = (self._part(one, data.lights, data.areas) for one in self.slices)
            return joined_fits([part.fit(shapes, seen, one.fits(previous)) for part, one in zip(parts, self.slices, strict=True)])
        with dr.suspend_grad():
            samples = self._samples(data.areas, geometry)
            frusta: Frusta | None = None
            soft: SoftFrusta = (None, None)
            if data.lights:
                frusta = fit_maps(self.plan, data.lights, geometry, self._maps, previous[0], seen)
            if samples:
                soft = fit_soft_maps(self.soft, samples, self.plan, geometry, settings.soft_shadow, previous[1], seen)
            dr.eval(frusta, soft)
            return frusta, soft

    def map_vertices(self, geometry: Geometry, fits: tuple[Frusta | None, SoftFrusta]) -> list[tuple[Float, int, int]]:
        """(clip-space vertices of all maps, texels along each side, number of maps) of each kind of maps. Detached.

        ``fits``: as :meth:`fit` returns them. With lights in slices, of the first slice.
        """
        data, settings = self.data, self.settings
        if not settings.lit or settings.shadow.method == "none":
            return []
        if self.slices:
            first = self.slices[0]
            return self._part(first, data.lights, data.areas).map_vertices(geometry, first.fits(fits))
        found = []
        if fits[0] is not None:
            found.append(map_vertices(self.plan, data.lights, geometry, self._maps, fits[0]))
        return found + soft_map_vertices(self.soft, self._samples(data.areas, geometry), geometry, settings.soft_shadow, fits[1])

    def _part(self, chosen: LightSlice, lights: Sequence[Light], areas: Sequence[AreaLight]) -> LightPass:
        """The light pass of a slice alone. ``lights``, ``areas``: current records of all lights."""
        data, soft = chosen.data(self.data, lights, areas), chosen.soft_plans(self.soft)
        return replace(self, data=data, plan=self.plan.part(*chosen.lights), soft=soft, slices=())

    def reflected_in_slices(self, frame: Frame, lighting: Lighting, shapes: PlacedShapes) -> tuple[Color3f, list[Float]]:
        """(:meth:`reflected` radiance (colour, N) of all lights; visibility (Float, N) of each light without extent), for lights
        in slices. Attached to frame, lights, shapes, materials and emitters; derivatives make the maps again."""
        sliced = lighting.sliced
        assert sliced is not None, "asked for lights in slices only"

        def term(number: int, tree: PyTree) -> Term:
            frame, lights, areas, shapes = tree
            part = self._part(self.slices[number], lights, areas)
            lit = part.lighting(shapes, None, sliced.fits[number], sliced.casters, lambda: sliced.seen)
            lit = lit.for_points(sliced.points)
            incident = part.incident_light(frame, lit)
            value = mi.UnpolarizedSpectrum(part.reflected(frame, lit, incident))
            visible: list[AnyArray] = [mean_of(one) for one in incident.visible] if self.settings.aovs else []
            return [value[k] for k in range(dr.size_v(mi.UnpolarizedSpectrum))], visible

        nodes = [*self.data.materials, *shining_objects(self.data)]
        tree = frame, lighting.lights, lighting.areas, shapes
        sums, visible = checkpointed_sum(term, len(self.slices), tree, attached_parameters(nodes))
        return mi.UnpolarizedSpectrum(*sums), [mi.Float(one) for part in visible for one in part]

    def relit(self, maps: tuple[ShadowMaps | None, SoftMaps | None], geometry: Geometry) -> Lighting:
        """The scene's current lights with shadow maps of an earlier image, in which shapes and lights had the same places."""
        data = self.data
        if not self.settings.lit:
            return Lighting((), None, data.areas, (), None)
        return Lighting(data.lights, maps[0], data.areas, self._samples(data.areas, geometry), maps[1])

    def incident_light(self, frame: Frame, lighting: Lighting, known: Visibilities | None = None) -> IncidentLight:
        """Light that reaches the surfaces that a camera sees. ``known``: visibilities that still hold. Attached."""
        if known is not None:
            return IncidentLight(self._outlined(frame, lighting.wide), known.lights, 0, known.parts)
        looped, written = self._in_tables(frame, lighting)
        visible = self.visibilities(frame, lighting, written, [lighting.lights[k] for k in written])
        lights = self._outlined(frame, [lighting.wide[k] for k in written])
        return IncidentLight(lights, visible, looped, (None,) * len(lighting.samples))

    def visible(self, frame: Frame, lighting: Lighting) -> Visibilities:
        """Visibility of all lights from the surfaces that a camera sees. Detached."""
        with dr.suspend_grad():
            numbers = list(range(len(lighting.lights)))
            lights = self.visibilities(frame, lighting, numbers, list(lighting.lights))
            pairs = zip(self.soft, lighting.samples, strict=True) if self.settings.lit else ()
            maps, seen = lighting.soft_maps, frame.surface
            parts = (sample_visibilities(seen, plan, own, maps, _interleaving(own, frame.view)) for plan, own in pairs)
            return Visibilities(lights, tuple(parts))

    def white_terms(self, frame: Frame, lighting: Lighting, geometry: Geometry) -> tuple[Any, ...]:
        """Radiance (Float, N) towards the camera for each light, if light and surfaces were white. Detached.

        For lights that have a colour (:mod:`shadowmap_dr.rendering.light_colours`), and surfaces whose colour is white.
        """
        with dr.suspend_grad():
            lights, seen = [white_light(light) for light in lighting.lights], frame.surface
            samples = self._samples(tuple(white_area_light(area) for area in lighting.areas), geometry)
            visible = self.visibilities(frame, lighting, list(range(len(lights))), lights)
            reach = zip(self._outlined(frame, lights), visible, strict=True)
            extended, maps, nodes = zip(self.soft, samples, strict=True), lighting.soft_maps, self.data.materials
            terms = [direct_light(seen, light, fraction) for light, fraction in reach]
            terms += [soft_light(seen, plan, own, maps, nodes, _interleaving(own, frame.view)) for plan, own in extended]
            return tuple(term[0] for term in terms)

    def radiance(self, frame: Frame, lighting: Lighting, incident: IncidentLight) -> Color3f:
        """Reflected radiance (colour, N) towards the camera, of ambient light, too. Arguments as of :meth:`reflected`."""
        return self.with_ambient(self.reflected(frame, lighting, incident), frame.surface)

    def reflected(self, frame: Frame, lighting: Lighting, incident: IncidentLight) -> Color3f:
        """Radiance (colour, N) of all lights that surfaces reflect towards the camera. Attached to all arguments.

        ``incident``: light on these surfaces.
        """
        gate, seen = not self.settings.shadow.compat, frame.surface
        color = dr.zeros(mi.UnpolarizedSpectrum, dr.width(seen.shape))
        nodes = self.data.materials
        for light, fraction in zip(incident.lights, incident.visible, strict=True):
            color += direct_light(seen, light, fraction, nodes, gate=gate, keep=incident.kept)
        soft = self.soft if self.settings.lit else ()
        for plan, samples, parts in zip(soft, lighting.samples, incident.parts, strict=True):
            interleaving = _interleaving(samples, frame.view)
            color += soft_light(seen, plan, samples, lighting.soft_maps, nodes, interleaving, gate=gate, visible=parts)
        return incident.looped + color

    def with_ambient(self, color: Color3f, seen: Surface) -> Color3f:
        """Radiance plus reflected ambient light, which nothing shadows."""
        if self.settings.ambient > 0 and self.settings.lit:
            nodes, uniform = self.data.materials, UniformRadiance(self.settings.ambient)
            color += ambient_light(seen, uniform, _AMBIENT_DIRECTIONS, nodes)
        return color

    def with_emission(self, color: Color3f, seen: Surface, lighting: Lighting, sensor: Sensor, size: ImageSize) -> Color3f:
        """Radiance plus that of emitters that the camera sees. ``size``: samples of the image."""
        if not self._shows_emitters:
            return color
        color = self.with_shining(color, seen, lighting)
        for environment in self.data.environments:
            color = dr.select(seen.active, color, background(environment, sensor, size.width, size.height))
        return color

    def with_shining(self, color: Color3f, seen: Surface, lighting: Lighting) -> Color3f:
        """Radiance plus that of shining surfaces."""
        return color + emission(seen, lighting.areas) if self._shows_emitters else color

    @property
    def _shows_emitters(self) -> bool:
        return not self.settings.hide_emitters and self.settings.max_depth != 0

    def transmittances(self, frame: Frame, lighting: Lighting) -> list[Color3f]:
        """Share of each light (colour, N) that translucent casters let through to the points of a frame. Attached.

        Raises:
            ShadowmapError: the maps of the lights are not in memory together.
        """
        if lighting.sliced is not None:
            raise ShadowmapError("aovs: 'transmittance' needs the maps of all lights at once: raise light_memory.")
        seen, maps = frame.surface, lighting.maps
        if maps is None or maps.transmittance is None:
            return [mi.UnpolarizedSpectrum(1) for _ in lighting.lights]
        each = enumerate(lighting.lights)
        return [light_through(maps, self.plan, light, k, seen.p_world, seen.active) for k, light in each]

    def visibilities(
        self, frame: Frame, lighting: Lighting, numbers: list[int], lights: Sequence[Light]
    ) -> list[Float | Color3f]:
        """Visibility (N) of lights from all pixels: numbers, or colours where there are translucent casters.

        ``numbers``: indices of the lights in the plan.
        """
        maps = lighting.maps
        if maps is None or not numbers:
            return [mi.Float(1) for _ in lights]
        spots, seen = self._spots(frame), frame.surface
        # One look-up for each pixel where texels are large.
        apart = maps.transmittance is not None and maps.settings.transmittance_texels > 0
        look_up = visibility_of if apart else arriving_light
        found: list[Float | Color3f] = []
        for index, light in zip(numbers, lights, strict=True):
            lit = spots.mean(partial(look_up, maps, self.plan, light, index))
            found.append(lit * light_through(maps, self.plan, light, index, seen.p_world, seen.active) if apart else lit)
        return found

    def _samples(self, areas: tuple[AreaLight, ...], geometry: Geometry) -> tuple[LightSamples, ...]:
        extended: tuple[SoftLight, ...] = (*areas, *self.data.environments)
        return tuple(samples_of(light, plan, geometry) for light, plan in zip(extended, self.soft, strict=True))

    def _replaced(self, lights: tuple[Any, ...], replacements: Mapping[str, Any] | None) -> tuple[Any, ...]:
        given = replacements or {}
        for name, new in given.items():
            old = self.data.light(name)
            if type(old) is not type(new):
                raise ShadowmapError(f"Light '{name}' is a {type(old).__name__}, not a {type(new).__name__}.")
        return tuple(given.get(light.name, light) for light in lights)

    def _around(self, frame: Frame) -> list[Any]:
        view, seen = frame.view, frame.surface
        return footprint_points(view.sensor, view.size, frame.depth, seen.p_world, seen.n_world, 2)

    def _outlined(self, frame: Frame, lights: Sequence[Light]) -> tuple[Any, ...]:
        """Lights with outlines as soft as pixels are wide."""
        compat = self.settings.shadow.compat
        shining = [SquareSpot(light) if compat and isinstance(light, SpotLight) else light for light in lights]
        view, seen = frame.view, frame.surface
        return softened(shining, seen.p_world, lambda: footprints(view.sensor, view.size, frame.depth, seen.n_world))

    def _in_tables(self, frame: Frame, lighting: Lighting) -> tuple[Color3f | int, list[int]]:
        """(radiance of all lights of frequent kinds, indices of the other lights)."""
        every, seen = list(range(len(lighting.lights))), frame.surface
        if len(every) < MANY_LIGHTS or self.settings.shadow.compat or self.settings.aovs:
            return 0, every
        spots = FootprintSamples([seen.p_world], seen.active, 1) if lighting.maps is None else self._spots(frame)
        if spots.copies > 1:  # they are lanes of their own
            return 0, every
        around = partial(self._around, frame)
        return many_lights(seen, lighting.lights, self.plan, lighting.maps, spots.points, around, self.data.materials)

    def _spots(self, frame: Frame) -> FootprintSamples:
        view, seen = frame.view, frame.surface
        count = self.settings.look_ups(view.columns)
        return FootprintSamples.of(view.sensor, view.size, frame.depth, seen.p_world, seen.n_world, seen.active, count)


def plan_extended_lights(data: SceneData, settings: RenderSettings) -> tuple[SoftPlan, ...]:
    """Sample the area lights and environments of a scene (on the host, once). ShadowmapError if maps are too many."""
    lights: tuple[SoftLight, ...] = (*data.areas, *data.environments)
    single = settings.emitter_shadows == "single"
    # One map, from which penumbrae are estimated, serves as it is.
    chosen = settings.area_light_samples if isinstance(settings.area_light_samples, int) else MOST if single else None
    cameras = [camera for cameras in data.sensors for camera in cameras]
    soft = plan_soft(lights, data.geometry, chosen, settings.environment_light_samples, single, cameras)
    if settings.shadow.method != "none":
        check_soft_sizes(soft, data.geometry, settings.soft_map_resolution)
    return soft


def _interleaving(samples: LightSamples, view: CameraView) -> Interleaving:
    return interleaving_of(samples, view.size, view.factor, view.raster.batch)
