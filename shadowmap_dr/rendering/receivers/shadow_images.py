"""Shadow images of one mesh in several views, straight from the shadow maps. Only shadows move, so there is no camera pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...jit.arrays import device_array
from ...jit.types import Float, Point3f, UInt32
from ...raster import Topology, build_topology
from ...shadow import Frusta, ShadowSettings, Views, filter_maps, render_maps, vertices_in_maps, visibility
from .checks import index_array, real_array
from .shadow_views import ShadowView

# All casters lie before the receiver, by half of its half-side at least, and within twelve of these. Maps tell no depths apart
# there: what a map holds is how much of a texel the casters cover, whatever shape they are.
_FIRST, _NEAR = 0.5, 12.0


@dataclass(frozen=True)
class ShadowImages:
    """Constants of shadow images while a mesh changes its vertices. May cross ``dr.freeze`` as the last argument.

    Attributes:
        faces, topology: of the mesh.
        points: ``Point3f``, for each pixel of all images, one after the other, what it sees of its receiver, moved along the
            light into the receiver's plane: behind all casters, nothing changes along the light.
        which: ``UInt32``, the number of the image of each pixel.
        weight: ``Float``, one over the number of pixels of this image that see a receiver, 0 for those that see none.
        shapes: (H, W) of each image, as NumPy has them.
        views, frusta, settings: of the shadow maps, one for each image.
    """

    faces: UInt32
    topology: Topology
    points: Point3f
    which: UInt32
    weight: Float
    shapes: tuple[tuple[int, int], ...]
    views: Views
    frusta: Frusta
    settings: ShadowSettings

    @property
    def pixels(self) -> int:
        """Number of pixels in all images together."""
        return sum(height * width for height, width in self.shapes)

    def visibility(self, vertices: Float) -> Float:
        """Visibility images of the views' cameras.

        Args:
            vertices: ``Float`` (3V,), world space. Attached.

        Returns:
            ``Float``, visibility from 0 (dark) to 1 (lit) of all pixels of all images, row-major, top row first.
        """
        p_light, map_index, _ = vertices_in_maps(self.views, vertices)
        maps = render_maps(p_light, map_index, self.faces, self.topology, self.views, self.frusta, self.settings)
        return visibility(filter_maps(maps), self.which, self.points)

    def images(self, flat: Float) -> list[npt.NDArray[np.float32]]:
        """Flat pixels, as from `visibility`, as one (H, W) array for each view."""
        values = np.array(dr.detach(flat), np.float32)
        ends = np.cumsum([0, *(height * width for height, width in self.shapes)])
        return [values[ends[k] : ends[k + 1]].reshape(size) for k, size in enumerate(self.shapes)]


def shadow_images(
    vertices: npt.ArrayLike,
    faces: npt.ArrayLike,
    views: Sequence[ShadowView],
    *,
    map_resolution: int = 256,
    filter_size: int = 5,
    method: str = "esm",
) -> ShadowImages:
    """Prepare the shadow images of a mesh.

    Args:
        vertices: (V, 3), any positions of the mesh in which no two vertices coincide that may part later.
        faces: (F, 3).
        views: one or more.
        map_resolution, filter_size, method: of the shadow maps.

    Raises ShadowmapError for a mesh or settings that cannot be used.
    """
    positions = real_array("vertices", vertices)
    corners = index_array("faces", faces, len(positions) if positions.ndim else 0)
    if positions.ndim != 2 or positions.shape[1:] != (3,) or corners.ndim != 2 or corners.shape[1:] != (3,):
        raise ShadowmapError(f"vertices of shape {positions.shape}, faces of shape {corners.shape}: give (V, 3) and (F, 3).")
    if not np.isfinite(positions).all():
        raise ShadowmapError("the mesh has vertices that are not finite: repair it first.")
    if not views:
        raise ShadowmapError("no view given: shadows need at least one.")
    try:
        topology = build_topology(corners, positions, mi.UInt32)
        settings = ShadowSettings(method=method, resolution=map_resolution, filter_size=filter_size)
    except ValueError as error:
        raise ShadowmapError(str(error)) from None
    if not topology.count:
        raise ShadowmapError("all triangles of the mesh have two corners at the same place: there is nothing to cast a shadow.")
    seen = [view.seen.ravel() for view in views]
    if not all(pixels.any() for pixels in seen):
        raise ShadowmapError("a view's camera sees nothing of its receiver.")
    points = np.concatenate([_in_plane(view) for view in views])
    return ShadowImages(
        device_array(mi.UInt32, corners),
        topology,
        mi.Point3f(*(device_array(mi.Float, points[:, c]) for c in range(3))),
        device_array(mi.UInt32, np.concatenate([np.full(pixels.size, k) for k, pixels in enumerate(seen)])),
        device_array(mi.Float, np.concatenate([pixels / pixels.sum() for pixels in seen])),
        tuple(view.shape for view in views),
        Views(
            right=mi.Vector3f(*_columns([view.right for view in views])),
            up=mi.Vector3f(*_columns([view.up for view in views])),
            forward=mi.Vector3f(*_columns([view.forward for view in views])),
            origin=mi.Point3f(*_columns([view.origin for view in views])),
            spread=dr.zeros(mi.Float, len(views)),
            limit=dr.full(mi.Float, dr.inf, len(views)),
        ),
        _frusta(views),
        settings,
    )


def image_loss(shadows: ShadowImages, seen: Float, wanted: Float) -> Float:
    """Mean squared difference of images, summed over the views: ``Float`` (1,), detached. Its derivative is set in ``seen``.

    By hand, since the loss and its derivative then read the images together, once. A backward pass from ``seen`` is to follow.
    """
    difference = dr.detach(seen) - wanted
    weighted = shadows.weight * difference
    square, slope = weighted * difference, 2 * weighted
    dr.eval(square, slope)
    dr.set_grad(seen, slope)
    return dr.sum(square)


def _columns(vectors: Sequence[npt.ArrayLike]) -> list[Any]:
    return [device_array(mi.Float, column) for column in np.asarray(vectors).T]


def _frusta(views: Sequence[ShadowView]) -> Frusta:
    """The whole receiver, with texels where an orthographic camera has pixels."""
    rows = [(0.0, 0.0, view.half, view.half, -_NEAR * view.half, 0.0, -_FIRST * view.half, 0.0) for view in views]
    return Frusta(*_columns(rows))


def _in_plane(view: ShadowView) -> npt.NDArray[np.float32]:
    """(H * W, 3): the view's points, moved along the light."""
    points, forward = (np.asarray(v, np.float64) for v in (view.points.reshape(-1, 3), view.forward))
    return (points - ((points - view.origin) @ forward)[:, None] * forward).astype(np.float32)
