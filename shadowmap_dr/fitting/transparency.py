"""Transparent parts of pictures: of renderings with nothing behind the objects, or of photos that were cut out."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np

from ..io.resampling import area_average
from ..rendering.renderer import Renderer
from .targets import Target

# Coverage from which a pixel shows surfaces alone, and least share of a picture's transparent area where the scene shows none.
_COVERED, _LEAST = 0.999, 0.5


def as_rendered(renderer: Renderer, target: Target) -> Target:
    """A picture whose transparent parts count, if they are those of a rendering of the scene; otherwise the picture as it is.

    A rendering of objects alone is transparent around them, and in part at outlines and panes: this tells of the objects. A photo
    that was cut out is transparent where somebody has removed something, and tells nothing of it. In the scene of such a photo
    are surroundings, as a rule. Mitsuba's ``direct`` renders a sky, but counts it as transparent.

    Args:
        renderer: the renderer of the scene as it was given.
        target: the picture, of one of its sensors.
    """
    if target.opaque is None:
        return target
    if renderer.data.environments and not target.opaque.image[target.weight == 0].any():
        return target
    record = renderer.data.cameras(target.sensor)[0]
    with dr.suspend_grad():
        image = np.array(renderer.render(sensor=replace(record, alpha=True)))
    empty = np.asarray(image[..., record.channels : record.channels + 1] < _COVERED, np.float32)
    empty = area_average(lambda rows: empty[rows], empty.shape[:2], (target.height, target.width))[..., 0]
    clear = target.opaque.weight - target.weight
    return target.opaque if (clear * empty).sum() >= _LEAST * clear.sum() else target
