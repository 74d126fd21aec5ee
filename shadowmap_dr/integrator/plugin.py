"""The Mitsuba plug-in ``shadowmap``: a thin shell over :class:`shadowmap_dr.Renderer`.

``import shadowmap_dr`` registers it for every variant ``*_ad_rgb`` and ``*_ad_mono`` that is or will be set; in others, loading
it raises a ``ShadowmapError``. The module itself holds no types of a variant and no state. The integrator that renders a scene
keeps the scene's state (topology, plan of the shadow maps, their frusta).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi

from ..errors import ShadowmapError
from ..jit.gpu import keep_registers
from ..jit.handover import derivatives_only
from ..jit.types import Bool, Color3f, Float, TensorXf, UInt32
from ..rendering.film.aovs import aov_names
from ..rendering.film.film import put_into_film
from ..rendering.settings import AUTO, RenderSettings
from .deferred import DeferredImages, DetachedInputs, backward
from .name import PLUGIN
from .nesting import Nesting
from .options import Options
from .parameter_state import ParameterState
from .scene_cache import SceneCache, SceneState, same_objects

# Scenes whose state one integrator keeps; each holds the scene's shapes in memory.
_REMEMBERED_SCENES = 4


@dataclass
class Shell:
    """The integrator without Mitsuba's base class: the same for all variants."""

    options: Options
    settings: RenderSettings
    scenes: list[SceneCache] = field(default_factory=list)
    light_names: tuple[str, ...] = ()

    @classmethod
    def from_properties(cls, props: mi.Properties) -> Shell:
        """Read and check the parameters."""
        options = Options.from_properties(props)
        return cls(options, options.render_settings())

    def primal(self, scene: mi.Scene, sensor: mi.Sensor, spp: int) -> TensorXf:
        """Detached image for ``mi.render``, which asks for its derivatives later if parameters are attached."""
        _check_samples(spp)
        with dr.resume_grad():
            now = ParameterState.of(scene)
            record = self._record(scene, sensor, now)
            freezing = dr.flag(dr.JitFlag.FreezingScope)
            if self.options.recorded is True and not freezing:
                return record.replay(scene, sensor, spp or 1, SceneState.of(scene, sensor, now))
            waiting = record.waiting
            waiting.forget_older(now)
            # Mitsuba looks up mesh attributes through its own vertices, so the image would be attached to these, too.
            state = SceneState.of(scene, sensor, now)
            alone = not record.renderer.data.with_attributes() and waiting.welcomes(state.attached)
            if alone and not freezing and self.options.recorded == AUTO and record.is_steady(state.attached, sensor, spp or 1):
                image = record.try_to_replay(scene, sensor, spp or 1, state)
                if image is not None:
                    return image
            if alone and not freezing:
                inputs = DetachedInputs()
                image = record.render(scene, sensor, spp or 1, now, inputs)
                if dr.grad_enabled(image):
                    waiting.add(sensor, spp or 1, record.renderer.texels, image, inputs)
                return dr.detach(image)
        with dr.suspend_grad():
            return record.render(scene, sensor, spp or 1, now)

    def backward(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, gradient: TensorXf) -> None:
        """Add the gradients of <image, gradient> to the scene's parameters."""
        _check_samples(spp)
        with dr.resume_grad():
            now = ParameterState.of(scene)
            record = self._record(scene, sensor, now)
            pending = record.waiting.take(now, sensor, spp or 1)
            if pending is not None:
                pending.backward(gradient, record.data(scene, sensor))
                return
            if self.options.recorded and not dr.flag(dr.JitFlag.FreezingScope):
                replay = record.replay_backward if self.options.recorded is True else record.try_to_replay_backward
                if replay(scene, sensor, spp or 1, gradient, SceneState.of(scene, sensor, now)):
                    return
            with derivatives_only():
                image = record.render(scene, sensor, spp or 1, now)
            if dr.grad_enabled(image):
                backward(image, gradient)

    def image(self, scene: mi.Scene, sensor: mi.Sensor, spp: int) -> TensorXf:
        """Attached image. ``spp`` 0, Mitsuba's default, means one sample, anti-aliased."""
        _check_samples(spp)
        with dr.resume_grad():
            now = ParameterState.of(scene)
        return self._record(scene, sensor, now).render(scene, sensor, spp or 1, now)

    def channel_names(self) -> list[str]:
        """Names of the AOV channels, in order; those of ``visibility`` follow the lights of the scene rendered last."""
        names = []
        for label, name in self.options.labelled_aovs:
            names += [label + channel[len(name) :] for channel in aov_names((name,), list(self.light_names))]
        return names

    def _record(self, scene: mi.Scene, sensor: mi.Sensor, now: ParameterState) -> SceneCache:
        for record in self.scenes:
            if record.matches(scene, now):
                break
        else:
            # A known scene with another topology has the same shapes; its omissions have been warned of.
            shapes = tuple(scene.shapes())
            known = any(same_objects(other.parts[: len(shapes)], shapes) for other in self.scenes)
            record = SceneCache.build(scene, sensor, self.settings, self.options.tessellation, warn=not known)
        self.scenes = [record, *(other for other in self.scenes if other is not record)][:_REMEMBERED_SCENES]
        self.light_names = record.lights
        return record


