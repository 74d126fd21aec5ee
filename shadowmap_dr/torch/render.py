"""Whole images with shadows from PyTorch tensors: the renderer of Mitsuba scenes as a differentiable function."""

from __future__ import annotations

import copy
import math
import os
import weakref
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import torch

from ..errors import ShadowmapError, check_variant
from ..jit.call_data import restored_scalars
from ..jit.frozen import Frozen
from ..jit.handover import NO_RESULTS, PackedResults, derivatives_only, keeping, second_computation
from ..jit.pytree import tree_map, with_fields
from ..jit.types import TensorXf
from ..rendering.extended_lights import SkyWatch, SoftFrusta, still_aimed
from ..rendering.renderer import Renderer as _Renderer
from ..rendering.waiting import MOST_SAMPLES, TEXELS
from ..scene.sensor import Sensor
from ..scene.transforms import is_transform
from ..shadow import Frusta
from .bridge import attached, drjit_turn, forward_derivatives, gradients, number, to_torch
from .checks import check_devices, check_floats, check_kind, number_of
from .crossing import cross, eager
from .transforms import plain

# Fields of a sensor's record, and shapes of tensors that may replace them.
_CAMERA_FIELDS: dict[str, tuple[tuple[int, ...], ...]] = {
    "to_world": ((4, 4),),
    "x_fov": ((1,), ()),
    "principal_point": ((2,),),
}
_LOOP = "render the images of different directions in a loop"


