"""Mixing of pixels with the neighbours that reach into them, and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import drjit as dr

from ...jit.arrays import backend, reinterpret
from ...jit.handover import computed
from ...jit.kernel_inputs import SharingOp, uint_input
from ...jit.packets import packed
from ...jit.types import Bool, Float, UInt32, Vector4f
from ..topology import NO_VERTEX
from ..types import RasterOutput
from .colour_jumps import Surroundings
from .edge_crossings import Crossings
from .neighbour_weights import around, neighbours, weight_sum
from .pixel_pairs import each_number


class Canvas:
    """Values of all pixels, and a copy in which those of blended pixels are overwritten. Detached.

    (No record: :func:`dr.custom` would hold the arrays of one, and overwriting would copy them once more.)

    Attributes:
        original: the values, flat and interleaved, or a list with one array for each channel. Evaluated.
        separate: the copy has one array for each channel, too; else it is flat.
        blank: the values are not known, and those of the copy are not asked for.
    """

    def __init__(self, original: Float | list[Float], separate: bool = False, blank: bool = False) -> None:
        self.original, self.separate, self.blank = original, separate, blank
        self._copy: Float | list[Float] | None = None

    @classmethod
    def of(cls, values: list[Float], beside: Float | None, separate: bool) -> tuple[Canvas, Float | None]:
        """(Canvas of channels that need not be evaluated, values of ``beside``). One kernel writes all of it."""
        made: list[Float | list[Float]] = []

        def write() -> tuple[list[Float], Float | None]:
            plain = [dr.detach(channel) for channel in values], None if beside is None else dr.detach(beside)
            made.append([_copied(channel) for channel in plain[0]] if separate else packed(plain[0]))
            dr.eval(plain, made)
            return plain

        original, beside = computed("values of pixels", write)
        canvas = cls(original, separate)
        canvas._copy = made[0] if made else None
        return canvas, beside

    @classmethod
    def blank_for(cls, values: list[Float], separate: bool) -> Canvas:
        """Canvas of channels whose values are not asked for."""
        return cls([dr.zeros(type(channel), dr.width(channel)) for channel in values], separate, True)

    @property
    def channels(self) -> list[Float] | None:
        """The values as a list, or None."""
        return self.original if isinstance(self.original, list) else None

    def copy(self) -> Float | list[Float]:
        """The copy, to be written once. Evaluated unless blank."""
        if self.blank:
            zero = cast("list[Float]", self.original)
            return zero if self.separate else dr.zeros(type(zero[0]), len(zero) * dr.width(zero[0]))
        if self._copy is None:
            self._copy = _copied(cast("Float", self.original))
            dr.eval(self._copy)
        return self._copy


def _copied(flat: Float) -> Float:
    """A writable copy, made by all threads; Dr.Jit's own copy uses a single thread."""
    module = backend(flat)
    # An expression that Dr.Jit does not recognise as the same array.
    bits = reinterpret(module.UInt32, flat) ^ (dr.arange(module.UInt32, dr.width(flat)) >> 31)
    return reinterpret(module.Float, bits)


def blend(
    values: Float | list[Float],
    positions: Float,
    raster: RasterOutput,
    crossings: Crossings,
    canvas: Canvas,
    surroundings: Surroundings | None = None,
) -> Float | list[Float]:
    """Apply the weights of all pairs of pixels.

    Args:
        values: flat, interleaved channels of all pixels, or a list with one array for each channel. Attached.
        positions: flat clip-space vertices of all images. Attached.
        raster: output of the rasterizer.
        crossings: edges between pixels, for the same positions.
        canvas: of the values.
        surroundings: given to extrapolate colours to the edges (:mod:`shadowmap_dr.raster.antialiasing.colour_jumps`), or None.

    Returns blended values, flat and interleaved, or separate if those of the canvas are.
    """
    if not dr.is_diff_v(positions):
        return _Mixer(canvas, raster.width, crossings).values
    wanted = dr.grad_enabled(values), dr.grad_enabled(positions)
    mixer = _Mixer(canvas, raster.width, crossings, surroundings)
    blended: Float | list[Float] = dr.custom(_Blend, values, positions, mixer, wanted)
    return blended


