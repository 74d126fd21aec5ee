"""Images of a scene by the numbers of a fit, and their derivatives, from recordings."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..jit.arrays import device_array
from ..jit.branches import traversed_again
from ..jit.frozen import freeze
from ..jit.types import Float, TensorXf
from ..rendering.extended_lights.sample_counts import MOST
from ..rendering.renderer import Renderer
from ..rendering.settings import RenderSettings
from ..scene.pixel_filter import Filter
from ..scene.sensor import ImageSize, Sensor
from .arrays import ArrayParameter, TextureValues
from .mitsuba_values import is_recordable, set_values
from .parameters import Parameter
from .scene_change import SceneChange

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]

# Step of differences of images, in the fit's own numbers.
_DIFFERENCE = 0.01


@dataclass(frozen=True)
class Quality:
    """Settings of the images of a stage.

    Attributes:
        side: pixels along the longer side.
        spp: samples per pixel.
        texels: texels along each side of a shadow map: fewer texels make wider filters.
        light_samples: samples of an area light at most; an environment has twice as many.
        soft_texels: texels along each side of their maps at most.
    """

    side: int
    spp: int
    texels: int
    light_samples: int
    soft_texels: int


class View:
    """Images of one camera at one quality.

    Args:
        renderer: the renderer of the scene as it was given. It is not changed.
        parameters: all that few numbers describe, in the order of the fit's numbers.
        arrays: parameters with many values.
        sensor: number of the scene's sensor.
        size: of the images.
        quality: samples and texels.

    Attributes:
        values: current values of the parameters with many values, a Float each.
    """

    def __init__(
        self,
        renderer: Renderer,
        parameters: Sequence[Parameter],
        arrays: Sequence[ArrayParameter],
        sensor: int,
        size: ImageSize,
        quality: Quality,
    ) -> None:
        self._parameters, self._arrays, self._sensor = tuple(parameters), tuple(arrays), sensor
        self._size, self._spp = size, quality.spp
        self.values = [device_array(mi.Float, array.start) for array in arrays]
        self._renderer = _at(renderer, quality, size.width * size.height)
        counts = [len(parameter.labels) for parameter in parameters]
        self._starts = np.cumsum([0, *counts]).tolist()
        # Unit tangents of the numbers of entries, for the passes of their jacobians.
        self._units: dict[int, list[Float]] = {}
        # One recording for each entry: a pass computes the derivative of a combination of its numbers.
        self._passes = [freeze(self._recorded(k)) for k in range(len(parameters))]
        self._jacobians = [freeze(self._recorded_jacobian(k)) for k in range(len(parameters))]
        keys = [array.key for array in arrays if isinstance(array, TextureValues)]
        recordable = all(is_recordable(renderer.data.scene, key, gradients=True) for key in keys)
        self._image = freeze(self._recorded(-1))
        gradients = self._recorded_gradient(_of_huber), self._recorded_gradient(_given)
        self._gradient, self._pulled = (freeze(one) if recordable else one for one in gradients)
        # Names of Mitsuba's values that each entry changes, and entries whose derivatives are differences of images.
        self._keys = self._keys_of_entries()
        self._differences = [not all(is_recordable(renderer.data.scene, key) for key in own) for own in self._keys]
        self._held = 0
        self._kept: tuple[Array, list[Float], Image] | None = None

    def without_shadows(self) -> View:
        """The same view of the scene without shadows."""
        other = copy.copy(self)
        settings = self._renderer.settings
        unshadowed = replace(settings, shadow=replace(settings.shadow, method="none"))
        other._renderer = replace(copy.deepcopy(self._renderer), settings=unshadowed)
        other._image = freeze(other._recorded(-1))
        return other

    @property
    def count(self) -> int:
        """Number of the scene's numbers."""
        return int(self._starts[-1])

    def image(self, x: Array) -> Image:
        """Linear image (H, W, 3) at the numbers x (n,)."""
        return self._pass(-1, x, np.zeros(1))[0]

    @property
    def size(self) -> ImageSize:
        """Size of the images."""
        return self._size

    def camera(self, x: Array) -> Sensor:
        """The camera of the images at the numbers x (n,); its window is all of its film."""
        return self._camera(self.change(x).camera(self._sensor))

    def derivative(self, x: Array, number: int) -> tuple[Image, Image]:
        """Image, and its derivative (H, W, 3) by one of the numbers."""
        entry = int(np.searchsorted(self._starts, number, side="right")) - 1
        tangent = np.zeros(self._starts[entry + 1] - self._starts[entry])
        tangent[number - self._starts[entry]] = 1
        if not self._differences[entry]:
            return self._pass(entry, x, tangent)
        image = self._image_at(x)
        return image, self._difference(image, x, entry, number - self._starts[entry])

    def derivatives(self, x: Array) -> Image:
        """Derivatives (n, H, W, 3) of the image by all numbers."""
        found = [one for entry in range(len(self._parameters)) for one in self.jacobian(x, entry)[1]]
        return np.array(found).reshape(-1, self._size.height, self._size.width, 3)

    def jacobian(self, x: Array, entry: int = 0) -> tuple[Image, list[Image]]:
        """Image, and its derivatives (H, W, 3) by all numbers of an entry.

        One recording makes them all. It takes less time than a call of :meth:`derivative` for each number, mostly where images
        are small, but its first call takes longer.
        """
        first, end = self._starts[entry], self._starts[entry + 1]
        if self._differences[entry]:
            return self._image_at(x), [self.derivative(x, number)[1] for number in range(first, end)]
        if entry not in self._units:
            self._units[entry] = [_input(row) for row in np.eye(end - first)]
        with self.scene_at(x):
            image, derivatives = self._jacobians[entry](_input(x[: self.count]), self._units[entry], self.values, self._renderer)
            return self._shaped(image), [self._shaped(derivative) for derivative in derivatives]

    def _image_at(self, x: Array) -> Image:
        """The image, kept for the next call with the same numbers."""
        if self._kept is None or self._kept[1] is not self.values or not np.array_equal(self._kept[0], x):
            self._kept = x.copy(), self.values, self.image(x).copy()
        return self._kept[2]

    def _difference(self, image: Image, x: Array, entry: int, own: int) -> Image:
        """The derivative (H, W, 3) by one of an entry's numbers, from the image at x and one on the side with more room."""
        parameter, number = self._parameters[entry], self._starts[entry] + own
        low, high = (np.broadcast_to(parameter.scale.number(bound), len(parameter.labels)) for bound in parameter.natural)
        end = x.copy()
        end[number] += _DIFFERENCE if high[own] - x[number] >= x[number] - low[own] else -_DIFFERENCE
        return np.asarray((self._elsewhere(end) - image) / (end[number] - x[number]), np.float32)

    def _elsewhere(self, x: Array) -> Image:
        """Image at other numbers than those that Mitsuba's objects have now."""
        held, self._held = self._held, 0
        try:
            return self.image(x).copy()
        finally:
            self._held = held

    def gradient(self, x: Array, target: Image, weight: Image, factors: Image, limit: float) -> list[Float]:
        """Derivatives of a loss by all ``values``, Float each.

        The loss is the sum over pixels of ``weight`` (H, W, 1) times the Huber loss (``limit``) of factors image - target (both
        (H, W, 3)).
        """
        pixels = [device_array(mi.Float, self._planes(plane).astype(np.float32)) for plane in (target, weight, factors)]
        numbers, bound = _input(x[: self.count]), device_array(mi.Float, np.array([limit], np.float32))
        with self.scene_at(x):
            return list(self._gradient(numbers, self.values, pixels, bound, self._renderer))

    def pulled(self, x: Array, adjoint: Image) -> list[Float]:
        """Derivatives of a loss by all ``values``, Float each, from its derivative (H, W, 3) by the image at the numbers x."""
        pixels = self._planes(adjoint) if self._channels == 3 else np.ravel(adjoint.sum(2))
        given, numbers = [device_array(mi.Float, pixels.astype(np.float32))], _input(x[: self.count])
        with self.scene_at(x):
            return list(self._pulled(numbers, self.values, given, mi.Float(0), self._renderer))

    @contextmanager
    def scene_at(self, x: Array) -> Iterator[None]:
        """Context in which Mitsuba's objects have the values of the numbers x (n,). Passes at x are faster within one."""
        if self._held or not (any(self._keys) or self._arrays):
            yield
            return
        scene = self._renderer.data.scene
        restore = set_values(scene, self.change(x), all_values=False)
        self._held += 1
        try:
            yield
        finally:
            self._held -= 1
            restore()

    def _keys_of_entries(self) -> list[tuple[str, ...]]:
        """Names of Mitsuba's values that each entry changes."""
        change, found = SceneChange(self._renderer), list[tuple[str, ...]]()
        with dr.suspend_grad():
            for parameter in self._parameters:
                before = {*change.values, *change.factors}
                parameter.put([mi.Float(0)] * len(parameter.labels), change)
                found.append(tuple(key for key in (*change.values, *change.factors) if key not in before))
        return found

    def change(self, x: Array) -> SceneChange:
        """The change of the scene at the numbers x (n,), detached."""
        change = SceneChange(self._renderer)
        with dr.suspend_grad():
            for k, parameter in enumerate(self._parameters):
                parameter.put([mi.Float(v) for v in x[self._starts[k] : self._starts[k + 1]]], change)
            for array, values in zip(self._arrays, self.values, strict=True):
                array.put(values, change)
        return change

    def _pass(self, entry: int, x: Array, tangent: Array) -> tuple[Image, Image]:
        numbers, step = _input(x[: self.count]), _input(tangent)
        recorded = self._passes[entry] if entry >= 0 else self._image
        with self.scene_at(x):
            image, derivative = recorded(numbers, step, self.values, self._renderer)
            return self._shaped(image), self._shaped(derivative)

    def _shaped(self, image: Float) -> Image:
        pixels = image.numpy().reshape(self._size.height, self._size.width, -1)
        return pixels if self._channels == 3 else np.repeat(pixels, 3, 2)

    def _planes(self, image: Image) -> Image:
        """Pixels (H W C,) in as many channels as the film has, of an image (H, W, 1 or 3)."""
        wide = np.broadcast_to(image, (self._size.height, self._size.width, 3))
        return np.ravel(wide if self._channels == 3 else wide.mean(2))

    @property
    def _channels(self) -> int:
        return self._renderer.data.cameras(self._sensor)[0].channels

    def _camera(self, record: Sensor) -> Sensor:
        """A sensor whose picture, its crop window alone, has the size of this view and a box filter."""
        film, crop, (left, top) = record.film_size, record.crop_size, record.crop_offset
        columns, rows = film.width / crop.width, film.height / crop.height
        # The window as a film of its own: a narrower angle of view, and another principal point.
        point = mi.Point2f(
            0.5 - 0.5 * columns * (1 - 2 * record.principal_point.x - 2 * left / film.width),
            0.5 - 0.5 * rows * (1 - 2 * record.principal_point.y - 2 * top / film.height),
        )
        half = dr.atan(dr.tan(record.x_fov * (0.5 * math.pi / 180)) / columns)
        aspect = record.pixel_aspect * (crop.width * self._size.height) / (crop.height * self._size.width)
        return replace(
            record,
            x_fov=half * (2 * 180 / math.pi),
            principal_point=point,
            film_size=self._size,
            crop_size=self._size,
            crop_offset=(0, 0),
            filter=Filter("BoxFilter", 0.5, 0),
            sample_border=False,
            film_column=0,
            alpha=False,
            pixel_aspect=aspect,
        )

    def _recorded(self, entry: int) -> Any:  # Any: a function for dr.freeze
        """The pass of one entry: image, and its derivative along a tangent of the entry's numbers. -1: of none."""

        def derivative(x: Float, tangent: Float, values: list[Float], renderer: Renderer) -> tuple[Float, Float]:
            every = self._numbers(x)
            for j, number in enumerate(every[entry] if entry >= 0 else ()):
                dr.enable_grad(number)
                dr.set_grad(number, dr.gather(mi.Float, tangent, mi.UInt32(j)))
            with dr.suspend_grad(when=entry < 0), self._rendered(renderer, every, values, entry, arrays=False) as image:
                if entry < 0:
                    return image, mi.Float(image)
                dr.forward_to(image, flags=dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad)
                change = dr.grad(image)
                dr.eval(image, change)
            return dr.detach(image), change

        return derivative

    def _recorded_jacobian(self, entry: int) -> Any:  # Any: a function for dr.freeze
        """The pass of :meth:`jacobian`. ``units``: a tangent of the entry's numbers for each derivative."""
        one = self._recorded(entry)

        def jacobian(x: Float, units: list[Float], values: list[Float], renderer: Renderer) -> tuple[Float, list[Float]]:
            if renderer.soft or self._keys[entry]:
                # Sums over samples, and materials, clear the graph on the way.
                passes = [one(x, unit, values, renderer) for unit in units]
                return passes[0][0], [derivative for _, derivative in passes]
            every = self._numbers(x)
            dr.enable_grad(every[entry])
            with traversed_again(), self._rendered(renderer, every, values, entry, arrays=False) as image:
                derivatives = []
                for k, unit in enumerate(units):
                    for j, number in enumerate(every[entry]):
                        dr.set_grad(number, dr.gather(mi.Float, unit, mi.UInt32(j)))
                    # The graph stays for the next tangent: all of them share one image.
                    clear = dr.ADFlag.ClearVertices if k < len(units) - 1 else dr.ADFlag.ClearEdges
                    dr.forward_to(image, flags=clear | dr.ADFlag.AllowNoGrad)
                    derivatives.append(dr.grad(image))
                    dr.clear_grad(image)
                dr.eval(image, derivatives)
            return dr.detach(image), derivatives

        return jacobian

    def _numbers(self, x: Float) -> list[list[Float]]:
        """The numbers of each entry."""
        return [
            [dr.gather(mi.Float, x, mi.UInt32(j)) for j in range(self._starts[k], self._starts[k + 1])]
            for k in range(len(self._parameters))
        ]

    def _recorded_gradient(self, adjoint: Callable[[Float, list[Float], Float], Float]) -> Any:  # Any: a function for dr.freeze
        """The pass of :meth:`gradient`, or of :meth:`pulled`. ``adjoint``: derivative by the image, from image and inputs."""

        def gradient(x: Float, values: list[Float], pixels: list[Float], limit: Float, renderer: Renderer) -> list[Float]:
            numbers = self._numbers(x)
            own = [mi.Float(dr.detach(one)) for one in values]
            dr.enable_grad(own)
            with self._rendered(renderer, numbers, own, -1, arrays=True) as image:
                dr.set_grad(image, adjoint(dr.detach(image), pixels, limit))
                dr.enqueue(dr.ADMode.Backward, image)
                dr.traverse(dr.ADMode.Backward)
                gradients = [dr.grad(one) for one in own]
                dr.eval(gradients)
            return gradients

        return gradient

    @contextmanager
    def _rendered(
        self, renderer: Renderer, numbers: Sequence[Sequence[Float]], values: Sequence[Float], entry: int, *, arrays: bool
    ) -> Iterator[Float]:
        """Context of a flat image, attached.

        Mitsuba's objects have their values already. Those of ``entry``, and of the arrays if asked for, are attached until the
        context ends: derivatives look materials up once more.
        """
        change = SceneChange(renderer)
        for parameter, own in zip(self._parameters, numbers, strict=True):
            parameter.put(own, change)
        for array, one in zip(self._arrays, values, strict=True):
            array.put(one, change)
        mine = self._keys[entry] if entry >= 0 else ()
        attached = replace(
            change,
            values={key: parts for key, parts in change.values.items() if key in mine},
            arrays=change.arrays if arrays else {key: array for key, array in change.arrays.items() if key in mine},
        )
        restore = set_values(renderer.data.scene, attached)
        try:
            image: TensorXf = renderer.render(
                vertex_positions=change.vertices or None,
                transforms=change.placements or None,
                lights=change.lights or None,
                sensor=self._camera(change.camera(self._sensor)),
                spp=self._spp,
            )
            yield image.array
        finally:
            restore()