class Renderer:
    """Differentiable renderer of one Mitsuba scene, with vertices, lights and other parameters from tensors.

    Works in the variants ``llvm_ad_rgb`` and ``llvm_ad_mono`` on CPU tensors, in ``cuda_ad_rgb`` and ``cuda_ad_mono`` on CUDA
    tensors.

    The backward pass reads the scene again: Mitsuba's own parameters must not change between the two passes.

    ``copy.deepcopy`` shares the scene; ``pickle`` works for renderers of :meth:`from_file` and :meth:`from_dict`. See
    :class:`shadowmap_dr.Renderer`.
    """

    @eager
    def __init__(self, renderer: _Renderer, *, frozen: bool = False) -> None:
        """Wrap a :class:`shadowmap_dr.Renderer`.

        Args:
            renderer: the renderer. Its current fit of the shadow maps is the start; the object itself is not changed.
            frozen: record the passes (``dr.freeze``) and replay them while only numbers change, which is several times as fast
                for small images. Calls with ``parameters`` are never recorded.
        """
        check_kind("renderer", renderer, _Renderer)
        self._renderer = replace(renderer)
        # State that calls with parameters pass on: the division of extended lights, and the directions of environments' light.
        self._planned: dict[str, Any] = {}
        self._variant = mi.variant()
        self._device = _device_of(self._variant)
        with drjit_turn(self._device):
            self._sky = SkyWatch(renderer.data.environments)
        self._frozen = (Frozen(_forward), Frozen(_backward)) if frozen else None

    @classmethod
    @eager
    def from_scene(
        cls,
        scene: mi.Scene,
        *,
        frozen: bool = False,
        **settings: Any,  # Any: settings of several types
    ) -> Renderer:
        """Build a renderer for a ``mi.Scene``. ``settings`` are those of :meth:`shadowmap_dr.Renderer.from_scene`."""
        with drjit_turn(_device_of(mi.variant() or "")):
            renderer = _Renderer.from_scene(scene, **settings)
        return cls(renderer, frozen=frozen)

    @classmethod
    @eager
    def from_file(
        cls,
        path: str | os.PathLike[str],
        parameters: Mapping[str, str] | None = None,
        *,
        frozen: bool = False,
        **settings: Any,  # Any: settings of several types
    ) -> Renderer:
        """Build a renderer for a scene file, see :meth:`shadowmap_dr.Renderer.from_file`."""
        with drjit_turn(_device_of(mi.variant() or "")):
            renderer = _Renderer.from_file(path, parameters, **settings)
        return cls(renderer, frozen=frozen)

    @classmethod
    @eager
    def from_dict(
        cls,
        description: Mapping[str, Any],
        *,
        frozen: bool = False,
        **settings: Any,  # Any: settings of several types
    ) -> Renderer:
        """Build a renderer for a dictionary that describes a scene, see :meth:`shadowmap_dr.Renderer.from_dict`."""
        with drjit_turn(_device_of(mi.variant() or "")):
            renderer = _Renderer.from_dict(description, **settings)
        return cls(renderer, frozen=frozen)

    def __copy__(self) -> Renderer:
        return copy.deepcopy(self)

    def __deepcopy__(self, memo: dict[int, object]) -> Renderer:
        copied = Renderer(copy.deepcopy(self._renderer), frozen=self._frozen is not None)
        copied._planned, copied._sky = dict(self._planned), self._sky
        return copied

    def __reduce__(self) -> tuple[Callable[..., Renderer], tuple[object, ...]]:
        with drjit_turn(self._device):
            # Raises its own error if the scene's origin is unknown.
            make, state = self._renderer.__reduce__()
        return _loaded_again, (make, state, self._frozen is not None)

    @eager
    def vertices(self, name: str) -> torch.Tensor:
        """Positions of a shape when the scene was loaded: float32 (V, 3), world space, without gradients."""
        count = self._renderer.data.geometry.shape(name).vertex_count
        with drjit_turn(self._device):
            flat = dr.ravel(dr.detach(self._renderer.data.geometry.shape_positions(name)))
            return to_torch(mi.TensorXf(flat, (count, 3)))

    @eager
    def faces(self, name: str) -> torch.Tensor:
        """Triangles of a shape: int32 (F, 3), indices into its vertices."""
        info = self._renderer.data.geometry.shape(name)
        with drjit_turn(self._device):
            faces = self._renderer.data.geometry.faces.numpy().reshape(-1, 3).astype("int32")
        own = torch.from_numpy(faces[info.face_start : info.face_start + info.face_count] - info.vertex_start)
        return own.to(self._device)

    @eager
    def render(
        self,
        vertex_positions: Mapping[str, torch.Tensor] | None = None,
        lights: Mapping[str, Mapping[str, torch.Tensor]] | None = None,
        parameters: Mapping[str, torch.Tensor] | None = None,
        sensor: int | Sensor = 0,
        spp: int = 1,
        transforms: Mapping[str, torch.Tensor] | None = None,
        camera: Mapping[str, torch.Tensor] | None = None,
    ) -> torch.Tensor:
        """Render an image.

        Args:
            vertex_positions: new world-space vertices, float32 (V, 3), by the name of their shape.
            lights: by the name of the light, new values of fields of its record (:mod:`shadowmap_dr.scene.lights`):
                ``direction``, ``position`` (3,), ``irradiance``, ``intensity`` (3,) or (1,) as the variant has colours,
                ``to_world`` (4, 4), ``cutoff_angle``, ``beam_width`` (1,), in degrees.
            parameters: by Mitsuba's names (``mi.traverse(scene)``), new values of anything else: textures (H, W, C) in linear
                colour, colours, ``to_world`` (4, 4) of cameras. They are set in the scene during the call only. Such a call reads
                all other parameters from the scene, too, and loads textures anew.
            sensor: number of the scene's sensor, or a record (``cameras.Camera.record()``), to which no gradients flow.
            spp: samples per pixel, see :meth:`shadowmap_dr.Renderer.render`.
            transforms: affine maps of world space (4, 4), by the name of the shape that they move, see
                :meth:`shadowmap_dr.Renderer.render`.
            camera: new values of fields of the sensor's record (:mod:`shadowmap_dr.scene.sensor`): ``to_world`` (4, 4),
                ``x_fov`` (1,) in degrees, ``principal_point`` (2,).

        Returns:
            float32 (H, W, C): linear colour, then alpha if the film has it, then the AOVs. Attached to all tensors.

        Raises:
            ShadowmapError: unknown names, tensors that do not fit, a variant that does not fit the tensors.
        """
        mappings = {"vertex_positions": vertex_positions, "lights": lights, "parameters": parameters}
        for name, value in {**mappings, "transforms": transforms, "camera": camera}.items():
            check_kind(name, {} if value is None else value, Mapping)
        for name, value in (lights or {}).items():
            check_kind(f"lights['{name}']", value, Mapping)
        samples = number_of("spp", spp, float)
        if hasattr(sensor, "record"):
            raise ShadowmapError(f"the sensor is a {type(sensor).__name__}: give camera.record().")
        sensor = sensor if isinstance(sensor, Sensor) else number_of("sensor", sensor, int)
        given = self._inputs(vertex_positions, lights, parameters, transforms, camera)
        count = len(self._renderer.data.sensors)
        if not (isinstance(sensor, Sensor) or 0 <= sensor < count) or not 1 <= samples < math.inf:
            why = f"there are {count} sensors, counted from 0; spp is 1 or more"
            raise ShadowmapError(f"sensor {sensor}, spp {samples:g}: {why}.")
        if camera and len(self._renderer.data.cameras(sensor)) != 1:
            raise ShadowmapError(f"camera: sensor {sensor} is a batch of cameras; render them one by one.")
        wanted = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in given.values())
        operation = _Rendering(self, tuple(given), sensor, math.ceil(samples), wanted)
        if given:
            return cross(operation, *given.values())[0]
        with drjit_turn(self._device):
            (image,) = operation.forward([])
            return to_torch(image)

    def _inputs(
        self,
        vertex_positions: Mapping[str, torch.Tensor] | None,
        lights: Mapping[str, Mapping[str, torch.Tensor]] | None,
        parameters: Mapping[str, torch.Tensor] | None,
        transforms: Mapping[str, torch.Tensor] | None,
        camera: Mapping[str, torch.Tensor] | None,
    ) -> dict[_Place, torch.Tensor]:
        """All tensors, checked, by their purpose."""
        check_variant(mi.variant(), self._variant)
        given: dict[_Place, torch.Tensor] = {}
        for name, value in (vertex_positions or {}).items():
            count = self._renderer.data.geometry.shape(name).vertex_count
            check_floats(f"vertex_positions['{name}']", value, (count, 3))
            given[_Place("vertices", name)] = value
        for name, values in (lights or {}).items():
            record = self._renderer.light(name)
            known = [f.name for f in fields(record) if f.name not in ("name", "texture")]
            for key, value in values.items():
                if key not in known:
                    raise ShadowmapError(f"Light '{name}' has no '{key}' that a tensor could replace: {', '.join(known)}.")
                check_floats(f"lights['{name}']['{key}']", value, *_shapes_of(f"lights: '{key}'", getattr(record, key)))
                if key == "direction":
                    _check_direction(f"lights['{name}']['direction']", value)
                given[_Place("light", name, key)] = value
        for name, value in (transforms or {}).items():
            self._renderer.data.geometry.shape(name)  # raises if there is none
            check_floats(f"transforms['{name}']", value, (4, 4))
            given[_Place("transform", name)] = value
        for name, value in (camera or {}).items():
            if name not in _CAMERA_FIELDS:
                raise ShadowmapError(f"camera: there is no '{name}' that a tensor could replace: {', '.join(_CAMERA_FIELDS)}.")
            check_floats(f"camera['{name}']", value, *_CAMERA_FIELDS[name])
            given[_Place("camera", name)] = value
        if parameters:
            current = mi.traverse(self._renderer.data.scene)
            for name, value in parameters.items():
                if name not in current:
                    raise ShadowmapError(f"The scene has no parameter '{name}': print(mi.traverse(scene)) lists them.")
                check_floats(f"parameters['{name}']", value, *_shapes_of(f"parameters: '{name}'", current[name]))
                given[_Place("parameter", name)] = value
        if given:
            device = check_devices(**{str(place): value for place, value in given.items()})
            if not self._variant.startswith({"cpu": "llvm", "cuda": "cuda"}[device.type]):
                wanted = self._variant.replace("llvm", "cuda") if device.type == "cuda" else self._variant.replace("cuda", "llvm")
                raise ShadowmapError(
                    f"Tensors lie on {device}, but the renderer was made for {self._variant}: mi.set_variant('{wanted}') before."
                )
        return given


