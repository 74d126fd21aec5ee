"""Renderings that are recorded once and replayed while only numbers change."""

from __future__ import annotations

from dataclasses import replace
from itertools import count

import drjit as dr
import mitsuba as mi

from ..jit.arrays import own_memory
from ..jit.frozen import Frozen
from ..jit.handover import NO_RESULTS, PackedResults, keeping, using
from ..jit.pytree import attached_places, tree_map
from ..jit.types import AnyArray, TensorXf
from ..rendering.extended_lights import SoftFrusta
from ..rendering.renderer import Renderer
from ..scene.load import SceneData
from ..shadow import Frusta
from .deferred import backward, pass_on


class FrozenPasses:
    """Two recordings: of a renderer's image, and of the gradients of its data.

    Dr.Jit records anew when more than numbers has changed: sizes, types, settings, the number of objects in Mitsuba. The backward
    pass traces the image again, but takes what the image has evaluated from there, if it is handed over.
    """

    def __init__(self) -> None:
        self._image, self._gradients = Frozen(_image), Frozen(_gradients)

    def image(self, spp: int, renderer: Renderer, keep: bool) -> tuple[TensorXf, Frusta | None, SoftFrusta, PackedResults]:
        """(detached image, frusta of the shadow maps, frusta of extended lights' shadow maps, results for the backward pass).

        ``renderer``: from :func:`plain`. ``keep``: whether there are such results.
        """
        with dr.suspend_grad():
            return self._image(spp, renderer, keep)

    def backward(self, spp: int, gradient: TensorXf, data: SceneData, renderer: Renderer, results: PackedResults) -> None:
        """Add the gradients of <image, gradient> to everything that ``data`` is attached to.

        ``renderer``: from :func:`plain`, with the same data, detached. ``results``: of the same image, or of none.
        """
        places, outer = attached_places(data)
        if not outer:
            return
        pass_on(outer, self._gradients(spp, places, _owned(gradient), renderer, results))

    @property
    def recordings(self) -> int:
        """Number of recordings so far."""
        return self._image.n_recordings + self._gradients.n_recordings


def _owned(gradient: TensorXf) -> TensorXf:
    """The detached gradient in Dr.Jit's own memory: a recording depends on the alignment of memory of NumPy or PyTorch."""
    return own_memory(gradient) if gradient.array.state == dr.VarState.Evaluated else dr.detach(gradient)


def _image(spp: int, renderer: Renderer, keep: bool) -> tuple[TensorXf, Frusta | None, SoftFrusta, PackedResults]:
    with keeping() as results:
        image = renderer.render(spp=spp)
    return image, renderer.frusta, renderer.soft_frusta, PackedResults.of(results) if keep else NO_RESULTS


def _gradients(
    spp: int,
    places: tuple[int, ...],
    gradient: TensorXf,
    renderer: Renderer,
    results: PackedResults,
) -> list[AnyArray]:
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

    renderer = renderer.with_data(tree_map(renderer.data, attached))
    with using(results.unpacked()):
        image = renderer.render(spp=spp)
    backward(image, gradient)
    return [dr.grad(leaf) for leaf in leaves]


def plain(renderer: Renderer) -> Renderer:
    """A renderer with detached data, of which one recording serves all cameras of one kind.

    All numbers are evaluated copies: a recording would include constants, and also the fact that a camera shares its arrays with
    a sensor of the scene.
    """
    arrays: list[AnyArray] = []

    def kept(array: AnyArray) -> AnyArray:
        arrays.append(dr.detach(array))
        return arrays[-1]

    one = dr.opaque(mi.Float, 1)  # Dr.Jit optimises a product with the literal 1 away

    def copied(array: AnyArray) -> AnyArray:
        arrays.append(dr.detach(array) * one)
        return arrays[-1]

    copies = tree_map(renderer.data.sensors, copied)
    data = tree_map(replace(renderer.data, sensors=()), kept)
    data = replace(data, sensors=tuple(tuple(replace(camera, name="") for camera in cameras) for cameras in copies))
    renderer = replace(renderer, data=data)
    # The arrays alone: Dr.Jit would walk through the scene, too.
    dr.make_opaque(arrays, renderer.frusta, renderer.soft_frusta)
    return renderer
