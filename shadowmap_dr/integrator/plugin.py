"""The Mitsuba plug-in ``shadowmap``: a thin shell over :class:`shadowmap_dr.Renderer`.

``import shadowmap_dr`` registers it for every variant ``*_ad_rgb`` and ``*_ad_mono`` that is or will be set; in others, loading
it raises a ``ShadowmapError``. The module itself holds no types of a variant and no state: what a scene needs once (topology,
the plan of its shadow maps, their frusta) lives in the integrator that renders it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import ShadowmapError
from ..jit.gpu import keep_registers
from ..rendering.film.aovs import aov_names
from ..rendering.film.film import put_into_film
from ..rendering.settings import RenderSettings
from .deferred import DeferredImages, DetachedInputs, backward
from .nesting import Nesting
from .options import PLUGIN, Options
from .parameter_state import ParameterState
from .scene_cache import SceneCache, same_objects

# Scenes that one integrator remembers; each holds the scene's shapes in memory.
_REMEMBERED_SCENES = 4


@dataclass
class Shell:
    """The integrator without Mitsuba's base class: the same for all variants."""

    options: Options
    settings: RenderSettings
    scenes: list[SceneCache] = field(default_factory=list)
    light_names: tuple[str, ...] = ()

    @classmethod
    def from_properties(cls, props: Any) -> Shell:
        """Read and check the parameters."""
        options = Options.from_properties(props)
        return cls(options, options.render_settings())

    def primal(self, scene: Any, sensor: Any, spp: int) -> Any:
        """Detached image of ``mi.render``, which will ask for its derivatives later if parameters are attached."""
        _check_samples(spp)
        with dr.resume_grad():
            now = ParameterState.of(scene)
            record = self._record(scene, sensor, now)
            if self._replays:
                return record.replay(scene, sensor, spp or 1)
            waiting = record.waiting
            waiting.forget_older(now)
            # Where attributes of meshes are read, Mitsuba finds out with its own vertices where on a triangle they are wanted:
            # the image would hang on these.
            alone = not record.renderer.data.with_attributes() and waiting.welcomes(now, sensor)
            if alone and not dr.flag(dr.JitFlag.FreezingScope):
                inputs = DetachedInputs()
                image = record.render(scene, sensor, spp or 1, now, inputs)
                if dr.grad_enabled(image):
                    waiting.add(sensor, spp or 1, record.renderer.texels, image, inputs)
                return dr.detach(image)
        with dr.suspend_grad():
            return record.render(scene, sensor, spp or 1, now)

    def backward(self, scene: Any, sensor: Any, spp: int, gradient: Any) -> None:
        """Add the gradients of <image, gradient> to the scene's parameters."""
        _check_samples(spp)
        with dr.resume_grad():
            now = ParameterState.of(scene)
            record = self._record(scene, sensor, now)
            if self._replays and record.replay_backward(scene, sensor, spp or 1, gradient):
                return
            pending = record.waiting.take(now, sensor, spp or 1)
            if pending is not None:
                pending.backward(gradient, record.data(scene, sensor))
                return
            image = record.render(scene, sensor, spp or 1, now)
            if dr.grad_enabled(image):
                backward(image, gradient)

    def image(self, scene: Any, sensor: Any, spp: int) -> Any:
        """Attached image. ``spp`` 0 means not given: one sample, anti-aliased."""
        _check_samples(spp)
        with dr.resume_grad():
            now = ParameterState.of(scene)
        return self._record(scene, sensor, now).render(scene, sensor, spp or 1, now)

    @property
    def _replays(self) -> bool:
        return self.options.recorded and not dr.flag(dr.JitFlag.FreezingScope)

    def channel_names(self) -> list[str]:
        """Names of the further channels, in order; those of ``visibility`` follow the lights of the scene rendered last."""
        names = []
        for label, name in self.options.labelled_aovs:
            names += [label + channel[len(name) :] for channel in aov_names((name,), list(self.light_names))]
        return names

    def _record(self, scene: Any, sensor: Any, now: ParameterState) -> SceneCache:
        for record in self.scenes:
            if record.matches(scene, now):
                break
        else:
            # The scene is told from others by its shapes: it may be here again with another topology.
            shapes = tuple(scene.shapes())
            known = any(same_objects(other.parts[: len(shapes)], shapes) for other in self.scenes)
            record = SceneCache.build(scene, sensor, self.settings, self.options.tessellation, warn=not known)
        self.scenes = [record, *(other for other in self.scenes if other is not record)][:_REMEMBERED_SCENES]
        self.light_names = record.lights
        return record


def _check_samples(spp: int) -> None:
    if spp < 0:
        raise ShadowmapError(f"spp is {spp}: give a positive number, or 0 for one anti-aliased sample.")


