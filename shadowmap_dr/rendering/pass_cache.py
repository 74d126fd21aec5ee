"""Results of passes that remain valid from one image of a camera to the next while their inputs do not change."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.types import Bool, Color3f, Float
from ..raster import Crossings
from ..shadow import ShadowMaps
from .extended_lights import SoftMaps
from .gbuffer.camera_view import CameraView, PlacedShapes
from .gbuffer.surface import Surface
from .light_pass import Visibilities


class CacheLevel(IntEnum):
    """Inputs that do not change from one image to the next; each level includes the levels before."""

    NOTHING = 0
    #: Shapes and the camera.
    VIEW = 1
    #: Positions and directions of lights.
    LIGHTS = 2
    #: The radiance of lights: all inputs but materials.
    RADIANCE = 3


@dataclass(frozen=True)
class LitFrame:
    """The samples of one camera, N of them, on materials that depend on cosines only. Detached.

    Attributes:
        view: the camera.
        surface: the surfaces, reduced to the inputs of their colours (:func:`colouring_inputs`).
        sharpness: as :attr:`~shadowmap_dr.rendering.gbuffer.camera_view.Frame.sharpness`.
        irradiance: radiance towards the camera (colour, N) on white materials, of lights whose radiance is fixed.
        emitted: radiance (colour, N) of visible emitters whose radiance is fixed.
        terms: for each light of the scene, if the lights' radiance may change: ``irradiance`` (Float, N) of the light in white.
        front: ``Bool`` (N,), mask of surfaces seen from their shining side, if the lights' radiance may change; else None.
    """

    view: CameraView
    surface: Surface
    sharpness: Float | None
    irradiance: Color3f
    emitted: Color3f
    terms: tuple[Any, ...] = ()
    front: Bool | None = None


@dataclass
class PassCache:
    """Results of the passes of one image, detached.

    Attributes:
        level: inputs that have not changed since the previous image, and carry no gradients. Images store here the results that
            depend on these inputs alone.
        shapes, views, crossings: with ``VIEW``; the latter two for each camera of a film.
        maps: shadow maps of lights, and of extended lights; with ``LIGHTS``.
        visible: visibilities of lights, unless there are too many; with ``LIGHTS``.
        lit: lit samples without their colours; with ``RADIANCE``, or with ``LIGHTS`` if the radiance of each light is uniform.
    """

    level: CacheLevel = CacheLevel.NOTHING
    shapes: PlacedShapes | None = None
    views: tuple[CameraView, ...] = ()
    crossings: tuple[Crossings, ...] = ()
    maps: tuple[ShadowMaps | None, SoftMaps | None] | None = None
    visible: tuple[Visibilities, ...] = ()
    lit: tuple[LitFrame, ...] = ()

    def keep(self, level: CacheLevel) -> None:
        """Drop results that depend on more than the inputs of a level."""
        self.level = level
        if level < CacheLevel.VIEW:
            self.shapes, self.views, self.crossings = None, (), ()
        if level < CacheLevel.LIGHTS:
            self.maps, self.visible, self.lit = None, (), ()
        if level < CacheLevel.RADIANCE and not all(frame.terms for frame in self.lit):
            self.lit = ()

    def forget_edges(self) -> None:
        """Drop results that depend on the edges at which shading jumps."""
        self.shapes, self.crossings = None, ()


def colouring_inputs(surface: Surface) -> Surface:
    """The same surfaces with only the fields that :func:`~shadowmap_dr.rendering.gbuffer.surface.coloured` reads."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(surface.shape))
    for name in ("p", "uv", "prim_index", "shape"):
        setattr(si, name, getattr(surface.si, name))
    si.wi = mi.Vector3f(0, 0, dr.select(surface.si.wi.z < 0, mi.Float(-1), 1))
    return Surface(mi.Point3f(0), mi.Normal3f(0), mi.Vector3f(0), surface.shape, surface.active, si, surface.bsdf)


def weights_only(crossings: Crossings) -> Crossings:
    """The same crossings without the data for derivatives by the edges' positions, which is most of the data."""
    none = type(crossings.slopes)()
    return replace(crossings, ends=type(crossings.ends)(), slopes=none, second_slopes=none, meetings=None)