@dataclass(frozen=True)
class _Place:
    """Purpose of a tensor: ``kind`` is vertices, light, parameter, transform or camera."""

    kind: str
    name: str
    field: str = ""

    def __str__(self) -> str:
        return f"{self.kind} '{self.name}'{self.field and '.'}{self.field}"


class _Rendering:
    """One image as an operation, rendered once more for its derivatives, from what the image has evaluated.

    ``keep``: whether that is kept for the first backward pass, unless earlier images that still wait for theirs keep too much.
    """

    _waiting: ClassVar[weakref.WeakSet[_Rendering]] = weakref.WeakSet()

    name, unbatched = "Renderer.render", ""

    def __init__(self, owner: Renderer, places: tuple[_Place, ...], sensor: int | Sensor, spp: int, keep: bool) -> None:
        self.owner, self.places, self.camera = owner, places, (sensor, spp)
        self.keep = keep and owner._renderer.is_one_pass
        self.changes_scene = any(place.kind == "parameter" for place in places)
        self.functions = (_forward, _backward) if self.changes_scene or owner._frozen is None else owner._frozen
        self.sky = owner._sky
        # Decisions of the forward pass that the backward pass repeats.
        self.fixed: dict[str, Any] = {}
        self.results = NO_RESULTS
        self.weight = 0

    def forward(self, arrays: list[TensorXf]) -> Sequence[TensorXf]:
        with dr.suspend_grad(), self._scene(arrays) as renderer:
            keep = self.keep and sum(other.weight for other in self._waiting) < MOST_SAMPLES
            image, fit, self.results = self.functions[0](self.places, *self.camera, keep, arrays, renderer)
            # Evaluated while the scene has the parameters of this call.
            dr.eval(image, fit, self.results)
        if self.results:
            self.weight = math.prod(image.shape[:2]) * self.camera[1] + renderer.texels // TEXELS
            self._waiting.add(self)
        self.fixed = {"soft": renderer.soft, "frusta": fit[0], "soft_frusta": fit[1]}
        # The owner changes only now that nothing can fail any more.
        self.owner._renderer.frusta = fit[0]
        if self.changes_scene:
            self.owner._planned, self.owner._sky = {"soft": renderer.soft, "soft_frusta": fit[1]}, self.sky
        else:
            self.owner._renderer.soft_frusta = fit[1]
        return (image,)

    def backward(self, arrays: list[TensorXf], wanted: Sequence[bool], adjoints: Sequence[TensorXf | None]) -> Sequence[TensorXf]:
        with dr.resume_grad():
            arrays = attached(arrays, wanted)  # before they enter the scene
            with self._scene(arrays) as renderer:
                # Their memory is free after this backward pass. Another one computes them again.
                results, self.results = self.results, NO_RESULTS
                self._waiting.discard(self)
                return self.functions[1](self.places, *self.camera, list(wanted), arrays, adjoints[0], renderer, results)

    def jvp(self, arrays: list[TensorXf], tangents: Sequence[TensorXf | None]) -> Sequence[TensorXf]:
        with dr.resume_grad():
            arrays = attached(arrays, [tangent is not None for tangent in tangents])
            with self._scene(arrays) as renderer:
                with derivatives_only():
                    image = _image(self.places, *self.camera, arrays, renderer)
                return forward_derivatives(arrays, (image,), tangents)

    def again(self) -> _Rendering:
        return _Rendering(self.owner, self.places, *self.camera, self.keep)

    @contextmanager
    def _scene(self, arrays: list[TensorXf]) -> Iterator[_Renderer]:
        """Context with the renderer for this call, in which the scene has the parameters of this call."""
        # Fitting maps again to the same vertices changes no bit, so derivatives are those of the image.
        renderer = with_fields(self.owner._renderer, **(self.fixed or (self.owner._planned if self.changes_scene else {})))
        # Copies, since a replayed function writes into its arguments, which another image's backward pass may need.
        fits = (renderer.frusta, renderer.soft_frusta)
        renderer.frusta, renderer.soft_frusta = tree_map(fits, lambda array: type(array)(array))
        values = {place.name: array for place, array in zip(self.places, arrays, strict=True) if place.kind == "parameter"}
        if not values:
            yield renderer
            return
        table = mi.traverse(renderer.data.scene)
        # Copies: values from the table change with the scene.
        before = {name: type(table[name])(table[name]) for name in values}
        try:
            try:
                _set(table, {name: _converted(before[name], array) for name, array in values.items()})
            except RuntimeError as error:
                why = " ".join(str(error).split())
                raise ShadowmapError(f"Mitsuba refuses new values of {', '.join(values)}: {why}") from error
            renderer = renderer.refresh()
            yield renderer if self.fixed else self._divided(renderer)
        finally:
            _set(table, before)

    def _divided(self, renderer: _Renderer) -> _Renderer:
        """The renderer, with extended lights divided anew if they have changed much since their last division."""
        data = renderer.data
        with dr.suspend_grad():
            if self.sky.same() and still_aimed(renderer.soft, lambda: data.geometry):
                return renderer
            self.sky = SkyWatch(data.environments)
            return renderer.with_replanned_lights()


