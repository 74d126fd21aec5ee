"""The image pass: reflected light, emitters, AOVs, and the mix of neighbouring samples."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.arrays import interleave
from ..jit.broadcast import broadcast_differentiable
from ..jit.handover import computed, evaluated, stored, wants_values
from ..jit.types import Bool, Color3f, Float, TensorXf
from ..raster import Crossings, antialias
from ..scene.geometry import Geometry
from .direct_light import shining_side
from .film.aovs import collect_aovs
from .film.film import film_channels
from .gbuffer.camera_clip import least_gap
from .gbuffer.camera_view import CameraPass, CameraView, Frame, PlacedShapes
from .gbuffer.layer_blending import Blended, Layer
from .gbuffer.surface import coloured
from .gbuffer.translucent_layers import Layers
from .gbuffer.transmission import transmittance_of, whole_triangles
from .light_colours import colours_of
from .light_loops import MANY_LIGHTS
from .light_pass import IncidentLight, Lighting, LightPass, Visibilities
from .pass_cache import CacheLevel, LitFrame, PassCache, colouring_inputs, weights_only

# Most visibilities (numbers) that are kept from one image to the next.
_MOST_VISIBLE = 1 << 23


@dataclass(frozen=True)
class ImagePass:
    """Makes the images of cameras, as tensors (rows, columns, C) of samples.

    Attributes:
        cameras, light: the camera pass and the light pass.
    """

    cameras: CameraPass
    light: LightPass

    def image(
        self,
        view: CameraView,
        crossings: Crossings | None,
        visible: Visibilities | None,
        lighting: Lighting,
        shapes: PlacedShapes,
    ) -> TensorXf:
        """The image of one camera. Attached to all inputs, but not through edges if ``crossings`` are given, and not through
        visibilities if ``visible`` is given."""
        light, settings = self.light, self.light.settings
        lighting = lighting.in_lanes(view.raster.height * view.raster.width)
        frame = self.cameras.frame(view, shapes, light.needs_frames)
        incident, color = self._reflected(frame, lighting, visible, shapes)
        color = light.with_emission(color, frame.surface, lighting, view.sensor, view.size)
        if view.layers is not None:
            return self._layered(frame, view.layers, color, lighting, shapes)
        seen = frame.surface
        named = collect_aovs(settings.aovs, seen, view.raster, incident.visible, partial(light.transmittances, frame, lighting))
        if crossings is None and settings.antialias:
            channels = self._channels(color, seen.active, view)
            flat = antialias(
                *(channels, view.raster, view.clip, view.topology),
                **shapes.creases,
                crease_weights=frame.sharpness,
                meetings=True,
                gap=least_gap(view.sensor),
                continued=True,
                derivatives_only=not wants_values(),
            )
            return _picture(flat, view, len(channels), named)
        return self._mixed(color, seen.active, view, crossings, named)

    def _layered(self, frame: Frame, layers: Layers, color: Color3f, lighting: Lighting, shapes: PlacedShapes) -> TensorXf:
        """The image of opaque surfaces (``frame``, of ``color``) and of the translucent layers before them. Attached."""
        view, settings, sensor = frame.view, self.light.settings, frame.view.sensor
        layers.check_memory(layers.attached or dr.grad_enabled(color))
        channels = dr.size_v(mi.UnpolarizedSpectrum)
        coverage = None
        if sensor.alpha or "opacity" in settings.aovs:
            coverage = dr.select(frame.surface.active & (settings.max_depth != 0), mi.Float(1), 0)
        opaque = below = Blended(evaluated("opaque light", Blended.of(color, coverage).channels))
        made = self._layers(view, layers, opaque, lighting, shapes)
        if layers.at_once(view.clip) >= len(layers.translucent):
            # Before anything is blended: their look-ups in maps and those of opaque surfaces then have one adjoint.
            made = iter(list(made))
        outlines = self._outlines_of_levels(frame, layers, shapes) if settings.antialias else ()
        # One behind all layers, then the layers from the last to the first.
        for number, layer in enumerate(itertools.chain([None], made)):
            if layer is not None:
                below = below.behind(layer)
            if outlines:
                level = len(outlines) - 1 - number
                below = below.outlined(
                    replace(view, raster=layers.opaque[level]), outlines[level], frame.sharpness, shapes.creases
                )
        taken = mi.Float(0) if coverage is None else below.channels[-1]
        named = self._aovs_of_nearest(view, lighting, shapes, taken)
        flat = film_channels(mi.UnpolarizedSpectrum(*below.channels[:channels]), taken, sensor)
        return _picture(interleave(flat), view, len(flat), named)

    def _outlines_of_levels(self, frame: Frame, layers: Layers, shapes: PlacedShapes) -> tuple[Crossings, ...]:
        """See ``Layers.outlines``. Detached."""

        def found() -> tuple[Crossings, ...]:
            with dr.suspend_grad():
                return layers.outlines(frame.view.raster, self.cameras.crossings(frame.view, frame.sharpness, shapes))

        return computed("outlines of levels", found)

    def _layers(
        self, view: CameraView, layers: Layers, opaque: Blended, lighting: Lighting, shapes: PlacedShapes
    ) -> Iterator[Layer]:
        """The translucent layers of a view, back to front, several made at once. Attached.

        ``opaque``: as of ``Layer.outlined``.
        """
        faces, edges = layers.faces, shapes.translucent
        assert edges is not None, "placed together with the translucent faces"
        placed = shapes if layers.attached else shapes.detached
        for chosen, clip in layers.in_batches(view.clip):
            seen = replace(view, raster=chosen, clip=clip, topology=edges, layers=None)
            needs_frames = self.light.needs_frames or faces.cutouts
            lighting = lighting.in_lanes(dr.width(chosen.triangle))
            own = self.cameras.frame(seen, placed, needs_frames, whole_triangles(chosen, faces))
            radiance = self.light.with_shining(self._reflected(own, lighting, None, shapes)[1], own.surface, lighting)
            active = own.surface.active
            layer = Layer.of(radiance, transmittance_of(own.surface, faces.bsdfs), active, len(opaque.channels))
            if self.light.settings.antialias:
                made = layer.outlined(seen, active, opaque, own.sharpness, shapes.translucent_creases)
            else:
                made = layer.apart(chosen.batch)
            yield from reversed(made)

    def _aovs_of_nearest(self, view: CameraView, lighting: Lighting, shapes: PlacedShapes, coverage: Float) -> list[Float]:
        """Further channels of the nearest surfaces, whether they are opaque or not."""
        aovs = self.light.settings.aovs
        if not aovs:
            return []
        lighting = lighting.in_lanes(dr.width(view.nearest.raster.triangle))
        frame = self.cameras.frame(view.nearest, shapes, True)
        incident = self._reflected(frame, lighting, None, shapes)[0]
        through = partial(self.light.transmittances, frame, lighting)
        return collect_aovs(aovs, frame.surface, frame.view.raster, incident.visible, through, coverage)

    def coloured_image(self, lit: LitFrame, crossings: Crossings | None) -> TensorXf:
        """The image of one camera, given its light and edges. Attached to materials and the lights' colours."""
        surface, width = coloured(self.light.data, lit.surface, self.light.needs_frames), dr.width(lit.surface.shape)
        irradiance, emitted = lit.irradiance, lit.emitted
        assert surface.colour is not None, "kept for materials that have one"
        if lit.terms:
            assert lit.front is not None, "kept together with the terms"
            lights, areas = self.light.data.lights, self.light.data.areas
            colours = broadcast_differentiable(colours_of((*lights, *areas)), width)
            irradiance = irradiance + sum(term * colour for term, colour in zip(lit.terms, colours, strict=True))
            for light, colour in zip(areas, colours[len(lights) :], strict=True):
                emitted = emitted + dr.select(lit.front & (lit.surface.shape == light.shape), colour, 0)
        return self._mixed(surface.colour * irradiance + emitted, lit.surface.active, lit.view, crossings, [])

    def fill(self, cache: PassCache, shapes: PlacedShapes, views: Sequence[CameraView], lighting: Lighting) -> None:
        """Store the results of passes for later images."""
        if cache.level == CacheLevel.NOTHING:
            return
        settings = self.light.settings
        plain = self.light.data.only_cosines and not settings.aovs and not settings.shadow.compat
        lit = plain and (cache.level >= CacheLevel.RADIANCE or (cache.level == CacheLevel.LIGHTS and self._uniform()))
        cache.shapes, cache.views = shapes, tuple(views)
        if cache.level >= CacheLevel.LIGHTS:
            cache.maps = lighting.maps, lighting.soft_maps
        if any(view.layers is not None for view in views):
            dr.eval(shapes, cache.views, cache.maps)
            return
        seen = cache.level >= CacheLevel.LIGHTS and not lit and not cache.visible and self._room_for_visible(views)
        if not (lit or seen) and (cache.crossings or not settings.antialias):
            return
        with dr.suspend_grad():
            frames = [self.cameras.frame(view, shapes, self.light.needs_frames) for view in views]
            self.fill_crossings(cache, shapes, frames)
            if lit and cache.level == CacheLevel.LIGHTS:
                cache.lit = tuple(self._uniformly_lit(frame, lighting, shapes.geometry) for frame in frames)
            elif lit:
                cache.lit = tuple(self._lit(frame, lighting) for frame in frames)
            elif seen:
                cache.visible = tuple(self.light.visible(frame, lighting) for frame in frames)
            dr.eval(shapes, cache.views, cache.maps, cache.visible, cache.lit)

    def fill_crossings(self, cache: PassCache, shapes: PlacedShapes, frames: Sequence[Frame | LitFrame]) -> None:
        """Store the crossings of edges for later images. ``frames``: of all cameras."""
        if self.light.settings.antialias and not cache.crossings:
            found = (self.cameras.crossings(frame.view, frame.sharpness, shapes) for frame in frames)
            cache.crossings = tuple(weights_only(crossings) for crossings in found)

    def _uniform(self) -> bool:
        """True if an image is a sum over few lights, each a product with the light's colour."""
        data, settings = self.light.data, self.light.settings
        lights = (*data.lights, *data.areas)
        if data.environments or not settings.lit or not 0 < len(lights) < MANY_LIGHTS:
            return False
        return colours_of(lights) is not None

    def _room_for_visible(self, views: Sequence[CameraView]) -> bool:
        """True if the visibilities of all lights fit into the cache."""
        light = self.light
        if len(light.data.lights) >= MANY_LIGHTS or light.settings.shadow.method == "none":
            return False
        each = len(light.data.lights) + sum(plan.count for plan in light.soft)
        return each * sum(view.raster.width * view.raster.height for view in views) <= _MOST_VISIBLE

    def _reflected(
        self, frame: Frame, lighting: Lighting, visible: Visibilities | None, shapes: PlacedShapes
    ) -> tuple[IncidentLight, Any]:
        """(light that reaches a frame, reflected radiance (colour, N) towards the camera)."""
        light, colour = self.light, frame.surface.colour
        if lighting.sliced is not None:
            color, each = light.reflected_in_slices(frame, lighting, shapes)
            return IncidentLight((), each, 0, ()), light.with_ambient(color, frame.surface)
        if colour is None:
            incident = light.incident_light(frame, lighting, visible).stored()
            return incident, light.radiance(frame, lighting, incident)
        # In the same order as with cached light, so that images of an unchanged scene are equal bit by bit.
        white = _white(frame)
        incident = light.incident_light(white, lighting, visible).stored()
        irradiance = light.radiance(white, lighting, incident)
        if dr.grad_enabled(colour) and lighting.samples:
            dr.eval(irradiance)  # else the derivative would run its loops again
        if light.needs_frames:  # else a look-up in a small table
            colour = stored("colours", colour, beside=irradiance)
        return incident, colour * irradiance

    def _lit(self, frame: Frame, lighting: Lighting) -> LitFrame:
        view, light = frame.view, self.light
        white = _white(frame)
        irradiance = light.radiance(white, lighting, light.incident_light(white, lighting))
        none = dr.zeros(mi.UnpolarizedSpectrum, dr.width(frame.surface.shape))
        emitted = light.with_emission(none, frame.surface, lighting, view.sensor, view.size)
        return LitFrame(view, colouring_inputs(frame.surface), frame.sharpness, irradiance, emitted)

    def _uniformly_lit(self, frame: Frame, lighting: Lighting, geometry: Geometry) -> LitFrame:
        light = self.light
        settings, surface = light.settings, frame.surface
        none, white = dr.zeros(mi.UnpolarizedSpectrum, dr.width(surface.shape)), _white(frame)
        terms = light.white_terms(white, lighting, geometry)
        front = shining_side(surface)
        if settings.hide_emitters or settings.max_depth == 0:
            front &= mi.Bool(False)
        ambient = light.with_ambient(mi.UnpolarizedSpectrum(none), white.surface)
        return LitFrame(frame.view, colouring_inputs(surface), frame.sharpness, ambient, none, terms, front)

    def _channels(self, color: Color3f, active: Bool, view: CameraView) -> list[Float]:
        return film_channels(color, active & (self.light.settings.max_depth != 0), view.sensor)

    def _mixed(self, color: Color3f, active: Bool, view: CameraView, crossings: Crossings | None, named: list[Float]) -> TensorXf:
        """A picture of samples that mix through known crossings, or not at all."""
        channels = self._channels(color, active, view)
        if crossings is None:
            return _picture(interleave(channels), view, len(channels), named)
        flat = antialias(
            channels, view.raster, dr.detach(view.clip), view.topology, crossings=crossings, derivatives_only=not wants_values()
        )
        return _picture(flat, view, len(channels), named)


def _white(frame: Frame) -> Frame:
    """The same frame with white surfaces."""
    return replace(frame, surface=replace(frame.surface, colour=mi.UnpolarizedSpectrum(1)))


def _picture(flat: Float, view: CameraView, channels: int, named: list[Float]) -> TensorXf:
    """A tensor of interleaved channels, followed by AOVs (Float each)."""
    height, width = view.raster.height, view.raster.width
    image = mi.TensorXf(flat, shape=(height, width, channels))
    if named:
        image = dr.concat([image, mi.TensorXf(interleave(named), shape=(height, width, len(named)))], axis=2)
    return image
