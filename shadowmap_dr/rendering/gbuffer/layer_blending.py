"""Colours of translucent layers over what lies behind them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from ...jit.handover import evaluated
from ...jit.types import Bool, Color3f, Float
from ...raster import RasterOutput, antialias
from .camera_clip import least_gap
from .camera_view import CameraView, Frame, PlacedShapes


@dataclass(frozen=True)
class Blended:
    """The light that surfaces behind some depth send to a camera, for N samples.

    Attributes:
        channels: ``Float`` (N,) of each colour.
        coverage: ``Float`` (N,), share of the light from behind all surfaces that they take away.
    """

    channels: tuple[Float, ...]
    coverage: Float

    @classmethod
    def of(cls, color: Color3f, coverage: Float) -> Blended:
        """The light of opaque surfaces."""
        return cls(tuple(color[k] for k in range(len(color))), coverage)

    def behind(self, radiance: Color3f, through: Color3f, active: Bool) -> Blended:
        """The light with a layer in front of it, where there is one (``active``). Attached.

        Args:
            radiance: colour (N,) that the layer sends itself.
            through: colour (N,), the share of the light from behind that the layer lets through.
        """
        mixed = [dr.select(active, dr.fma(through[k], old, radiance[k]), old) for k, old in enumerate(self.channels)]
        coverage = dr.select(active, 1 - dr.mean(through) * (1 - self.coverage), self.coverage)
        return Blended(tuple(mixed), coverage)

    def outlined(
        self, view: CameraView, level: RasterOutput, sharpness: Float | None, shapes: PlacedShapes, behind: bool
    ) -> Blended:
        """The light with anti-aliased outlines of the surfaces of one level. Attached.

        Args:
            view: the camera.
            level: raster of these surfaces.
            sharpness: visibility of edges between facets, or None where all are fully visible.
            shapes: where they are.
            behind: True if there may be other surfaces before these: then edges count only where their surface is in the level.
        """
        count = len(self.channels) + 1
        values, sharpness = evaluated("layer", ([*self.channels, self.coverage], sharpness))
        topology = view.topology
        if behind:
            topology = replace(topology, see_through_faces=dr.full(mi.Bool, True, level.face_count))
        flat = antialias(
            *(values, level, view.clip, topology),
            **shapes.creases,
            crease_weights=sharpness,
            meetings=True,
            gap=least_gap(view.sensor),
            continued=True,
        )
        sample = dr.arange(mi.UInt32, dr.width(flat) // count)
        mode = dr.ReduceMode.NoConflicts  # each number is read once
        apart = [dr.gather(mi.Float, flat, sample * count + k, mode=mode) for k in range(count)]
        return Blended(tuple(apart[:-1]), apart[-1])


def merged_sharpness(layer: Frame, opaque: Frame) -> Float | None:
    """Visibility of edges between facets, of a layer where it is, else of the opaque surfaces; None where all are visible."""
    if layer.sharpness is None and opaque.sharpness is None:
        return None
    one, two = (mi.Float(1) if frame.sharpness is None else frame.sharpness for frame in (layer, opaque))
    return dr.select(layer.surface.active, one, two)
