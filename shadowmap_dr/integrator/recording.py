"""Renderings that are recorded once and replayed while only numbers change."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import count
from typing import Any

import drjit as dr

from ..jit.arrays import own_memory
from ..jit.call_data import restored_scalars
from ..jit.frozen import Frozen
from ..jit.handover import NO_RESULTS, PackedResults, keeping, second_computation
from ..jit.pytree import arrays_of, attached_places, tree_map, with_fields
from ..jit.types import AnyArray, TensorXf
from ..rendering.extended_lights import SoftFrusta
from ..rendering.renderer import Renderer
from ..scene.load import PARTS, SceneData
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

    def backward(
        self,
        spp: int,
        gradient: TensorXf,
        data: SceneData,
        renderer: Renderer,
        results: PackedResults,
        fields: tuple[str, ...],
    ) -> None:
        """Add the gradients of <image, gradient> to everything that ``data`` is attached to.

        Args:
            spp: samples of a pixel.
            gradient: of the image.
            data: current records of the scene.
            renderer: from :func:`plain`, with the same data, detached.
            results: of the same image, or of none.
            fields: of the data, those that may be attached.
        """
        places, outer = attached_places(_fields_of(data, fields))
        if not outer:
            return
        # The renderer's geometry does not tell which shapes carry gradients: images are read without any.
        changed = data.geometry.changed
        pass_on(outer, self._gradients(spp, (fields, places), changed, _owned(gradient), renderer, results))

    @property
    def recordings(self) -> int:
        """Number of recordings so far."""
        return self._image.n_recordings + self._gradients.n_recordings


def _owned(gradient: TensorXf) -> TensorXf:
    """The detached gradient in Dr.Jit's own memory: a recording depends on the alignment of memory of NumPy or PyTorch."""
    return own_memory(gradient) if gradient.array.state == dr.VarState.Evaluated else dr.detach(gradient)


def _image(spp: int, renderer: Renderer, keep: bool) -> tuple[TensorXf, Frusta | None, SoftFrusta, PackedResults]:
    with keeping() as results, restored_scalars():
        image = renderer.render(spp=spp)
    return image, renderer.frusta, renderer.soft_frusta, PackedResults.of(results) if keep else NO_RESULTS


def _gradients(
    spp: int,
    attached_to: tuple[tuple[str, ...], tuple[int, ...]],
    changed: tuple[str, ...] | None,
    gradient: TensorXf,
    renderer: Renderer,
    results: PackedResults,
) -> list[AnyArray]:
    """Gradients of the arrays at some places of some fields of the renderer's data. ``changed``: :attr:`Geometry.changed`."""
    leaves: list[AnyArray] = []
    (fields, places), place = attached_to, count()

    def attached(array: AnyArray) -> AnyArray:
        if next(place) not in places:
            return array
        leaf = dr.detach(array) + 0
        dr.enable_grad(leaf)
        leaves.append(leaf)
        return leaf

    data = with_fields(renderer.data, geometry=with_fields(renderer.data.geometry, changed=changed))
    found = dict(zip(fields, tree_map(_fields_of(data, fields), attached), strict=True))
    renderer = renderer.with_data(with_fields(data, **found))
    with restored_scalars():
        with second_computation(results):
            image = renderer.render(spp=spp)
        backward(image, gradient)
    return [dr.grad(leaf) for leaf in leaves]


def _fields_of(data: SceneData, fields: tuple[str, ...]) -> tuple[Any, ...]:  # Any: records of different types
    return tuple(getattr(data, field) for field in fields)


def plain(renderer: Renderer, known: Mapping[str, Any] | None = None) -> Renderer:  # Any: fields of different types
    """A renderer with detached data, of which one recording serves all cameras of one kind.

    All numbers are evaluated: a recording would include constants. ``known``: :data:`PARTS` of an earlier result, made from the
    same records.
    """
    arrays: list[AnyArray] = []

    def kept(array: AnyArray) -> AnyArray:
        # The same object without gradients, so that records of these arrays stay the same, too.
        arrays.append(dr.detach(array) if dr.grad_enabled(array) else array)
        return arrays[-1]

    def own(array: AnyArray) -> AnyArray:
        # Another object: a replay may write into its arguments, and these belong to Mitsuba's sensor.
        arrays.append(dr.detach(array))
        return arrays[-1]

    data, parts = renderer.data, dict(known or {})
    if "sensors" not in parts:
        sensors = tree_map(data.sensors, own)
        parts["sensors"] = tuple(tuple(with_fields(camera, name="") for camera in cameras) for cameras in sensors)
    for part in PARTS:
        if part not in parts:
            parts[part] = tree_map(getattr(data, part), kept)
    nothing: dict[str, Any] = dict.fromkeys(PARTS)
    rest = tree_map(with_fields(data, **nothing), kept)
    renderer = with_fields(renderer, data=with_fields(rest, **parts))
    # The arrays alone: Dr.Jit would walk through the scene, too.
    dr.make_opaque(arrays, arrays_of((renderer.frusta, renderer.soft_frusta)))
    return renderer