def _of_huber(image: Float, pixels: list[Float], limit: Float) -> Float:
    """Derivative of the loss of :meth:`View.gradient` by the image."""
    target, weight, factors = pixels
    return weight * factors * dr.clip(factors * image - target, -limit, limit)


def _given(image: Float, pixels: list[Float], limit: Float) -> Float:
    """The derivative by the image that was given to :meth:`View.pulled`."""
    return pixels[0]


def _input(numbers: Array) -> Float:
    """Numbers as an input of a recording. Dr.Jit 1.5 aborts the process at arrays without entries."""
    return device_array(mi.Float, numbers if len(numbers) else np.zeros(1))


def _area_light_samples(settings: RenderSettings, quality: Quality) -> int | str:
    """Points on area lights, not more than the quality has."""
    chosen = settings.area_light_samples
    if not isinstance(chosen, int):
        return chosen if quality.light_samples >= MOST else quality.light_samples
    return max(1, min(chosen, quality.light_samples))


def _at(renderer: Renderer, quality: Quality, pixels: int) -> Renderer:
    """A copy of a renderer at a quality, for images of so many pixels, with a fit of the shadow maps of its own."""
    settings = renderer.settings
    changed = replace(
        settings,
        shadow=replace(settings.shadow, resolution=min(quality.texels, settings.shadow.resolution)),
        area_light_samples=_area_light_samples(settings, quality),
        environment_light_samples=max(1, min(settings.environment_light_samples, 2 * quality.light_samples)),
        soft_map_resolution=min(settings.soft_map_resolution, quality.soft_texels),
    )
    copied = copy.deepcopy(replace(renderer, settings=changed)).with_maps_for(pixels)
    return copied.with_replanned_lights() if copied.soft else copied