def _loaded_again(make: Callable[..., _Renderer], state: tuple[object, ...], frozen: bool) -> Renderer:
    """The renderer that was pickled."""
    with drjit_turn(_device_of(mi.variant() or "")):
        renderer = make(*state)
    return Renderer(renderer, frozen=frozen)


def _device_of(variant: str) -> torch.device:
    return torch.device("cuda" if variant.startswith("cuda") else "cpu")


def _check_direction(name: str, value: torch.Tensor) -> None:
    numbers = plain(name, value, _LOOP)
    if not (bool(numbers.any()) and bool(numbers.isfinite().all())):
        raise ShadowmapError(f"{name}: {numbers.tolist()}; give a finite one other than zero.")


def _set(table: mi.SceneParameters, values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        table[name] = value
    table.update()


def _forward(
    places: tuple[_Place, ...], sensor: int | Sensor, spp: int, keep: bool, arrays: list[TensorXf], renderer: _Renderer
) -> tuple[TensorXf, tuple[Frusta | None, SoftFrusta], PackedResults]:
    """Image, (frusta of the shadow maps, frusta of extended lights' maps), and results for the backward pass if ``keep``."""
    with keeping() as results, restored_scalars():
        image = _image(places, sensor, spp, arrays, renderer)
    return image, (renderer.frusta, renderer.soft_frusta), PackedResults.of(results) if keep else NO_RESULTS


def _image(places: tuple[_Place, ...], sensor: int | Sensor, spp: int, arrays: list[TensorXf], renderer: _Renderer) -> TensorXf:
    given = list(zip(places, arrays, strict=True))
    vertices = {place.name: array for place, array in given if place.kind == "vertices"}
    lights: dict[str, Any] = {}
    for place, array in given:
        if place.kind == "light":
            light = lights.get(place.name, renderer.light(place.name))
            lights[place.name] = replace(light, **{place.field: _converted(getattr(light, place.field), array)})
    transforms = {place.name: _converted(mi.Transform4f(), array) for place, array in given if place.kind == "transform"}
    viewed = {place.name: array for place, array in given if place.kind == "camera"}
    if viewed:
        record = renderer.data.cameras(sensor)[0]
        sensor = replace(record, **{name: _converted(getattr(record, name), array) for name, array in viewed.items()})
    return renderer.render(vertices, lights, sensor, spp, transforms=transforms or None)


def _backward(
    places: tuple[_Place, ...],
    sensor: int | Sensor,
    spp: int,
    wanted: list[bool],
    arrays: list[TensorXf],
    adjoint: TensorXf | None,
    renderer: _Renderer,
    results: PackedResults,
) -> list[TensorXf]:
    """Gradients to the arrays. ``adjoint``: gradient to the image; ``results``: of the image, or none."""
    for array, want in zip(arrays, wanted, strict=True):
        if want:
            dr.enable_grad(array)
    with restored_scalars():
        with second_computation(results):
            image = _image(places, sensor, spp, arrays, renderer)
        return gradients(arrays, (image,), (adjoint,))


def _shapes_of(what: str, value: Any) -> tuple[tuple[int, ...], ...]:  # Any: parameters have values of all kinds
    """Shapes of tensors that may replace a parameter."""
    if is_transform(value):
        return ((4, 4),)
    if not dr.is_array_v(value) or not dr.is_float_v(value):
        raise ShadowmapError(f"{what} is a {type(value).__name__}, which no tensor can replace.")
    if dr.is_tensor_v(value):
        return (tuple(value.shape),)
    if dr.depth_v(value) > 1:
        return ((dr.size_v(value),),)
    return ((1,), ()) if len(value) == 1 else ((len(value),),)


def _converted(old: Any, array: TensorXf) -> Any:  # Any: parameters have values of all kinds
    """A (checked) tensor converted to the type of the value that it replaces, attached."""
    if dr.is_tensor_v(old):
        return type(old)(array)
    flat = array.array
    if not is_transform(old) and dr.depth_v(old) == 1:
        return type(old)(flat)
    numbers = [number(flat, k) for k in range(len(flat))]
    if is_transform(old):
        return type(old)(mi.Matrix4f(*(numbers[4 * row : 4 * row + 4] for row in range(4))))
    return type(old)(*numbers)
