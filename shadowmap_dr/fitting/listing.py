"""The list of all that can vary in a scene, with the effect of each on the image."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import mitsuba as mi
import numpy as np
from rich.table import Table

from ..errors import ShadowmapError
from ..io import console
from ..rendering.renderer import Renderer
from ..scene.sensor import ImageSize
from .arrays import MeshVertices, TextureValues
from .parameters import Parameter
from .resolve import Candidate, Resolver
from .stages import qualities
from .vary import Vary
from .views import View

# Pixels along the longer side of the images whose derivatives tell what moves them.
_SIDE = 96


def listed(scene: mi.Scene, entries: Sequence[Vary] = (), sensors: Collection[int] = ()) -> Table:
    """A table of the objects and values of a scene: names for ``--vary``, kinds, present values, effect on the image.

    The effect is the change of an image by a change of a degree, a hundredth of the extent, or one per cent, as a share of the
    image's brightness: the largest one of some sensors' images. A sensor's own parameters have theirs on its own image.

    Args:
        scene: the scene.
        entries: variations to list instead of all.
        sensors: numbers of the sensors that have pictures; the first one, if there are none.

    Raises:
        ShadowmapError: a variation of something that the scene does not have; a sensor that it does not have.
    """
    renderer = Renderer.from_scene(scene)
    resolver = Resolver(renderer)
    resolver.parameters(entries)
    chosen = [_chosen(resolver, entry) for entry in entries] if entries else resolver.candidates()
    seen = sorted(set(sensors)) or [0]
    rows = [[one.name, ", ".join(one.kinds), one.value, _effect(renderer, resolver, one, seen)] for one in chosen]
    columns = ["name", "kinds", "now", "moves the image by"]
    table = console.table("What can vary: --vary NAME:KIND", columns, rows, wrapped=(0, 1))
    table.caption = (
        "Changes of a degree, of a hundredth of the size, or of one per cent, as shares of an image's brightness: of cameras "
        "with pictures (without any: the first one); of a camera's own image for its own values."
    )
    table.caption_justify = "left"
    return table


def _chosen(resolver: Resolver, entry: Vary) -> Candidate:
    """A variation as a row of the list, with the kinds and the present value of what it names."""
    names = (entry.name, f"{entry.name}.value")
    known = next((one for one in resolver.candidates() if one.name in names), Candidate(entry.name, (), ""))
    return replace(known, kinds=(entry.kind,) if entry.kind else known.kinds)


def _effect(renderer: Renderer, resolver: Resolver, candidate: Candidate, sensors: Sequence[int]) -> str:
    """The effect of an object's or value's first kind in words."""
    kind = candidate.kinds[0] if candidate.kinds else ""
    if kind == "texture":
        return ""
    try:
        parameter = resolver.parameter(Vary(candidate.name, kind))
    except ShadowmapError:
        return ""
    if isinstance(parameter, (MeshVertices, TextureValues)):
        return ""
    own = resolver.sensors.get(candidate.name)
    step = np.pi / 180 if kind in ("direction", "rotation") else 0.01
    effect = 100 * step * max(_strongest(renderer, parameter, number) for number in (sensors if own is None else [own]))
    return "nothing" if effect < 1e-4 else f"{effect:.2g} %"


def _strongest(renderer: Renderer, parameter: Parameter, sensor: int) -> float:
    """The largest derivative of a sensor's image by one of a parameter's numbers, as a share of the image's brightness."""
    record = renderer.data.cameras(sensor)[0]
    share = _SIDE / max(record.width, record.height)
    size = ImageSize(max(1, round(record.width * share)), max(1, round(record.height * share)))
    view = View(renderer, [parameter], [], sensor, size, qualities(_SIDE, 1, renderer.settings.shadow.resolution)[-1])
    zero = np.zeros(view.count)
    brightness = float(np.sqrt(np.mean(np.square(view.image(zero), dtype=np.float64)))) or 1.0
    derivatives = [view.derivative(zero, number)[1] for number in range(view.count)]
    return max(float(np.sqrt(np.mean(np.square(one, dtype=np.float64)))) for one in derivatives) / brightness
