"""Images that wait for their backward pass.

``mi.render`` asks an integrator for an image first and for its derivatives later. Then the integrator has to render again, unless
it has kept the AD graph of the image.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..jit.gpu import keep_registers
from ..jit.pytree import attached_arrays, with_arrays
from ..jit.types import AnyArray, TensorXf
from ..rendering.waiting import MOST_SAMPLES, TEXELS
from ..scene.load import SceneData
from ..scene.mitsuba_meshes import VERTEX_PARAMETERS
from .parameter_state import ParameterState

# Parameters that an image depends on only through the records of its scene. Materials and textures, in contrast, are evaluated by
# Mitsuba itself.
_READ = (
    *sorted(VERTEX_PARAMETERS), "control_points", "to_world",
    "position", "intensity.value", "irradiance.value", "radiance.value", "cutoff_angle", "beam_width",
)  # fmt: skip
#: Those of lights that change neither visible surfaces nor shadow maps.
COLOURS_OF_LIGHTS = ("intensity.value", "irradiance.value", "radiance.value")


class DetachedInputs:
    """Vertices, lights and cameras of a scene as leaves of a separate AD graph.

    A waiting image must not be attached to the scene's parameters, not even through records read from them: forward passes would
    run through its graph and clear gradients on their way.
    """

    def __init__(self) -> None:
        self._leaves: list[AnyArray] = []

    def instead_of(self, data: SceneData) -> SceneData:
        """The same data with leaves in the place of attached arrays."""
        self._leaves = [dr.detach(array) + 0 for array in attached_arrays(data)]
        dr.enable_grad(self._leaves)
        return with_arrays(data, self._leaves)

    def backward(self, data: SceneData) -> None:
        """Pass the leaves' gradients on to the scene's parameters. ``data``: the same data, read again."""
        pass_on(attached_arrays(data), [dr.grad(leaf) for leaf in self._leaves])


@dataclass(frozen=True)
class DeferredImage:
    """A waiting image, its inputs, and the sensor's parameters when it was rendered. ``texels``: of its shadow maps."""

    sensor: mi.Sensor
    spp: int
    texels: int
    image: TensorXf
    inputs: DetachedInputs
    camera: ParameterState

    @property
    def samples(self) -> int:
        """Approximate number of samples of all pixels."""
        height, width = self.image.shape[:2]
        return height * width * self.spp

    @property
    def weight(self) -> int:
        """Measure of the image's memory, in samples."""
        return self.samples + self.texels // TEXELS

    def is_of(self, sensor: mi.Sensor, spp: int) -> bool:
        """True if a sensor would take the same image now."""
        return sensor is self.sensor and spp == self.spp and ParameterState.of(sensor).same(self.camera)

    def backward(self, gradient: TensorXf, data: SceneData) -> None:
        """Add the gradients of <image, gradient> to the scene's parameters. ``data``: as read for the image."""
        backward(self.image, gradient)
        self.inputs.backward(data)


class DeferredImages:
    """The waiting images of one state of a scene: one for each sensor, as far as memory allows."""

    #: All objects of this class.
    _everywhere: ClassVar[weakref.WeakSet[DeferredImages]] = weakref.WeakSet()

    def __init__(self) -> None:
        self._state: ParameterState | None = None
        self._images: list[DeferredImage] = []
        self._everywhere.add(self)

    @classmethod
    def forget_all(cls) -> None:
        """Drop all images, of all scenes.

        Mitsuba's calls of materials reach the materials of all scenes, so an image may be attached to any mesh with attributes.
        A forward pass that reaches the graph of such an image fails.
        """
        for waiting in cls._everywhere:
            waiting._images = []

    def forget_older(self, now: ParameterState) -> None:
        """Drop images of earlier states of the scene. ``now``: its current parameters."""
        if self._state is None or not now.same(self._state):
            self._state, self._images = now, []

    def welcomes(self, attached: tuple[str, ...]) -> bool:
        """True if an image would depend on the attached parameters through :class:`DetachedInputs` only.

        ``attached``: names of the scene's and the sensor's.
        """
        return bool(attached) and all(name.endswith(_READ) for name in attached)

    def add(self, sensor: mi.Sensor, spp: int, texels: int, image: TensorXf, inputs: DetachedInputs) -> None:
        """Let an attached image wait. The images that have waited longest make room for it."""
        new = DeferredImage(sensor, spp, texels, image, inputs, ParameterState.of(sensor))
        others = [other for other in self._images if other.sensor is not sensor]
        self._images = [*others, new] if new.samples <= MOST_SAMPLES else others
        # The latest image waits whatever the size of its maps: rendering it again would take as much memory.
        while len(self._images) > 1 and sum(one.weight for one in self._images) > MOST_SAMPLES:
            self._images.pop(0)

    def take(self, now: ParameterState, sensor: mi.Sensor, spp: int) -> DeferredImage | None:
        """Remove and return the waiting image of the current scene and sensor; None if there is none."""
        self.forget_older(now)
        found = next((one for one in self._images if one.is_of(sensor, spp)), None)
        self._images = [one for one in self._images if one is not found]
        return found


def pass_on(arrays: list[AnyArray], gradients: list[AnyArray]) -> None:
    """Add gradients to everything that arrays are attached to."""
    for array, gradient in zip(arrays, gradients, strict=True):
        dr.accum_grad(array, gradient)
    _traverse(arrays)


def backward(image: TensorXf, gradient: TensorXf) -> None:
    """Add the gradients of <image, gradient> to everything that an image is attached to."""
    dr.set_grad(image, gradient)
    _traverse(image)


def _traverse(end: AnyArray | list[AnyArray]) -> None:
    """Propagate gradients backwards from ``end``. The graph stays: other images may depend on the same parts of it, such as those
    between the vertices of Mitsuba's shapes and the parameters they are computed from."""
    keep_registers()
    dr.enqueue(dr.ADMode.Backward, end)
    dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)
