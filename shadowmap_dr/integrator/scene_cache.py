"""State of a scene that the plug-in keeps from one rendering to the next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import ShadowmapError, warn
from ..jit.frozen import take_apart
from ..jit.gc import gc_paused
from ..jit.pytree import with_fields
from ..jit.types import AnyArray, Float, PyTree, TensorXf, UInt32
from ..rendering.extended_lights import SkyWatch, SoftFrusta, still_aimed
from ..rendering.pass_cache import PassCache
from ..rendering.renderer import Renderer
from ..rendering.settings import RenderSettings
from ..rendering.waiting import MOST_OF_LATEST, TEXELS
from ..scene.changes import MirrorWatch, ParameterWatch
from ..scene.geometry import NOT_READ
from ..scene.load import SceneData, load, refresh, with_positions
from ..scene.mitsuba_objects import parameters
from ..scene.sensor import check_film, lenses_of, sensors_of
from ..scene.unsupported import warn_of
from ..scene.untracked import UntrackedValues
from ..shadow import Frusta
from .deferred import COLOURS_OF_LIGHTS, DeferredImages, DetachedInputs
from .handed import HandedResults
from .parameter_state import ParameterState
from .pass_caches import PassCaches, names_by_level
from .recording import FrozenPasses, plain
from .scene_reader import SceneReader
from .steady_steps import SteadySteps

# Sensors whose fit of the shadow maps is remembered, and how many of them may be foreign to the scene. Some programs make a new
# sensor for each image; remembered sensors are kept alive, and recordings hold only for a fixed number of objects.
_REMEMBERED_SENSORS, _OTHERS = 64, 8
# Samples of an image, and texels of its maps that take as long, up to which replays are faster under skies, which take longer in
# recordings, and where maps are made in slices. Otherwise the limit is that of results that are handed over.
_LARGEST = 3 << 16


@dataclass(frozen=True)
class SceneState:
    """Parameters of a scene, and of the sensor of an image."""

    scene: ParameterState
    camera: ParameterState

    @classmethod
    def of(cls, scene: mi.Scene, sensor: mi.Sensor, now: ParameterState) -> SceneState:
        """The current state. ``now``: the parameters of the scene, its own sensors among them."""
        own = any(sensor is known for known in scene.sensors())
        return cls(now, ParameterState({}, (), []) if own else ParameterState.of(sensor))

    @property
    def attached(self) -> tuple[str, ...]:
        """Names of the attached parameters of both."""
        return *self.scene.attached, *self.camera.attached


@dataclass
class SceneCache:
    """State of a scene that is kept between renderings.

    The scene itself is not kept: it may own the integrator that owns this record.

    parts     shapes, BSDFs and emitters of the scene; kept alive here, so that comparing them by identity is safe
    statics   arrays that determine the topology and the shadow maps: faces, segments of curves, cutoff angles of spot lights
    sizes     numbers of vertices, faces and control points, and flags for buffers: ``ShapeSource.sizes``
    lights    names of the lights
    renderer  the renderer, without the data that each rendering reads again
    fits      (sensor, frusta of the shadow maps, frusta of extended lights' maps) of each sensor's last image, latest first
    waiting   images that wait for their backward passes
    recorded  recordings of both passes, for the option ``recorded``; ``recordable``: by names of attached parameters, whether
              gradients flow only through data read from the scene
    sky       watch over the directions of the environments' light
    mirrors   watch over mirrored shapes
    checked   vertices that were found to be finite
    warned    whether the user was warned of parameters that frozen functions do not see
    steady    steps of loops, for the option ``recorded="auto"``
    untracked  state that recordings do not see; ``untracked_then``: its values when they were made
    colours   watch over the mesh colours for which the renderer's creases were found
    passes    caches of passes for its sensors
    matched   parameters of the scene at the last successful match
    handed    results of the last replayed images, for their backward passes
    reader    reads the scene for replays
    """

    parts: tuple[mi.Object, ...]
    statics: tuple[AnyArray, ...]
    sizes: tuple[int, ...]
    lights: tuple[str, ...]
    renderer: Renderer
    fits: list[tuple[mi.Sensor, Frusta | None, SoftFrusta]] = field(default_factory=list)
    waiting: DeferredImages = field(default_factory=DeferredImages)
    recorded: FrozenPasses = field(default_factory=FrozenPasses)
    recordable: dict[tuple[str, ...], bool] = field(default_factory=dict)
    steady: SteadySteps = field(default_factory=SteadySteps)
    untracked: UntrackedValues = field(default_factory=lambda: UntrackedValues(()))
    untracked_then: tuple[object, ...] = ()
    colours: ParameterWatch | None = None
    sky: SkyWatch = field(default_factory=lambda: SkyWatch(()))
    mirrors: MirrorWatch = field(default_factory=lambda: MirrorWatch(()))
    checked: Float | None = None
    warned: bool = False
    passes: PassCaches = field(default_factory=PassCaches)
    matched: ParameterState | None = None
    handed: HandedResults = field(default_factory=HandedResults)
    reader: SceneReader = field(default_factory=SceneReader)
    _taken: tuple[Renderer, tuple[str, list[PyTree]]] | None = None

    # All that Dr.Jit is to know of, instead of the fields: it looks twice for each image.
    DRJIT_STRUCT: ClassVar[dict[str, type]] = {"recording_parts": tuple}

    @property
    def recording_parts(self) -> tuple[object, ...]:
        """The arrays and objects that users' frozen functions read from here, and a text that describes them."""
        if self._taken is None or self._taken[0] is not self.renderer:
            self._taken = self.renderer, take_apart(self.renderer)
        return self._taken[1], self.statics, self.fits

    @classmethod
    def build(
        cls, scene: mi.Scene, sensor: mi.Sensor, settings: RenderSettings, tessellation: int, warn: bool = True
    ) -> SceneCache:
        """Read a scene. Raises ShadowmapError for broken parts; ``warn``: issue a warning about omitted parts."""
        if dr.flag(dr.JitFlag.FreezingScope):
            raise ShadowmapError("A scene cannot be read while a function is frozen: render it once with this integrator before.")
        # Of a scene of thousands of shapes so many objects are made that collections would take a tenth of the time.
        with dr.suspend_grad(), gc_paused():
            data = load(scene, tessellation=tessellation, warn=warn)
            data = replace(data, sensors=(sensors_of(sensor), *data.sensors))
            check_film(sensor)
            renderer = replace(Renderer.from_data(data, settings), untracked=None)
            sky, untracked = (
                SkyWatch(data.environments),
                UntrackedValues((*scene.emitters(), *data.materials)),
            )
        lights = tuple(light.name for light in data.lights) if settings.lit else ()
        record = cls(_parts(scene, data), _statics(scene, data), _sizes(data), lights, renderer.with_data(_without_scene(data)))
        mirrors = MirrorWatch([shape for source in data.sources for shape in source.transformed()])
        colours = None if renderer.creases is None else renderer.creases.watch(data.sources)
        return replace(record, sky=sky, mirrors=mirrors, untracked=untracked, colours=colours)

    def matches(self, scene: mi.Scene, now: ParameterState) -> bool:
        """True if the cached state still fits the scene. ``now``: the scene's current parameters.

        Moved vertices and changed parameters do not invalidate it. A lamp that left the range of its maps does, and a sky whose
        light comes from other directions.
        """
        data = self.renderer.data
        if not same_objects(self.parts, _parts(scene, data)):
            return False
        if self.matched is not None and now.same_but_for(self.matched, self.reader.of_cameras):
            return True
        fits = self._fits(scene, data)
        if fits and not dr.flag(dr.JitFlag.FreezingScope):
            self.matched = now
        return fits

    def _fits(self, scene: mi.Scene, data: SceneData) -> bool:
        """True if the cached state fits a scene of the same objects."""
        if self.sizes != _sizes(data):
            return False
        statics = _statics(scene, data)
        if not _same_arrays(self.statics, statics):
            return False
        self.statics = statics
        if dr.flag(dr.JitFlag.FreezingScope):
            return True  # nothing can be read back
        with dr.suspend_grad():
            still = self.mirrors.same() and self.sky.same()
            return still and still_aimed(self.renderer.soft, lambda: with_positions(data))

    def data(self, scene: mi.Scene, sensor: mi.Sensor) -> SceneData:
        """Records of the current scene with one sensor, attached to the scene's parameters."""
        return refresh(with_fields(self.renderer.data, scene=scene), sensors=(sensor,))

    def render(
        self, scene: mi.Scene, sensor: mi.Sensor, spp: int, now: ParameterState, inputs: DetachedInputs | None = None
    ) -> TensorXf:
        """Image (mi.TensorXf), attached to the scene's parameters unless gradients are suspended.

        ``now``: the scene's current parameters. ``inputs``: if given, the image is attached to these leaves instead of the
        scene's vertices, lights and cameras.
        """
        self._name_constants_of_recordings()
        current = self._current(scene, sensor)
        self._check_vertices(current)
        if inputs is not None:
            current = current.with_data(inputs.instead_of(current.data))
        frozen = dr.flag(dr.JitFlag.FreezingScope)
        image = current.render(spp=spp, cache=None if frozen else self._passes(scene, sensor, spp, now))
        self._remember(scene, sensor, current.frusta, current.soft_frusta)
        return image

    def _passes(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, now: ParameterState) -> PassCache:
        """Cache of passes for the next image."""
        with dr.resume_grad():  # so that attached parameters are recognised
            camera = ParameterState.of(sensor)
        weight = self._weight(sensor, spp)
        return self.passes.cache_for(now, camera, sensor, spp, weight, partial(names_by_level, scene, self.renderer.data))

    def _weight(self, sensor: mi.Sensor, spp: int) -> int:
        """Samples of an image, and texels of its shadow maps as samples that take as much memory."""
        return _samples(sensor, spp) + self.renderer.texels // TEXELS

    def is_steady(self, attached: tuple[str, ...], sensor: mi.Sensor, spp: int) -> bool:
        """True if the next image is a step of a loop that is worth a recording. Call once for each image.

        ``attached``: names of the attached parameters of the scene and the sensor. Gradients flow only through data read from the
        scene.
        """
        if all(name.endswith(COLOURS_OF_LIGHTS) for name in attached):
            return False  # surfaces and maps of the last step serve again, which a recording would render
        if not dr.flag(dr.JitFlag.KernelFreezing) or dr.flag(dr.JitFlag.Debug):
            return False
        renderer = self.renderer
        slow = renderer.slices or any(plan.kind == "distant" for plan in renderer.soft)
        if self._weight(sensor, spp) > (_LARGEST if slow else MOST_OF_LATEST):
            return False
        values = self.untracked.now()
        if values != self.steady.values:
            self.steady = SteadySteps(values)
        return self.steady.note(_kind(attached, sensor, spp), self.recorded.recordings)

    def try_to_replay(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, now: SceneState) -> TensorXf | None:
        """The same as :meth:`replay`; None, from now on, if the scene cannot be recorded."""
        try:
            return self.replay(scene, sensor, spp, now)
        except RuntimeError:
            self.steady.refuse()
            return None

    def replay(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, now: SceneState) -> TensorXf:
        """The same image, detached, replayed from a recording that the first call makes. ``now``: the current parameters."""
        self._forget_stale_recordings()
        with dr.suspend_grad():
            current = self._current(scene, sensor, now)
        self._check_vertices(current)
        current.note_kernels(spp)
        weight = self._weight(sensor, spp)
        keep = weight <= MOST_OF_LATEST and current.is_one_pass
        detached = self._plain(current)
        image, frusta, soft_frusta, results = self.recorded.image(spp, detached, keep)
        self._remember(scene, sensor, frusta, soft_frusta)
        if keep and now.attached:
            self.handed.add(sensor, spp, weight, (now.scene, now.camera), detached, results)
        self.handed.follow(now.scene, scene)
        return image

    def replay_backward(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, gradient: TensorXf, now: SceneState) -> bool:
        """Add the gradients of <image, gradient> to the scene's parameters, through a recording, too.

        Does nothing and returns False if gradients also flow through materials, textures or the radiance of extended lights,
        which Mitsuba itself evaluates. ``now``: the current parameters.
        """
        (results, detached), attached = self.handed.take(sensor, spp, now.scene, now.camera), now.attached
        current = self._current(scene, sensor, now)
        if attached not in self.recordable:
            self.recordable[attached] = not dr.grad_enabled(self._plain(current).render(spp=spp))
        if self.recordable[attached]:
            self._forget_stale_recordings()
            if detached is None:
                detached = self._plain(current)
            else:  # with the fit of the maps that the image has made
                detached = with_fields(detached, frusta=current.frusta, soft_frusta=current.soft_frusta)
            self.recorded.backward(spp, gradient, current.data, detached, results, self.reader.fields(current.data))
            self.handed.follow(now.scene, scene)
        return self.recordable[attached]

    def try_to_replay_backward(self, scene: mi.Scene, sensor: mi.Sensor, spp: int, gradient: TensorXf, now: SceneState) -> bool:
        """The same as :meth:`replay_backward` if the last image of this kind was replayed. False if it cannot be recorded."""
        if not self.steady.is_replayed(_kind(now.attached, sensor, spp)):
            return False
        try:
            return self.replay_backward(scene, sensor, spp, gradient, now)
        except RuntimeError:
            self.steady.refuse()
            return False

    def _name_constants_of_recordings(self) -> None:
        """Warn, once, of parameters that the user's frozen function takes for constants, since Dr.Jit does not see them."""
        if self.warned or not dr.flag(dr.JitFlag.FreezingScope) or not self.untracked.names():
            return
        self.warned = True
        shapes = {source.shape.bsdf(): f"{source.shape.id()}." for source in self.renderer.data.sources}
        names = [f"{shapes.get(node, '')}{node.id()}.{key}" for node, key in self.untracked.names()]
        listed = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        warn(
            f"dr.freeze does not see changes of {listed}: call clear() of the frozen function after one, "
            f"or leave the recording to the integrator's parameter 'recorded'."
        )

    def _forget_stale_recordings(self) -> None:
        """Drop the recordings if values of materials or lights that they do not see have changed."""
        now = self.untracked.now()
        if now != self.untracked_then:
            self.recorded, self.untracked_then = FrozenPasses(), now

    def _plain(self, current: Renderer) -> Renderer:
        """See :func:`plain`."""
        detached = plain(current, self.reader.copies(current.data))
        self.reader.copied(current.data, detached.data)
        return detached

    def _current(self, scene: mi.Scene, sensor: mi.Sensor, now: SceneState | None = None) -> Renderer:
        """The renderer for the current scene. ``now``: its parameters, if parts that have not changed need not be read again.

        Each sensor starts from its own last fit. Fitting again to the same vertices and lights changes no bit, so the backward
        pass uses the frusta of its image, whatever other sensors have rendered in between.
        """
        if not (dr.flag(dr.JitFlag.FreezingScope) or self.colours is None or self.colours.same()):
            self.renderer = self.renderer.with_updated_shading_edges()
            self.passes.forget_edges()
        kept = self.renderer
        found = next((fit for fit in self.fits if fit[0] is sensor), None)
        _, frusta, soft_frusta = found or (sensor, kept.frusta, kept.soft_frusta)
        if now is None:
            data = self.data(scene, sensor)
        else:
            data = self.reader.read(with_fields(kept.data, scene=scene), sensor, now.scene, now.camera)
        if found is None:
            check_film(sensor)
        return with_fields(kept, data=data, frusta=frusta, soft_frusta=soft_frusta)

    def _check_vertices(self, current: Renderer) -> None:
        """Raise ShadowmapError for vertices that are not finite: their triangles and derivatives would silently vanish."""
        geometry = current.data.geometry
        positions = dr.detach(geometry.positions)
        if dr.flag(dr.JitFlag.FreezingScope) or (self.checked is not None and positions.index == self.checked.index):
            return
        finite = dr.isfinite(positions)
        if not dr.all(finite):
            points = positions.numpy().reshape(-1, 3)
            vertex = int(np.flatnonzero(~np.isfinite(points).all(1))[0])
            info = geometry.shapes[int(geometry.vertex_shape[vertex])]
            where = f"Vertex {vertex - info.vertex_start} of shape '{info.name}' is {points[vertex].tolist()}"
            raise ShadowmapError(f"{where}: positions must be finite.")
        self.checked = positions

    def _remember(self, scene: mi.Scene, sensor: mi.Sensor, frusta: Frusta | None, soft_frusta: SoftFrusta) -> None:
        """Keep the fit of an image for the sensor's next image, and warn of the lens of a new sensor foreign to the scene."""
        others = [fit for fit in self.fits if fit[0] is not sensor]
        if len(others) == len(self.fits) and not any(sensor is known for known in scene.sensors()):
            warn_of(lenses_of(sensor))
        own, room, kept = scene.sensors(), _OTHERS, []
        for fit in [(sensor, frusta, soft_frusta), *others]:
            strange = not any(fit[0] is known for known in own)
            room -= strange
            if not strange or room >= 0:
                kept.append(fit)
        self.fits = kept[:_REMEMBERED_SENSORS]


def _samples(sensor: mi.Sensor, spp: int) -> int:
    """Number of samples of an image."""
    size = sensor.film().crop_size()
    return int(size[0]) * int(size[1]) * spp


def _kind(attached: tuple[str, ...], sensor: mi.Sensor, spp: int) -> tuple[object, ...]:
    """Steps of a kind have the same passes."""
    return attached, id(sensor), tuple(sensor.film().crop_size()), spp


def _parts(scene: mi.Scene, data: SceneData) -> tuple[mi.Object, ...]:
    return (*scene.shapes(), *scene.emitters(), *_bsdfs(data))


def _bsdfs(data: SceneData) -> list[mi.BSDF]:
    return [source.shape.bsdf() for source in data.sources]


def _statics(scene: mi.Scene, data: SceneData) -> tuple[Float | UInt32, ...]:
    topology = [array for source in data.sources for array in source.statics()]
    cones = [e for e in scene.emitters() if e.class_name() == "SpotLight"]
    return (*topology, *(dr.detach(mi.Float(parameters(cone)["cutoff_angle"])) for cone in cones))


def _sizes(data: SceneData) -> tuple[int, ...]:
    return tuple(size for source in data.sources for size in source.sizes())


def _without_scene(data: SceneData) -> SceneData:
    """Drop the data that ``refresh`` reads again."""
    geometry = replace(data.geometry, positions=NOT_READ, normals=NOT_READ, texcoords=NOT_READ, rest_positions=NOT_READ)
    return replace(data, scene=None, geometry=geometry, sensors=(), lights=(), areas=(), environments=())


def same_objects(first: tuple[object, ...], second: tuple[object, ...]) -> bool:
    return len(first) == len(second) and all(a is b for a, b in zip(first, second, strict=True))


def _same_arrays(first: tuple[AnyArray, ...], second: tuple[AnyArray, ...]) -> bool:
    """Equality of arrays, which are read back only if they are different variables."""
    if len(first) != len(second):
        return False
    for a, b in zip(first, second, strict=True):
        if a.index != b.index and (len(a) != len(b) or not dr.all(a == b)):
            return False
    return True