class _Blend(SharingOp):
    """Blending as one differentiable operation, whose derivatives also work only on blended pixels."""

    def eval(
        self, values: Float | list[Float], positions: Float, mixer: _Mixer, wanted: tuple[bool, bool]
    ) -> Float | list[Float]:
        self.mixer, self.wanted, self.vertices = mixer, wanted, dr.width(positions)
        return mixer.values

    def forward(self) -> None:
        values = cast("Float | list[Float]", self.grad_in("values")) if self.wanted[0] else None
        positions = cast("Float", self.grad_in("positions")) if self.wanted[1] else None
        dr.eval(values, positions)
        self.set_grad_out(self.mixer.tangent(values, positions))

    def backward(self) -> None:
        adjoint = cast("Float | list[Float]", self.grad_out())
        dr.eval(adjoint)
        if self.wanted[0]:
            self.set_grad_in("values", self.mixer.adjoint_of_values(adjoint))
        if self.wanted[1]:
            self.set_grad_in("positions", self.mixer.adjoint_of_positions(adjoint, self.vertices))


class _Mixer:
    """Blended ``values``, and the data of their derivatives. Detached.

    A pixel mixes ``scale * weight`` of each neighbour that reaches into it. Up to four neighbours may each claim half of an
    isolated pixel, but not more than the whole in all: ``scale = 1 / max(1, sum of weights)``.
    """

    def __init__(self, canvas: Canvas, width: int, crossings: Crossings, surroundings: Surroundings | None = None) -> None:
        self.module = backend(crossings.right)
        self.crossings, self.width, self.surroundings = crossings, width, surroundings
        self.pixels = dr.width(crossings.right)
        self.original, self.separate, self.blank = canvas.original, canvas.separate, canvas.blank
        self.channels = dr.width(self.original) // self.pixels if canvas.channels is None else len(canvas.channels)
        # Blended values, and sums of weights, which are defined only where neighbours reach into a pixel.
        self.values, self.claims = computed("mixed values", lambda: self._mix(canvas.copy()))

    def _mix(self, result: Float | list[Float]) -> tuple[Float | list[Float], Float]:
        """(values, claims). ``result``: a copy of the values, in which those of the few blended pixels are overwritten."""
        sums = dr.empty(self.module.Float, self.pixels)

        def visit(slot: UInt32, pair: UInt32) -> None:
            down, pixel, weight = self._pair(pair)

            def mix(pixel: UInt32, down: Bool, weight: Float) -> Float:
                taker = dr.select(weight > 0, self._neighbour(pixel, down), pixel)
                incoming = self.around(self.crossings.right, self.crossings.down, 1, at=taker)
                claims = weight_sum(incoming)
                # A pixel may take from several pairs; only the first of them writes it.
                first = self._is_first(incoming, taker != pixel, down)
                dr.scatter(sums, claims, taker, first)
                if not self.blank:
                    self._write(result, self._mixed(taker, incoming, claims, self.read(self.original, taker)), taker, first)
                return weight

            dr.if_stmt((pixel, down, weight), weight != 0, mix, lambda *lanes: lanes[2], mode="symbolic")

        self.crossings.pairs.for_each(visit)
        dr.eval(sums, [] if self.blank else result)
        return result, sums

    def _write(self, result: Float | list[Float], values: list[Float], pixel: UInt32, active: Bool) -> None:
        """Write all channels of pixels."""
        if not isinstance(result, list):
            packet = values[0] if self.channels == 1 else self.module.ArrayXf(values)
            dr.scatter(result, packet, pixel, active)
            return
        for channel, value in zip(result, values, strict=True):
            dr.scatter(channel, value, pixel, active)

    def _mixed(self, pixel: UInt32, incoming: Sequence[Float], claims: Float, own: Sequence[Float]) -> list[Float]:
        scale = _scale(claims)
        total = list(own)
        for weight, neighbour in zip(incoming, self.neighbours(pixel), strict=True):
            other = self.read(self.original, neighbour, weight > 0)
            factor = weight * scale
            total = [dr.fma(factor, dr.select(weight > 0, v - o, 0), t) for v, o, t in zip(other, own, total, strict=True)]
        return total

    def adjoint_of_values(self, adjoint: Float | list[Float]) -> Float | list[Float]:
        """Gradient to the values from that of the result."""
        if not isinstance(self.original, list):
            return self._adjoint_of_few(cast("Float", adjoint))
        pixel = dr.arange(self.module.UInt32, self.pixels)
        right, down = self.crossings.right, self.crossings.down
        incoming, outgoing = self.around(right, down, 1), self.around(right, down, -1)
        own = self.read(adjoint, pixel)

        def spread(pixel: UInt32, *lanes: Float) -> tuple[Float, ...]:
            return tuple(self._spread(adjoint, pixel, lanes[:4], lanes[4:8], lanes[8:]))

        touched = weight_sum(incoming) + weight_sum(outgoing) > 0
        lanes = (pixel, *incoming, *outgoing, *own)
        result = dr.if_stmt(lanes, touched, spread, lambda *lanes: lanes[9:], mode="symbolic", label="blend")
        return list(result)

    def _adjoint_of_few(self, adjoint: Float) -> Float:
        result = _copied(adjoint)
        dr.eval(result)

        def visit(slot: UInt32, end: UInt32) -> None:
            down, pixel, weight = self._pair(self.crossings.pairs.at(slot))

            def spread(pixel: UInt32, down: Bool, weight: Float, end: UInt32) -> Float:
                second = end != 0
                pixel = dr.select(second, self._neighbour(pixel, down), pixel)
                signed = self.around(self.crossings.right, self.crossings.down, 1, True, pixel)
                incoming, outgoing = [dr.maximum(w, 0) for w in signed], [dr.maximum(-w, 0) for w in signed]
                first = self._is_first([dr.abs(w) for w in signed], second, down)
                total = self._spread(adjoint, pixel, incoming, outgoing, self.read(adjoint, pixel))
                self._write(result, total, pixel, first)
                return weight

            lanes = (pixel, down, weight, end)
            dr.if_stmt(lanes, weight != 0, spread, lambda *lanes: lanes[2], mode="symbolic")

        # Both pixels of each pair.
        pairs = self.crossings.pairs
        each_number(2 * (pairs.front + pairs.back), pairs.lanes, lambda number: visit(number >> 1, number & 1))
        dr.eval(result)
        return result

    def _spread(
        self,
        adjoint: Float | list[Float],
        pixel: UInt32,
        incoming: Sequence[Float],
        outgoing: Sequence[Float],
        own: Sequence[Float],
    ) -> list[Float]:
        claims = weight_sum(incoming)
        kept = 1 - claims * _scale(claims)
        total = [kept * o for o in own]
        for weight, neighbour in zip(outgoing, self.neighbours(pixel), strict=True):
            factor = weight * _scale(dr.gather(self.module.Float, self.claims, neighbour, weight > 0))
            other = self.read(adjoint, neighbour, weight > 0)
            total = [dr.fma(factor, v, t) for v, t in zip(other, total, strict=True)]
        return total

    def adjoint_of_positions(self, adjoint: Float | list[Float], size: int) -> Float:
        """Gradient to the flat positions from that of the result."""
        module = self.module
        Array4f = module.Array4f
        result = dr.zeros(module.Float, size)
        crossings = self.crossings
        # Gradients to the weights, by slot; only those of pairs that have a weight.
        gains = None if crossings.meetings is None else dr.empty(module.Float, 2 * self.pixels)

        def visit(slot: UInt32, pair: UInt32) -> None:
            down, pixel, weight = self._pair(pair)

            def add(slot: UInt32, pixel: UInt32, down: Bool, weight: Float) -> Float:
                gain, ends = self._gain(adjoint, pixel, down, weight), dr.gather(module.Array4u, crossings.ends, slot)
                if gains is not None:
                    dr.scatter(gains, gain, slot)
                _add(result, gain, dr.gather(Array4f, crossings.slopes, slot), ends.x, ends.y, ends.x != NO_VERTEX)
                two = ends.z != NO_VERTEX

                def second(slot: UInt32, gain: Float, c: UInt32, d: UInt32) -> Float:
                    _add(result, gain, dr.gather(Array4f, crossings.second_slopes, slot), c, d, True)
                    return gain

                return dr.if_stmt((slot, gain, ends.z, ends.w), two, second, lambda *lanes: lanes[1], mode="symbolic")

            dr.if_stmt((slot, pixel, down, weight), weight != 0, add, lambda *lanes: lanes[3], mode="symbolic")

        crossings.pairs.for_each(visit)
        meetings = crossings.meetings
        if meetings is None or gains is None:
            return result
        dr.eval(result, gains)

        def meet(slot: UInt32) -> None:
            down, pixel, weight = self._pair(crossings.pairs.at(slot))
            active = (weight != 0) & self._bare(slot)

            def add(slot: UInt32, pixel: UInt32, down: Bool, weight: Float) -> Float:
                gain, rate = dr.gather(module.Float, gains, slot), self._rate(slot)
                for vertex, slope in meetings.slopes(slot, pixel, down, rate):
                    dr.scatter_add(result, slope * gain, vertex)
                return weight

            dr.if_stmt((slot, pixel, down, weight), active, add, lambda *lanes: lanes[3], mode="symbolic")

        meetings.for_each(meet)
        return result

    def _pair(self, pair: UInt32) -> tuple[Bool, UInt32, Float]:
        """(True for a pair with the lower neighbour, its pixel, its weight)."""
        down, pixel = (pair & 1) != 0, pair >> 1
        below = dr.gather(self.module.Float, self.crossings.down, pixel, down)
        return down, pixel, dr.select(down, below, dr.gather(self.module.Float, self.crossings.right, pixel, ~down))

    def _neighbour(self, pixel: UInt32, down: Bool) -> UInt32:
        """The second pixel of a pair."""
        return pixel + dr.select(down, uint_input(self.module, "width", self.width), 1)

    def _is_first(self, shares: Sequence[Float], second: Bool, down: Bool) -> Bool:
        """True if no earlier pair around the pixel has a share; the pixel is the pair's second one if ``second``, else its first.

        ``shares``: shares of the right, lower, left and upper neighbour.
        """
        before = [shares[0] > 0]
        for share in shares[1:3]:
            before.append(before[-1] | (share > 0))
        # The other pixel of the pair: right, lower; left, upper.
        return ~dr.select(second, dr.select(down, before[2], before[1]), down & before[0])

    def _bare(self, slot: UInt32) -> Bool:
        """True if a pair has no edge."""
        return dr.gather(self.module.UInt32, self.crossings.ends, 4 * slot) == NO_VERTEX

    def _rate(self, slot: UInt32) -> Float:
        """Change of the weight of a pair without an edge with the depth."""
        return dr.gather(self.module.Float, self.crossings.slopes, 4 * slot)

    def _gain(self, adjoint: Float | list[Float], pixel: UInt32, down: Bool, weight: Float) -> Float:
        """Gradient to the weight of a pair."""
        # The neighbour takes from the pixel where the weight is positive, else the other way round.
        neighbour = self._neighbour(pixel, down)
        taker, giver = dr.select(weight > 0, neighbour, pixel), dr.select(weight > 0, pixel, neighbour)
        claims = dr.gather(self.module.Float, self.claims, taker)
        scale = _scale(claims)
        g, own = self.read(adjoint, taker), self.read(self.original, taker)
        other = self._beyond(taker, giver, down, 0.5 - dr.abs(weight), True)
        shared = claims >= 1  # the pixel is claimed as a whole: more for one neighbour is less for all others
        mixed = self.read(self.values, taker, shared)
        mean = [dr.select(shared, m, o) for m, o in zip(mixed, own, strict=True)]
        gain = sum(a * (v - m) for a, v, m in zip(g, other, mean, strict=True))
        return gain * dr.select(weight > 0, scale, -scale)

    def _beyond(self, taker: UInt32, giver: UInt32, down: Bool, place: Float, active: Bool | bool) -> list[Float]:
        """Colours of ``giver``, extrapolated to the edge at ``place`` if there are surroundings, as seen from ``taker``."""
        if self.surroundings is None:
            return self.read(self.original, giver, active)

        def read(pixel: UInt32, active: Bool | bool) -> list[Float]:
            return self.read(self.original, pixel, active)

        def crossed(pixel: UInt32, down: Bool, active: Bool) -> Bool:
            weights = ((self.crossings.right, active & ~down), (self.crossings.down, active & down))
            right, below = (dr.gather(self.module.Float, weight, pixel, wanted) for weight, wanted in weights)
            return (right != 0) | (below != 0)

        return self.surroundings.beyond(read, crossed, taker, giver, down, place, active)

    def tangent(self, values: Float | list[Float] | None, positions: Float | None) -> Float | list[Float]:
        """Tangent of the result, given those of the values and of the positions (or None)."""
        module = self.module
        pixel = dr.arange(module.UInt32, self.pixels)
        crossings = self.crossings
        incoming = self.around(crossings.right, crossings.down, 1)
        claims = weight_sum(incoming)
        scale = _scale(claims)
        own = self.read(self.original, pixel)
        change = self.read(values, pixel) if values is not None else [module.Float(0)] * self.channels
        total = list(change)
        if positions is not None:
            right, down = self._tangent_of_weights(positions)
            # The sign of a weight tells which pixel takes; its change has the sign convention of the (right, lower) pair.
            rates = self.around(right, down, 1, signed=True)
            mixed = self.read(self.values, pixel, claims >= 1)
            mean = [dr.select(claims >= 1, m, o) for m, o in zip(mixed, own, strict=True)]
        for k, (weight, neighbour) in enumerate(zip(incoming, self.neighbours(pixel), strict=True)):
            active = weight > 0
            if values is not None:
                other = self.read(values, neighbour, active)
                factor = weight * scale
                total = [dr.fma(factor, v - c, t) for v, c, t in zip(other, change, total, strict=True)]
            if positions is not None:
                other = self._beyond(pixel, neighbour, self.module.Bool(k % 2 == 1), 0.5 - weight, active)
                factor = dr.select(active, rates[k] * scale, 0)
                total = [dr.fma(factor, v - m, t) for v, m, t in zip(other, mean, total, strict=True)]
        return self._written(total)

    def _tangent_of_weights(self, positions: Float) -> tuple[Float, Float]:
        module = self.module
        Float, Array4f = module.Float, module.Array4f
        crossings = self.crossings
        right, down = dr.zeros(Float, self.pixels), dr.zeros(Float, self.pixels)

        def visit(slot: UInt32, pair: UInt32) -> None:
            ends = dr.gather(module.Array4u, crossings.ends, slot)
            change = Float(0)
            for slopes, a, b in ((crossings.slopes, ends.x, ends.y), (crossings.second_slopes, ends.z, ends.w)):
                has = a != NO_VERTEX
                slope = dr.gather(Array4f, slopes, slot, has)
                p, q = (dr.gather(Array4f, positions, v, has) for v in (a, b))
                at = dr.fma(q - p, slope.x, p)
                change += dr.select(has, slope.y * at.x + slope.z * at.y + slope.w * at.w, 0)
            is_down = (pair & 1) != 0
            dr.scatter(right, change, pair >> 1, ~is_down)
            dr.scatter(down, change, pair >> 1, is_down)

        crossings.pairs.for_each(visit)
        dr.eval(right, down)
        meetings = crossings.meetings
        if meetings is None:
            return right, down

        def meet(slot: UInt32) -> None:
            is_down, pixel, weight = self._pair(crossings.pairs.at(slot))
            slopes = meetings.slopes(slot, pixel, is_down, self._rate(slot))
            change = sum(dr.dot(slope, dr.gather(Array4f, positions, vertex)) for vertex, slope in slopes)
            active = (weight != 0) & self._bare(slot)
            dr.scatter(right, change, pixel, active & ~is_down)
            dr.scatter(down, change, pixel, active & is_down)

        meetings.for_each(meet)
        dr.eval(right, down)
        return right, down

    def neighbours(self, pixel: UInt32) -> tuple[UInt32, UInt32, UInt32, UInt32]:
        """Indices of the right, lower, left and upper neighbours."""
        return neighbours(pixel, self.width)

    def around(
        self, right: Float, down: Float, sign: int, signed: bool = False, at: UInt32 | None = None
    ) -> tuple[Float, Float, Float, Float]:
        """Weights of neighbours, see :func:`shadowmap_dr.raster.antialiasing.neighbour_weights.around`."""
        return around(right, down, self.width, sign, signed, at)

    def read(self, flat: Float | list[Float], pixel: UInt32, active: Bool | bool = True) -> list[Float]:
        """All channels of pixels."""
        module = self.module
        if isinstance(flat, list):
            return [dr.gather(module.Float, channel, pixel, active) for channel in flat]
        if self.channels in (2, 4):
            packet = module.Array2f if self.channels == 2 else module.Array4f
            return list(dr.gather(packet, flat, pixel, active))
        return [dr.gather(module.Float, flat, pixel * self.channels + c, active) for c in range(self.channels)]

    def _written(self, channels: list[Float]) -> Float | list[Float]:
        """The channels, interleaved unless they are separate."""
        return channels if self.separate else packed(channels)


def _scale(claims: Float) -> Float:
    return dr.rcp(dr.maximum(1, claims))


def _add(result: Float, gain: Float, slopes: Vector4f, a: UInt32, b: UInt32, active: Bool | bool) -> None:
    """Pass a weight's gradient on to the ends of its edge."""
    Array4f = type(slopes)
    g = Array4f(gain * slopes.y, gain * slopes.z, 0, gain * slopes.w)
    dr.scatter_add(result, g * (1 - slopes.x), a, active)
    dr.scatter_add(result, g * slopes.x, b, active)
