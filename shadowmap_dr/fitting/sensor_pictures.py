"""Pictures beside the sensors of a scene: their sizes, their transparent parts, and their colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from ..errors import ShadowmapError
from ..io.resampling import area_average
from ..rendering.renderer import Renderer
from .arrays import TextureValues
from .targets import Target

# Coverage from which a pixel shows surfaces alone, and least share of a picture's transparent area where the scene shows none.
_COVERED, _LEAST = 0.999, 0.5
# Least difference between a pixel's colours in a picture with colours, as a share of its brightest value.
_COLOURFUL = 0.02
# Words in the names of Mitsuba's parameters that are colours.
_COLOURS = ("reflectance", "color", "transmittance", "radiance")


def as_seen(renderer: Renderer, targets: Sequence[Target]) -> tuple[Target, ...]:
    """Pictures as the scene's sensors could see them: transparent parts that are those of renderings count.

    Raises:
        ShadowmapError: a black picture, one of a sensor that does not exist, or of another shape than the sensor's.
    """
    _check_sizes(renderer, targets)
    return tuple(as_rendered(renderer, target) for target in targets)


def colourless(textures: Sequence[TextureValues], targets: Sequence[Target]) -> list[str]:
    """Sentences about textures of colours that have one channel, if pictures have colours."""
    spreads = [float(np.max(target.weight * np.ptp(target.image, axis=2))) for target in targets]
    if max(spreads, default=0) < _COLOURFUL * max(float(target.image.max()) for target in targets):
        return []
    return [
        f"{texture.vary.name} has one channel, so that it is grey, and the picture has colours: give it three channels."
        for texture in textures
        if texture.channels == 1 and any(word in texture.key for word in _COLOURS)
    ]


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


def _check_sizes(renderer: Renderer, targets: Sequence[Target]) -> None:
    """ShadowmapError for a black picture, one of a sensor that does not exist, or of another shape than the sensor's."""
    for target in targets:
        name = f"picture {target.name or 'of the target'}"
        count = len(renderer.data.sensors)
        if not 0 <= target.sensor < count:
            raise ShadowmapError(f"{name} is of sensor {target.sensor}, but the scene has {count}, counted from 0.")
        cameras = renderer.data.cameras(target.sensor)
        if len(cameras) != 1:
            raise ShadowmapError(f"{name}: sensor {target.sensor} is a batch of cameras: use one of a single camera.")
        if not target.image.any():
            raise ShadowmapError(f"{name} is black where it counts: nothing can be found in it; give another picture or mask.")
        width, height = cameras[0].width, cameras[0].height
        if abs(width / height * target.height / target.width - 1) > 0.01 + 1 / min(target.width, target.height):
            raise ShadowmapError(
                f"{name} has {target.width} x {target.height} pixels, sensor {target.sensor} has {width} x {height}, of "
                "another shape: crop the picture, or change the film's width and height in the scene."
            )
