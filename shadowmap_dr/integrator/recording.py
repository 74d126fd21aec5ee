"""Renderings that are recorded once and replayed while only numbers change."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.arrays import own_memory
from ..jit.frozen import Frozen
from ..jit.pytree import attached_places, tree_map
from ..rendering.renderer import Renderer
from .deferred import backward, pass_on


class FrozenPasses:
    """The image of a renderer and the gradients of its data, each recorded.

    Dr.Jit records anew where more than numbers has changed: sizes, types, settings, and how many objects there are in Mitsuba.
    The backward pass renders again, since nothing that is computed in one recording can wait for the other.
    """

    def __init__(self) -> None:
        self._image, self._gradients = Frozen(_image), Frozen(_gradients)

    def image(self, spp: int, renderer: Renderer) -> tuple[Any, Any, Any]:
        """(detached image, fit of the shadow maps, of those of extended lights)."""
        with dr.suspend_grad():
            return self._image(spp, plain(renderer))

    def backward(self, spp: int, gradient: Any, renderer: Renderer) -> None:
        """Add the gradients of <image, gradient> to all that the renderer's data are attached to."""
        places, outer = attached_places(renderer.data)
        if not outer:
            return
        pass_on(outer, self._gradients(spp, places, _owned(gradient), plain(renderer)))

    @property
    def recordings(self) -> int:
        """Number of recordings so far."""
        return self._image.n_recordings + self._gradients.n_recordings


def _owned(gradient: Any) -> Any:
    """The detached gradient, not in memory of NumPy's or PyTorch's, whose alignment a recording would be particular about."""
    return own_memory(gradient) if gradient.array.state == dr.VarState.Evaluated else dr.detach(gradient)


def _image(spp: int, renderer: Renderer) -> tuple[Any, Any, Any]:
    image = renderer.render(spp=spp)
    return image, renderer.frusta, renderer.soft_frusta


def _gradients(spp: int, places: tuple[int, ...], gradient: Any, renderer: Renderer) -> list[Any]:
    """Gradients of the arrays at some places of the renderer's data."""
    leaves = []
    place = count()

    def attached(array: Any) -> Any:
        if next(place) not in places:
            return array
        leaf = dr.detach(array) + 0
        dr.enable_grad(leaf)
        leaves.append(leaf)
        return leaf

    backward(renderer.with_data(tree_map(renderer.data, attached)).render(spp=spp), gradient)
    return [dr.grad(leaf) for leaf in leaves]


def plain(renderer: Renderer) -> Renderer:
    """A renderer with detached data that differ in numbers only between cameras of one kind.

    All numbers lie in memory, since constants would be part of a recording, and so would that a camera's numbers are those of one
    of the scene's.
    """
    data = tree_map(renderer.data, dr.detach)
    one = dr.opaque(mi.Float, 1)  # Dr.Jit would leave out a product with the constant
    copies = tree_map(data.sensors, lambda array: array * one)
    data = replace(data, sensors=tuple(tuple(replace(camera, name="") for camera in cameras) for cameras in copies))
    renderer = replace(renderer, data=data)
    dr.make_opaque(data, renderer.frusta, renderer.soft_frusta)
    return renderer
