"""Colours of translucent layers over what lies behind them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.broadcast import Copies
from ...jit.packets import sections
from ...jit.types import Bool, Color3f, Float
from ...raster import Crossings, antialias
from .camera_clip import least_gap
from .camera_view import CameraView

# Share of a pixel; a layer that covers less is not there.
_LEAST_SHARE = 1e-6


@dataclass(frozen=True)
class Blended:
    """The light that surfaces behind some depth send to a camera, for N samples.

    Attributes:
        channels: ``Float`` (N,) of each colour, and, if alpha is asked for, the share of the light from behind all surfaces that
            they take away.
    """

    channels: tuple[Float, ...]

    @classmethod
    def of(cls, color: Color3f, coverage: Float | None) -> Blended:
        """The light of opaque surfaces. ``coverage``: 1 where there are some, or None without alpha."""
        return cls((*(color[k] for k in range(len(color))), *([] if coverage is None else [coverage])))

    def behind(self, layer: Layer) -> Blended:
        """The light with a layer in front of it. Attached.

        In a pixel that an outline of the layer crosses, the light from behind is that of all the pixel. The part beside the layer
        shows its share of it unchanged, so the rest passes the layer.
        """
        each = zip(layer.radiance, layer.through, layer.beside, self.channels, strict=True)
        return Blended(tuple(radiance + beside + through * (whole - beside) for radiance, through, beside, whole in each))

    def outlined(self, view: CameraView, crossings: Crossings, sharpness: Float | None, creases: dict[str, Any]) -> Blended:
        """The light with anti-aliased outlines of the opaque surfaces of a view (``Layers.opaque``). Attached.

        Args:
            view: the camera, and the surfaces that it sees at one level.
            crossings: those of their outlines (``Layers.outlines``).
            sharpness: visibility of edges between facets, or None where all are fully visible.
            creases: edges at which shading jumps (``PlacedShapes.creases``), those of the faces of the view.
        """
        channels = list(self.channels)
        return Blended(tuple(outlined(channels, view, sharpness, creases, crossings)))


@dataclass(frozen=True)
class Layer:
    """One translucent surface of each of N samples. All fields have as many channels (``Float``, N) as :class:`Blended`.

    Attributes:
        radiance: light that the surface sends itself, times the share of the pixel that it covers.
        through: share of the light from behind that the surface lets through; 1 where there is none.
        beside: light of the surfaces that are seen beside it, times the share of the pixel that they cover; 0 away from outlines.
    """

    radiance: tuple[Float, ...]
    through: tuple[Float, ...]
    beside: tuple[Float, ...]

    @classmethod
    def of(cls, radiance: Color3f, through: Color3f, active: Bool, count: int) -> Layer:
        """A layer where ``active``, without anti-aliasing, of ``count`` channels."""
        passed = [through[k] for k in range(len(through))]
        own = [radiance[k] for k in range(len(radiance))]
        if count > len(own):
            passed.append(dr.mean(through))
            own.append(1 - passed[-1])
        return cls(
            tuple(dr.select(active, value, 0) for value in own),
            tuple(dr.select(active, value, 1) for value in passed),
            (mi.Float(0),) * count,
        )

    def outlined(
        self,
        view: CameraView,
        active: Bool,
        opaque: Blended,
        sharpness: Float | None,
        creases: dict[str, Any],
    ) -> list[Layer]:
        """This layer, or these layers one after the other, with anti-aliased outlines. Attached.

        Args:
            view: the camera, and what it sees of each layer (``Layers.in_batches``).
            active: where layers are.
            opaque: light of opaque surfaces, without anti-aliasing. They are what is seen beside a layer.
            sharpness: visibility of edges between facets, or None where all are fully visible.
            creases: edges at which shading jumps (``PlacedShapes.creases``), those of the faces of the view.
        """
        number, covered = view.raster.batch, dr.select(active, mi.Float(1), 0)
        passed = [covered * value for value in self.through]
        behind = list(opaque.channels)
        if number > 1:
            behind = dr.custom(Copies, behind, number, False)
        beside = [dr.select(active, 0, value) for value in behind]
        values = [*self.radiance, *passed, *beside, covered]
        blended = outlined(values, view, sharpness, creases)
        return [Layer._of_outlined(own) for own in sections(blended, number)]

    @classmethod
    def _of_outlined(cls, values: list[Float]) -> Layer:
        """A layer from anti-aliased numbers: radiance, what passes and what is beside, all times shares; the covered share."""
        *values, share = values
        count = len(values) // 3
        some = dr.detach(share) > _LEAST_SHARE
        inverse = dr.rcp(dr.select(some, share, 1))
        # Where the layer covers nothing, what is beside it is all that is behind, with its own outlines.
        through = [dr.select(some, value * inverse, 1) for value in values[count : 2 * count]]
        return cls(tuple(values[:count]), tuple(through), tuple(values[2 * count :]))

    def apart(self, count: int) -> list[Layer]:
        """The layers, if this is ``count`` of them, one after the other."""
        if count == 1:
            return [self]
        dr.eval(self.radiance, self.through)
        radiance, through = (sections(list(field), count) for field in (self.radiance, self.through))
        return [Layer(tuple(own), tuple(passed), self.beside) for own, passed in zip(radiance, through, strict=True)]


def outlined(
    values: list[Float], view: CameraView, sharpness: Float | None, creases: dict[str, Any], crossings: Crossings | None = None
) -> list[Float]:
    """Values (N,) with anti-aliased outlines of the surfaces of a view.

    ``crossings``: of these outlines; None: found here.
    """
    return antialias(
        *(values, view.raster, view.clip, view.topology),
        crossings=crossings,
        **creases,
        crease_weights=sharpness,
        meetings=True,
        gap=least_gap(view.sensor),
        continued=True,
        separate=True,
    )