def _check_samples(spp: int) -> None:
    if spp < 0:
        raise ShadowmapError(f"spp is {spp}: give a positive number, or 0 for one anti-aliased sample.")


def sensor_of(scene: mi.Scene, sensor: int | mi.Sensor) -> mi.Sensor:
    """The ``mi.Sensor`` with a number, or the given object itself."""
    if not isinstance(sensor, int):
        return sensor
    sensors = scene.sensors()
    if not -len(sensors) <= sensor < len(sensors):
        raise ShadowmapError(f"There is no sensor {sensor}: the scene has {len(sensors)}, counted from 0.")
    return sensors[sensor]


def make_class() -> type:
    """The integrator class for the current variant. Its base class belongs to one variant."""

    # Not imported from `mitsuba.ad`: that would load a second copy of the module, which keeps the first variant.
    class ShadowMapIntegrator(mi.ad.integrators.common.ADIntegrator):
        """Renders and differentiates with shadow maps. Parameters: :class:`Options`.

        ``spp`` 0, the default, means one anti-aliased sample per pixel; other values a grid of ``ceil(sqrt(spp)) ** 2``, at most
        16 x 16. The film's reconstruction filter and ``sample_border`` apply to colour and alpha, not to the channels of
        ``aovs``. The scene's sampler and ``seed`` have no effect.
        """

        def __init__(self, props: mi.Properties) -> None:
            self.shell, self.nesting = Shell.from_properties(props), Nesting()
            super().__init__(props)

        def render(self, *arguments: Any, **named: Any) -> TensorXf:  # Any: arguments of ``_render``
            """Image (H, W, C) without gradients. It is put into the sensor's film too, but not while a function is frozen.

            Takes Mitsuba's arguments: scene, sensor = 0, seed = 0, spp = 0, develop = True, evaluate = True.
            """
            self.nesting.note(arguments, named)
            return self._render(*arguments, **named)

        def _render(
            self,
            scene: mi.Scene,
            sensor: int | mi.Sensor = 0,
            seed: UInt32 | int = 0,
            spp: int = 0,
            develop: bool = True,
            evaluate: bool = True,
        ) -> TensorXf:
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

        def render_forward(
            self, scene: mi.Scene, params: object, sensor: int | mi.Sensor = 0, seed: UInt32 | int = 0, spp: int = 0
        ) -> TensorXf:
            """Derivative of the image (H, W, C) in the direction of the gradients that the parameters hold."""
            DeferredImages.forget_all()
            keep_registers()
            with dr.resume_grad():
                with derivatives_only():
                    image = self.shell.image(scene, sensor_of(scene, sensor), spp)
                if not dr.grad_enabled(image):
                    return dr.zeros(mi.TensorXf, image.shape)
                # Only edges are cleared. Gradients of shared parts of the graph, such as vertex normals that Mitsuba has computed
                # from vertices, are propagated only once, and other images need them.
                dr.forward_to(image, flags=dr.ADFlag.ClearEdges)
                return dr.grad(image)

        def render_backward(
            self,
            scene: mi.Scene,
            params: object,
            grad_in: TensorXf,
            sensor: int | mi.Sensor = 0,
            seed: UInt32 | int = 0,
            spp: int = 0,
        ) -> None:
            """Add the gradients of <image, grad_in> to the parameters."""
            self.shell.backward(scene, sensor_of(scene, sensor), spp, grad_in)
            dr.eval()

        def sample(self, *_: object, **arguments: object) -> tuple[Color3f, Bool, list[Float], None]:
            """Empty sample of a ray: ``aov`` samples rays besides rendering nested images, and discards them.

            Raises ShadowmapError for all other integrators.
            """
            if not self.nesting.allows():
                raise ShadowmapError(
                    f"'{PLUGIN}' cannot be nested in integrators that sample single rays, such as moment: render it by itself, "
                    "or in aov."
                )
            if self.shell.options.aovs:
                raise ShadowmapError(
                    f"'{PLUGIN}' has channels of its own (aovs is {','.join(self.shell.options.aovs)!r}), "
                    "which aov cannot pass on: "
                    "leave them out, or render it by itself."
                )
            return mi.Spectrum(0), mi.Bool(False), [], None

        def aov_names(self) -> list[str]:
            """Names of the channels after colour and alpha."""
            return self.shell.channel_names()

        def to_string(self) -> str:
            return f"ShadowMapIntegrator[{', '.join(f'{k}={v!r}' for k, v in vars(self.shell.options).items())}]"

    return ShadowMapIntegrator
