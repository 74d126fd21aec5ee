"""Settings of the search for a pose: samples per pixel, blur and tries, chosen by the size of an object's facets.

Objects of this package are searched for as in the paper, with one sample, without blur and once. Files of users may hold bars,
rims, needles and leaves that are narrower than a pixel. One sample then misses most of them, their shadows are too far apart to
attract each other, and a flat object has nearly the same shadow when it is turned the other way round.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io import assets
from ...scene.mitsuba_meshes import mesh_buffers
from .scene import PoseProblem

#: Differences between images by the share of those without the object. A search that ends above has found another pose.
EXPLAINED = 0.05
#: Rotation between the starts of a run's tries, in degrees.
TURN_DEG = 25.0
#: A pose in which neither an object in [-1, 1]^3 nor its shadow is near anything.
AWAY = np.array([0.0, 50.0, 0.0])
# Sides of grids of samples, and distances of samples that the narrowest tenth of an object's area has to be wide.
_GRIDS, _WIDE, _NARROW_SHARE = (1, 2, 4), 2.0, 0.1
# Blur by the width of an image, 8 pixels of 128; share of the steps with blur; tries.
_BLUR, _BLUR_STEPS, _TRIES = 1 / 16, 2 / 3, 5
# Samples along a side of the last images of Levenberg and Marquardt's method.
_SAMPLES = 384


@dataclass(frozen=True)
class Search:
    """Settings of the search of our own methods.

    Attributes:
        samples: samples per pixel.
        blur: standard deviation of the blur of the first step, in pixels, see `PoseFit`.
        tries: most descents of a run. Another one follows, from another rotation, while the differences are above `EXPLAINED`.
        optimiser: ``adam`` or ``lm``.
    """

    samples: int = 1
    blur: float = 0.0
    tries: int = 1
    optimiser: str = "adam"

    def blur_steps(self, iterations: int) -> int:
        """Number of steps with blur."""
        return round(_BLUR_STEPS * iterations) if self.blur else 0


def choose(
    problem: PoseProblem, file: str, samples: int | None, blur: float | None, tries: int | None, optimiser: str = "adam"
) -> Search:
    """Settings for a problem whose object is called ``file`` by the user; None stands for a choice."""
    known = file in assets.mesh_names()
    chosen = Search() if known else Search(samples_for(facet_widths(problem)), _BLUR * problem.resolution, _TRIES)
    if optimiser == "lm":
        # It stops at the first minimum, and the loss of images with few samples has many.
        chosen = replace(chosen, samples=max(chosen.samples, math.ceil(_SAMPLES / problem.resolution) ** 2))
    return Search(
        chosen.samples if samples is None else samples,
        chosen.blur if blur is None else blur,
        chosen.tries if tries is None else tries,
        optimiser,
    )


def samples_for(widths: Sequence[tuple[float, float]] | npt.NDArray[np.float64]) -> int:
    """Samples per pixel, 1, 4 or 16, for facets of these widths and areas, see `facet_widths`."""
    width = narrow_width(widths)
    side = next((side for side in _GRIDS if side * width >= _WIDE), _GRIDS[-1])
    return side**2


def narrow_width(widths: Sequence[tuple[float, float]] | npt.NDArray[np.float64]) -> float:
    """Width in pixels that a tenth of the area does not reach."""
    values = np.asarray(widths, np.float64).reshape(-1, 2)
    width, area = values[np.argsort(values[:, 0])].T
    if not area.sum():
        return 0.0
    return float(width[np.searchsorted(np.cumsum(area), _NARROW_SHARE * area.sum())])


def facet_widths(problem: PoseProblem) -> npt.NDArray[np.float64]:
    """(F, 2) least width in pixels and area in square pixels of each facet in the image of the target pose.

    If the camera sees only the shadow, facets are those of the shadow.
    """
    (object_,) = (shape for shape in problem.scene.shapes() if shape.id() == "object")
    faces = np.array(mesh_buffers(object_).faces).reshape(-1, 3)
    points = problem.p_rest.astype(np.float64)
    if problem.shadow_only:
        (wall,) = (shape for shape in problem.scene.shapes() if shape.id() == "wall")
        points = points * [1, 1, 0] + [0, 0, wall.bbox().min.z]
    corners = _in_pixels(problem, points)[faces]
    edges = np.roll(corners, -1, 1) - corners
    area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    longest = np.linalg.norm(edges, axis=2).max(1)
    return np.stack([2 * area / np.maximum(longest, 1e-12), area], 1)


def _in_pixels(problem: PoseProblem, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(V, 2) positions in the image of points (V, 3) before the camera."""
    camera = problem.scene.sensors()[0]
    place = np.linalg.inv(np.array(camera.world_transform().matrix, np.float64).reshape(4, 4))
    local = points @ place[:3, :3].T + place[:3, 3]
    angle = math.radians(float(np.ravel(mi.traverse(camera)["x_fov"])[0]))
    return local[:, :2] / local[:, 2:] * (0.5 * problem.resolution / math.tan(0.5 * angle))


def number_or_auto(name: str, text: str) -> float | None:
    """A number of the command line, None for ``auto``. Raises a ShadowmapError with the option's name for another word."""
    if text == "auto":
        return None
    try:
        value = float(text)
    except ValueError:
        raise ShadowmapError(f"{name} is {text!r}: give a number, or auto.") from None
    return int(value) if value.is_integer() else value
