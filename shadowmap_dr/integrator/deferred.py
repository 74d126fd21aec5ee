"""Images that wait for their backward pass.

``mi.render`` asks an integrator for an image first, and for its derivatives later, when it has to render again unless it has kept
what the image was computed from.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr

from ..jit.gpu import keep_registers
from ..jit.pytree import attached_arrays, with_arrays
from ..scene.load import SceneData
from .parameter_state import ParameterState

#: Samples of pixels of all images that wait; each may hold half a kilobyte.
MOST_SAMPLES = 1 << 20
#: So many texels of shadow maps hold as much as one of these samples.
TEXELS = 6

# Parameters that an image is attached to through what is read from the scene, and in no other way. Materials and textures are
# evaluated by Mitsuba itself.
_READ = (
    "vertex_positions", "vertex_normals", "vertex_texcoords", "control_points", "to_world",
    "position", "intensity.value", "irradiance.value", "radiance.value", "cutoff_angle", "beam_width",
)  # fmt: skip


class DetachedInputs:
    """Vertices, lights and cameras of a scene as leaves of an AD graph of their own.

    What waits for a backward pass must not hang on the scene's parameters meanwhile, not even through what has been read from
    them: forward passes would run through it, and clear gradients on their way.
    """

    def __init__(self) -> None:
        self._leaves: list[Any] = []

    def instead_of(self, data: SceneData) -> SceneData:
        """The same data with leaves in the place of what is attached."""
        self._leaves = [dr.detach(array) + 0 for array in attached_arrays(data)]
        dr.enable_grad(self._leaves)
        return with_arrays(data, self._leaves)

    def backward(self, data: SceneData) -> None:
        """Pass the leaves' gradients on to the scene's parameters, through the same data, read again."""
        pass_on(attached_arrays(data), [dr.grad(leaf) for leaf in self._leaves])


@dataclass(frozen=True)
class DeferredImage:
    """An image that waits, what it is attached to, and the sensor's parameters at the time. ``texels``: of its shadow maps."""

    sensor: Any
    spp: int
    texels: int
    image: Any
    inputs: DetachedInputs
    camera: ParameterState

    @property
    def samples(self) -> int:
        """Of all pixels, about."""
        height, width = self.image.shape[:2]
        return height * width * self.spp

    @property
    def weight(self) -> int:
        """Measure of the image's memory, in samples."""
        return self.samples + self.texels // TEXELS

    def is_of(self, sensor: Any, spp: int) -> bool:
        """True if it shows what a sensor sees now."""
        return sensor is self.sensor and spp == self.spp and ParameterState.of(sensor).same(self.camera)

    def backward(self, gradient: Any, data: SceneData) -> None:
        """Add the gradients of <image, gradient> to the scene's parameters. ``data``: as read for the image."""
        backward(self.image, gradient)
        self.inputs.backward(data)


class DeferredImages:
    """The images of one state of a scene that wait for their backward passes: one for each sensor, as far as memory allows."""

    #: All there are.
    _everywhere: ClassVar[weakref.WeakSet[DeferredImages]] = weakref.WeakSet()

    def __init__(self) -> None:
        self._state: ParameterState | None = None
        self._images: list[DeferredImage] = []
        self._everywhere.add(self)

    @classmethod
    def forget_all(cls) -> None:
        """Drop all images, of all scenes. Calls of materials go to those of all scenes, so that images may hang on meshes whose
        attributes any of them reads; and forward passes come to what hangs there, and fail."""
        for waiting in cls._everywhere:
            waiting._images = []

    def forget_older(self, now: ParameterState) -> None:
        """Drop images of the scene before its parameters changed. ``now``: those of the scene."""
        if self._state is None or not now.same(self._state):
            self._state, self._images = now, []

    def welcomes(self, now: ParameterState, sensor: Any) -> bool:
        """True if an image of the scene as it is now would be attached to :class:`DetachedInputs` alone."""
        attached = (*now.attached, *ParameterState.of(sensor).attached)
        return bool(attached) and all(name.endswith(_READ) for name in attached)

    def add(self, sensor: Any, spp: int, texels: int, image: Any, inputs: DetachedInputs) -> None:
        """Let an attached image wait. Those that have waited longest make room for it."""
        new = DeferredImage(sensor, spp, texels, image, inputs, ParameterState.of(sensor))
        others = [other for other in self._images if other.sensor is not sensor]
        self._images = [*others, new] if new.samples <= MOST_SAMPLES else others
        # Whatever its maps are, the latest one waits: with a single view, nothing would be saved by rendering it again.
        while len(self._images) > 1 and sum(one.weight for one in self._images) > MOST_SAMPLES:
            self._images.pop(0)

    def take(self, now: ParameterState, sensor: Any, spp: int) -> DeferredImage | None:
        """The image of a scene as a sensor sees it now, if it waits. It does so no longer."""
        self.forget_older(now)
        found = next((one for one in self._images if one.is_of(sensor, spp)), None)
        self._images = [one for one in self._images if one is not found]
        return found


def pass_on(arrays: list[Any], gradients: list[Any]) -> None:
    """Add gradients to all that arrays are attached to."""
    for array, gradient in zip(arrays, gradients, strict=True):
        dr.accum_grad(array, gradient)
    _traverse(arrays)


def backward(image: Any, gradient: Any) -> None:
    """Add the gradients of <image, gradient> to all that an image is attached to."""
    dr.set_grad(image, gradient)
    _traverse(image)


def _traverse(end: Any) -> None:
    """Backwards from what has gradients. The graph stays: another image may hang on the same parts of it, such as those that
    Mitsuba's shapes hold of what their vertices were computed from."""
    keep_registers()
    dr.enqueue(dr.ADMode.Backward, end)
    dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
