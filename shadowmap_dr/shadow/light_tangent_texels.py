"""Texels of directional lights' maps, and their derivatives by the lights' directions."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import drjit as dr

from ..jit.arrays import backend, interleave
from ..jit.kernel_inputs import float_input, quotient, uint_input
from ..jit.types import Float, Point3f, UInt32, Vector3f
from ..raster import NO_TRIANGLE, NO_VERTEX, Crossings, RasterOutput
from ..raster.antialiasing.neighbour_weights import incoming_weights, weight_sum
from ..raster.screen_planes import depth_at, planes
from ..raster.types import pixel_coordinates
from .light_camera import Frusta, Views, of_map
from .methods.depth_scale import DepthScale
from .methods.registry import PREFILTERED
from .settings import ShadowSettings
from .texel_depths import FAR, texel_depths

#: Light-space coordinates (x, y, z), or their changes.
Coordinates: TypeAlias = tuple[Float, Float, Float]


def twist_of(views: Views) -> Float:
    """Rotation (M) of each view about its ``forward`` axis for each unit that this axis moves along ``right``."""
    module = backend(views.spread)
    d = [dr.abs(views.forward[c]) for c in range(3)]
    # The world axis from which `directional_view` builds the frame.
    use_x = (d[0] <= d[1]) & (d[0] <= d[2])
    use_y = ~use_x & (d[1] <= d[2])

    def component(vector: Vector3f) -> Float:
        return dr.select(use_x, vector[0], dr.select(use_y, vector[1], vector[2]))

    return module.Float(component(views.forward) / component(views.up))


def turned(twist: Float, p: Point3f | Coordinates) -> tuple[Coordinates, Coordinates]:
    """Changes of light-space coordinates (x, y, z) with a, and with b (see :mod:`shadowmap_dr.shadow.light_tangents`)."""
    zero = type(p[0])(0)
    return (dr.fma(twist, p[1], -p[2]), -twist * p[0], p[0]), (zero, -p[2], p[1])


class TangentTexels:
    """Values and tangents of the texels of a batch of maps, anti-aliased in the same kernel. Detached.

    Texels hold simple functions of their triangles' planes. A blended texel computes its neighbours' values again, which costs
    less than to write and read the values of all texels.
    """

    def __init__(
        self,
        raster: RasterOutput,
        clip: Float,
        faces: UInt32,
        views: Views,
        frusta: Frusta,
        twist: Float,
        settings: ShadowSettings,
        size: int,
    ) -> None:
        self.module, self.raster, self.size, self.settings = backend(clip), raster, size, settings
        self.views, self.frusta, self.twist = views, frusta, twist
        self.method = PREFILTERED[settings.method]
        self.planes, _ = planes(clip, faces, raster, False)
        dr.eval(self.planes)

    def mixed(self, crossings: Crossings | None, rates: tuple[Float, Float] | None) -> tuple[Float, Float]:
        """(values, tangents) of all texels, flat; the tangents are a texel's changes with a, then with b.

        Blended by the weights of ``crossings`` and their changes ``rates`` (:func:`weight_rates`); not blended if None.
        """
        module, size = self.module, self.size
        image, row, column = pixel_coordinates(module, self.raster.batch, size, size)
        texel = dr.arange(module.UInt32, self.raster.batch * size * size)
        free = self.method.encode(module.Float(FAR), module.Float(0), self.settings.order, DepthScale(0))

        def plain(*lanes: UInt32) -> tuple[Float, ...]:
            own, changes = self._own(*lanes)
            return (*own, *changes)

        # Half of a map may be empty.
        result = dr.if_stmt(
            (image, row, column, self.raster.triangle),
            self.raster.triangle != NO_TRIANGLE,
            plain,
            lambda *lanes: (*free, *(module.Float(0) for _ in range(2 * len(free)))),
            mode="symbolic",
            label="texels",
        )
        own, changes = list(result[: len(free)]), list(result[len(free) :])
        if crossings is None or rates is None:
            return interleave(own), interleave(changes)
        incoming, side = incoming_weights(crossings, size), uint_input(module, "width", size)
        channels = len(own)

        def mix(texel: UInt32, image: UInt32, row: UInt32, column: UInt32, *lanes: Float) -> tuple[Float, ...]:
            incoming, own, changes = lanes[:4], lanes[4 : 4 + channels], lanes[4 + channels :]
            claims = weight_sum(incoming)
            scale = dr.rcp(dr.maximum(1, claims))
            # For the right, lower, left and upper neighbour: row and column offset; the texel and direction whose pair holds the
            # weight; the sign of the weight if the neighbour reaches into this texel.
            steps = ((0, 1, texel, 0, -1), (1, 0, texel, 1, -1), (0, -1, texel - 1, 0, 1), (-1, 0, texel - side, 1, 1))
            others, places = [], (texel + 1, texel + side, texel - 1, texel - side)
            for weight, place, (down, right, *_) in zip(incoming, places, steps, strict=True):
                there = weight > 0
                triangle = dr.gather(module.UInt32, self.raster.triangle, place, there)
                triangle = dr.select(there, triangle, NO_TRIANGLE)
                others.append(self._own(image, _moved(row, down), _moved(column, right), triangle))
            mixed = [
                v + sum(dr.select(w > 0, w * scale * (other[0][c] - v), 0) for w, other in zip(incoming, others, strict=True))
                for c, v in enumerate(own)
            ]
            # A texel that is claimed as a whole: more for one neighbour is less for all others.
            mean = [dr.select(claims >= 1, m, v) for m, v in zip(mixed, own, strict=True)]
            total = list(changes)
            for weight, (numbers, tangents), (_, _, holder, axis, sign) in zip(incoming, others, steps, strict=True):
                there = weight > 0
                factor = weight * scale
                rate = dr.gather(module.Array2f, rates[axis], holder, there) * (sign * scale)
                for k in range(2 * channels):
                    c = k % channels
                    change = factor * (tangents[k] - changes[k]) + rate[k // channels] * (numbers[c] - mean[c])
                    # Not in place: that would change the texel's own tangents, too.
                    total[k] = total[k] + dr.select(there, change, 0)
            return (*mixed, *total)

        result = dr.if_stmt(
            (texel, image, row, column, *incoming, *own, *changes),
            weight_sum(incoming) > 0,
            mix,
            lambda texel, image, row, column, *lanes: lanes[4:],
            mode="symbolic",
            label="mixed texels",
        )
        return interleave(list(result[:channels])), interleave(list(result[channels:]))

    def _own(self, image: UInt32, row: UInt32, column: UInt32, triangle: UInt32) -> tuple[list[Float], list[Float]]:
        """Values of texels before blending, and their changes with a, then with b."""
        module, size = self.module, self.size
        view, frustum = of_map(self.views, image, self.views.count), of_map(self.frusta, image, self.views.count)
        twist = dr.gather(module.Float, self.twist, image)
        hit = triangle != NO_TRIANGLE
        seen = depth_at(self.planes, image * self.raster.face_count + triangle, row, column, hit)
        texels = texel_depths(seen, hit, view, frustum, self.settings)
        n, f = frustum.near, frustum.far
        step, start, half_side = (float_input(module, "width", value) for value in (2.0 / size, 1.0 / size - 1.0, 0.5 * size))
        ndc_x, ndc_y = dr.fma(module.Float(column), step, start), dr.fma(module.Float(row), step, start)
        # The light-space point that the texel sees, and the slopes of its triangle there.
        half_range = 0.5 * (f - n)
        p = (
            dr.fma(ndc_x, frustum.half_x, frustum.center_x),
            dr.fma(ndc_y, frustum.half_y, frustum.center_y),
            dr.fma(texels.seen, half_range, 0.5 * (f + n)),
        )
        slope_x = texels.dx * half_range * half_side / frustum.half_x
        slope_y = texels.dy * half_range * half_side / frustum.half_y
        # Depths before the resolved range are constant.
        scale = dr.select(texels.shown & (texels.depth > -0.5), dr.rcp(f - frustum.first), 0)
        # The texel stays in place while the triangle moves through it.
        rates = [(dz - slope_x * dx - slope_y * dy) * scale for dx, dy, dz in turned(twist, p)]
        order = self.settings.order
        values, slopes = _with_slopes(lambda z: self.method.encode(z, texels.slope_square, order, DepthScale(0)), texels.depth)
        return values, [slope * rate for rate in rates for slope in slopes]


def _moved(number: UInt32, by: int) -> UInt32:
    """Sum of an unsigned and a signed integer."""
    return number + by if by >= 0 else number - -by


def _with_slopes(function: Callable[[Float], list[Float]], x: Float) -> tuple[list[Float], list[Float]]:
    """(``function(x)``, derivatives of its results by ``x``). Detached."""
    with dr.resume_grad():
        x = dr.detach(x, preserve_type=True) + 0
        dr.enable_grad(x)
        values = function(x)
        dr.set_grad(x, 1)
        dr.enqueue(dr.ADMode.Forward, x)
        # A result may be x itself, whose gradient would otherwise be cleared in the traversal.
        dr.traverse(dr.ADMode.Forward, flags=dr.ADFlag.ClearEdges)
        slopes = [dr.grad(v) for v in values]
    return [dr.detach(v) for v in values], slopes


def weight_rates(clip: Float, crossings: Crossings, frusta: Frusta, twist: Float, size: int) -> tuple[Float, Float]:
    """Changes with a and b of the weights of right and of lower pairs, interleaved; undefined for pairs of weight 0. Detached."""
    module = backend(clip)
    Array2f, Array4f = module.Array2f, module.Array4f
    count, pixels = dr.width(twist), dr.width(crossings.right)
    right, down = dr.empty(module.Float, 2 * pixels), dr.empty(module.Float, 2 * pixels)

    def visit(slot: UInt32, pair: UInt32) -> None:
        ends = dr.gather(module.Array4u, crossings.ends, slot)
        has = ends.x != NO_VERTEX
        slope = dr.gather(Array4f, crossings.slopes, slot, has)
        a, b = (dr.gather(Array4f, clip, v, has) for v in (ends.x, ends.y))
        at = dr.fma(b - a, slope.x, a)
        pixel = pair >> 1
        image = quotient(pixel, "texels of a map", size * size)
        frustum, own = of_map(frusta, image, count), dr.gather(module.Float, twist, image)
        n, f = frustum.near, frustum.far
        p = (
            dr.fma(at.x, frustum.half_x, frustum.center_x),
            dr.fma(at.y, frustum.half_y, frustum.center_y),
            0.5 * dr.fma(at.z, f - n, f + n),
        )
        per_x, per_y = slope.y / frustum.half_x, slope.z / frustum.half_y
        rate = Array2f(*(dr.select(has, per_x * dx + per_y * dy, 0) for dx, dy, _ in turned(own, p)))
        is_down = (pair & 1) != 0
        dr.scatter(right, rate, pixel, ~is_down)
        dr.scatter(down, rate, pixel, is_down)

    crossings.pairs.for_each(visit)
    dr.eval(right, down)
    return right, down
