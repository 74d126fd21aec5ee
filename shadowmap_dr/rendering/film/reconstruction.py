"""Reconstruction filters of films: their weights on a grid of samples, and the weighted sums that make pixels of samples.

Mitsuba adds each sample to the pixels around it, weighted by the film's filter at the distance from the sample to the pixel's
centre, and divides a pixel by its sum of weights. With ever more samples that is the integral of the filter times the image. Here
a sample is an anti-aliased value, which stands for a cell: the pixel, or one of a grid of cells in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ...jit.arrays import backend, ravel
from ...jit.kernel_inputs import SharingOp, int_input, split, uint_input
from ...jit.types import Float, TensorXf, UInt32
from ...scene.pixel_filter import Filter


def reconstruct(samples: TensorXf, filter: Filter, factor: int, border: int) -> TensorXf:
    """Pixels (``mi.TensorXf``, H, W, C) from samples ((H + 2 border) * factor, (W + 2 border) * factor, C).

    Args:
        samples: a grid of ``factor`` x ``factor`` for each pixel.
        border: pixels on each side that were sampled beyond the film; without any (or with fewer than the filter reaches) weights
            of samples that do not exist are shared out to those that do.

    Gradients flow to ``samples``, by gathering, without atomics. Nothing is read back; sizes and weights are static.
    """
    weights = filter.weights(factor)
    rows, columns, channels = samples.shape
    height, width = rows // factor - 2 * border, columns // factor - 2 * border
    first = border * factor - (len(weights) - factor) // 2
    values = dr.custom(_Gathered, samples.array, weights, _Axis(rows, columns, width, channels, factor, first))
    values = dr.custom(_Gathered, values, weights, _Axis(1, rows, height, width * channels, factor, first))
    if first < 0:
        pixel = dr.arange(mi.UInt32, height * width * channels) // channels
        row, column = split(pixel, "width", width, height)
        values *= _share(row, "height", height, weights, factor, first) * _share(column, "width", width, weights, factor, first)
    return mi.TensorXf(values, shape=(height, width, channels))


def _share(at: UInt32, name: str, size: int, weights: tuple[float, ...], factor: int, first: int) -> Float:
    """1 / (sum of the weights of the samples that exist) for pixels ``at`` along an axis of ``size``."""
    total = mi.Float(1.0)
    end = uint_input(backend(at), name, size)
    for k in range(min(size, -(first // factor))):
        missing = sum(weights[: -first - k * factor])
        total -= dr.select(at == k, missing, 0.0) + dr.select(at == end - 1 - k, missing, 0.0)
    return dr.rcp(total)


@dataclass(frozen=True)
class _Axis:
    """Layout (before, samples or pixels, after) of an array that is filtered along its middle axis.

    Pixel p's first weight belongs to sample ``p * factor + first``.
    """

    before: int
    samples: int
    pixels: int
    after: int
    factor: int
    first: int


class _Gathered(SharingOp):
    """Weighted sums of samples along an axis, and their transpose."""

    def eval(self, values: Float, weights: tuple[float, ...], axis: _Axis) -> Float:
        self.arguments = (weights, axis)
        return _to_pixels(values, *self.arguments)

    def forward(self) -> None:
        self.set_grad_out(_to_pixels(mi.Float(self.grad_in("values")), *self.arguments))

    def backward(self) -> None:
        self.set_grad_in("values", _to_samples(mi.Float(self.grad_out()), *self.arguments))


def _packets(axis: _Axis) -> tuple[Any, int]:
    """(type of packets that are gathered, number of packets after each entry of the axis)."""
    if axis.after % 4 == 0:
        return mi.Vector4f, axis.after // 4
    return (mi.Vector3f, axis.after // 3) if axis.after % 3 == 0 else (mi.Float, axis.after)


def _to_pixels(values: Float, weights: tuple[float, ...], axis: _Axis) -> Float:
    packet, after = _packets(axis)
    lane = dr.arange(mi.UInt32, axis.before * axis.pixels * after)
    module = backend(lane)
    entry, offset = split(lane, "channels of a row", after, axis.before * axis.pixels)
    before, place = split(entry, "pixels", axis.pixels, axis.before)
    samples, across = int_input(module, "samples", axis.samples), int_input(module, "channels of a row", after)
    start, base = mi.Int32(place * axis.factor) + axis.first, mi.Int32(before) * samples
    dr.eval(values)
    total = dr.zeros(packet)
    for k, weight in enumerate(weights):
        at = start + k
        inside = True if axis.first >= 0 else (at >= 0) & (at < samples)
        total += dr.gather(packet, values, mi.UInt32((base + at) * across + mi.Int32(offset)), inside) * weight
    return total if packet is mi.Float else ravel(total)


def _to_samples(values: Float, weights: tuple[float, ...], axis: _Axis) -> Float:
    packet, after = _packets(axis)
    lane = dr.arange(mi.UInt32, axis.before * axis.samples * after)
    module = backend(lane)
    entry, offset = split(lane, "channels of a row", after, axis.before * axis.samples)
    before, sample = split(entry, "samples", axis.samples, axis.before)
    size, across = int_input(module, "pixels", axis.pixels), int_input(module, "channels of a row", after)
    base = mi.Int32(before) * size
    # The last pixel whose weights reach this sample, and which of its weights does. Shifted, since division rounds to zero.
    pixels = -(-len(weights) // axis.factor)
    shift = max(0, axis.first) // axis.factor + 1
    place = sample + (shift * axis.factor - axis.first)
    last = place // axis.factor
    which = place - last * axis.factor
    last_pixel = mi.Int32(last) - shift
    dr.eval(values)
    total = dr.zeros(packet)
    for k in range(pixels):
        at = last_pixel - k
        inside = (at >= 0) & (at < size)
        weight = mi.Float(0.0)
        for j, value in enumerate(weights[k * axis.factor : (k + 1) * axis.factor]):
            weight = mi.Float(value) if axis.factor == 1 else dr.select(which == j, value, weight)
        total += dr.gather(packet, values, mi.UInt32((base + at) * across + mi.Int32(offset)), inside) * weight
    return total if packet is mi.Float else ravel(total)
