"""Renderings that are recorded once and replayed while only numbers change."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import drjit as dr
import mitsuba as mi

from ..jit.arrays import own_memory
from ..jit.frozen import Frozen
from ..jit.pytree import attached_places, tree_map
from ..jit.types import AnyArray, TensorXf
from ..rendering.extended_lights import SoftFrusta
from ..rendering.renderer import Renderer
from ..shadow import Frusta
from .deferred import backward, pass_on


class FrozenPasses:
    """Two recordings: of a renderer's image, and of the gradients of its data.

    Dr.Jit records anew when more than numbers has changed: sizes, types, settings, the number of objects in Mitsuba. The backward
    pass renders again, since one recording cannot use the intermediate results of another.
    """

    def __init__(self) -> None:
        self._image, self._gradients = Frozen(_image), Frozen(_gradients)

    def image(self, spp: int, renderer: Renderer) -> tuple[TensorXf, Frusta | None, SoftFrusta]:
        """(detached image, frusta of the shadow maps, frusta of extended lights' shadow maps)."""
        with dr.suspend_grad():
            return self._image(spp, plain(renderer))

    def backward(self, spp: int, gradient: TensorXf, renderer: Renderer) -> None:
        """Add the gradients of <image, gradient> to everything that the renderer's data are attached to."""
        places, outer = attached_places(renderer.data)
        if not outer:
            return
        pass_on(outer, self._gradients(spp, places, _owned(gradient), plain(renderer)))

    @property
    def recordings(self) -> int:
        """Number of recordings so far."""
        return self._image.n_recordings + self._gradients.n_recordings


def _owned(gradient: TensorXf) -> TensorXf:
    """The detached gradient in Dr.Jit's own memory: a recording depends on the alignment of memory of NumPy or PyTorch."""
    return own_memory(gradient) if gradient.array.state == dr.VarState.Evaluated else dr.detach(gradient)


def _image(spp: int, renderer: Renderer) -> tuple[TensorXf, Frusta | None, SoftFrusta]:
    image = renderer.render(spp=spp)
    return image, renderer.frusta, renderer.soft_frusta


def _gradients(spp: int, places: tuple[int, ...], gradient: TensorXf, renderer: Renderer) -> list[AnyArray]:
    """Gradients of the arrays at some places of the renderer's data."""
    leaves: list[AnyArray] = []
    place = count()

    def attached(array: AnyArray) -> AnyArray:
        if next(place) not in places:
            return array
        leaf = dr.detach(array) + 0
        dr.enable_grad(leaf)
        leaves.append(leaf)
        return leaf

    backward(renderer.with_data(tree_map(renderer.data, attached)).render(spp=spp), gradient)
    return [dr.grad(leaf) for leaf in leaves]


def plain(renderer: Renderer) -> Renderer:
    """A renderer with detached data, of which one recording serves all cameras of one kind.

    All numbers are evaluated copies: a recording would include constants, and also the fact that a camera shares its arrays with
    a sensor of the scene.
    """
    data = tree_map(renderer.data, dr.detach)
    one = dr.opaque(mi.Float, 1)  # Dr.Jit optimises a product with the literal 1 away
    copies = tree_map(data.sensors, lambda array: array * one)
    data = replace(data, sensors=tuple(tuple(replace(camera, name="") for camera in cameras) for cameras in copies))
    renderer = replace(renderer, data=data)
    dr.make_opaque(data, renderer.frusta, renderer.soft_frusta)
    return renderer