def sensor_of(scene: Any, sensor: Any) -> Any:
    """The ``mi.Sensor`` meant by a number or an object."""
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if not -len(sensors) <= sensor < len(sensors):
        raise ShadowmapError(f"There is no sensor {sensor}: the scene has {len(sensors)}, counted from 0.")
    return sensors[sensor]


def make_class() -> type:
    """The integrator class for the current variant, whose base class is made anew for each."""

    # Not imported from `mitsuba.ad`: that would load the module a second time, which then stays with the first variant.
    class ShadowMapIntegrator(mi.ad.integrators.common.ADIntegrator):
        """Renders and differentiates with shadow maps. Parameters: :class:`Options`.

        ``spp`` not given (0) means one anti-aliased sample for each pixel; otherwise a grid of ``ceil(sqrt(spp)) ** 2``, at most
        16 x 16. The film's reconstruction filter and ``sample_border`` are heeded (not for the further channels of ``aovs``); the
        scene's sampler is not used, and ``seed`` changes nothing.
        """

        def __init__(self, props: Any) -> None:
            self.shell, self.nesting = Shell.from_properties(props), Nesting()
            super().__init__(props)

        def render(self, *arguments: Any, **named: Any) -> Any:
            """Image (H, W, C) without gradients. It is put into the sensor's film too, but not while a function is frozen.

            Takes Mitsuba's arguments: scene, sensor = 0, seed = 0, spp = 0, develop = True, evaluate = True.
            """
            self.nesting.note(arguments, named)
            return self._render(*arguments, **named)

        def _render(
            self, scene: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0, develop: bool = True, evaluate: bool = True
        ) -> Any:
            sensor = sensor_of(scene, sensor)
            if develop and not evaluate:  # through mi.render
                image = self.shell.primal(scene, sensor, spp)
                if not dr.flag(dr.JitFlag.FreezingScope):
                    put_into_film(sensor.film(), image, self.aov_names())
                return image
            with dr.suspend_grad():
                image = self.shell.image(scene, sensor, spp)
                put_into_film(sensor.film(), image, self.aov_names())
            return image if develop else mi.TensorXf()

        def render_forward(self, scene: Any, params: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> Any:
            """Derivative of the image (H, W, C) in the direction of the gradients that the parameters hold."""
            DeferredImages.forget_all()
            keep_registers()
            with dr.resume_grad():
                image = self.shell.image(scene, sensor_of(scene, sensor), spp)
                if not dr.grad_enabled(image):
                    return dr.zeros(mi.TensorXf, image.shape)
                # Gradients stay where they have come to: what hangs on the same parts of the graph, such as vertex normals that
                # Mitsuba has computed from vertices, gets there once only, and other images need it.
                dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
                return dr.grad(image)

        def render_backward(self, scene: Any, params: Any, grad_in: Any, sensor: Any = 0, seed: Any = 0, spp: int = 0) -> None:
            """Add the gradients of <image, grad_in> to the parameters."""
            self.shell.backward(scene, sensor_of(scene, sensor), spp, grad_in)
            dr.eval()

        def sample(self, *_: Any, **arguments: Any) -> Any:
            """Nothing along rays: ``aov`` asks for that beside its nested images, and throws it away. Refused to all others."""
            if not self.nesting.allows():
                raise ShadowmapError(
                    f"'{PLUGIN}' cannot be nested in integrators that sample single rays, such as moment: render it by itself, "
                    "or in aov."
                )
            if self.shell.options.aovs:
                raise ShadowmapError(
                    f"'{PLUGIN}' has channels of its own (aovs is {self.shell.options.aovs!r}), which aov cannot pass on: "
                    "leave them out, or render it by itself."
                )
            return mi.Spectrum(0), mi.Bool(False), [], None

        def aov_names(self) -> list[str]:
            """Names of the channels after colour and alpha."""
            return self.shell.channel_names()

        def to_string(self) -> str:
            return f"ShadowMapIntegrator[{', '.join(f'{k}={v!r}' for k, v in vars(self.shell.options).items())}]"

    return ShadowMapIntegrator


def register(old: str | None = None, new: str | None = None) -> None:
    """Make the plug-in known to the current variant, if there is one. Called by Mitsuba whenever the variant changes."""
    variant = new or mi.variant()
    if variant is not None:
        mi.register_integrator(PLUGIN, _constructor(variant))


def _constructor(variant: str) -> Callable[[Any], Any]:
    if variant.endswith(("_ad_rgb", "_ad_mono")):
        return make_class()

    def refuse(props: Any) -> Any:
        raise ShadowmapError(
            f"'{PLUGIN}' does not work with the variant {variant}: set one whose name ends in _ad_rgb or _ad_mono, "
            "for instance llvm_ad_rgb."
        )

    return refuse


def install() -> None:
    """Register the plug-in now and for all variants that will be set."""
    mi.detail.add_variant_callback(register)
    register()
