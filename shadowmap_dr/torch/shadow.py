"""Shadow maps on PyTorch tensors: make them, filter them, look them up. Functions of :mod:`shadowmap_dr.shadow`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

import drjit as dr
import torch

from .. import shadow as _shadow
from ..errors import ShadowmapError
from ..jit.arrays import backend
from ..jit.types import AnyArray, Float, TensorXf, UInt32, Vector3f
from ..shadow import Frusta, LightView, ShadowSettings, Views
from .bridge import IN_TENSOR, drjit_turn, index_array, vector
from .checks import check_devices, check_floats, check_kind, check_same, number_of
from .crossing import Repeated, cross, eager
from .records import Topology
from .transforms import plain

_ArrayT = TypeVar("_ArrayT", bound="AnyArray")

# Spot lights with a wider cone (half-angle in degrees) use the faces of a cube.
_WIDEST_SPOT = 60.0
# Names of the vectors that a map's camera consists of, in the order of ShadowMaps.axes.
_AXES = ("right", "up", "forward", "origin")
_LOOP = "make maps for each of the batch in a loop"


@dataclass(frozen=True)
class DirectionalLight:
    """Parallel light. ``direction``: float32 (3,), in which light travels, world space, any length but 0."""

    direction: torch.Tensor


@dataclass(frozen=True)
class PointLight:
    """Light from a point. ``position``: float32 (3,), world space."""

    position: torch.Tensor


@dataclass(frozen=True)
class SpotLight:
    """Cone of light. ``position``, ``direction`` (of the axis): float32 (3,); ``cutoff_angle``: degrees, half of the opening."""

    position: torch.Tensor
    direction: torch.Tensor
    cutoff_angle: float


Light = DirectionalLight | PointLight | SpotLight


@dataclass(frozen=True)
class ShadowMaps:
    """M square maps of N x N texels: one for each directional light or spot light up to 60 degrees, six for all others.

    Attributes:
        values: float32 (M, N, N, C), the channels that the method stores in each texel. Attached to casters and lights.
        axes: float32 (4, M, 3): each map's right, up and forward axis and its origin, world space. Attached to the lights.
        settings: settings of the maps.
        first: number of the first map of each light.
    """

    values: torch.Tensor
    axes: torch.Tensor
    settings: ShadowSettings
    first: tuple[int, ...]
    _views: Views = field(repr=False)
    _frusta: Frusta = field(repr=False)
    _channels: int = field(repr=False)


@eager
def render_maps(
    vertices: torch.Tensor,
    topology: Topology,
    lights: Light | Sequence[Light],
    settings: ShadowSettings | None = None,
    *,
    previous: ShadowMaps | None = None,
    seen: torch.Tensor | None = None,
) -> ShadowMaps:
    """Make the shadow maps of all lights at once: rasterize the casters from each light, anti-aliased.

    Args:
        vertices: float32 (V, 3), vertices of the casters, world space.
        topology: of their mesh, with faces (F, 3).
        lights: one or several.
        settings: default ``ShadowSettings()``; ``compat`` and the method ``none`` have no maps of their own.
        previous: maps of the step before. Their frusta are kept while the casters stay inside and fill most of them, so that an
            optimisation does not see them move.
        seen: float32 (..., 3), points all over the receivers: maps need not cover casters whose shadows miss these points.

    Returns:
        Unfiltered maps, attached to ``vertices`` and to the tensors of the lights.
    """
    settings = ShadowSettings() if settings is None else settings
    check_kind("topology", topology, Topology)
    check_kind("settings", settings, ShadowSettings)
    if settings.method == "none" or settings.compat:
        raise ShadowmapError("settings: the method 'none' and compat are for the Renderer only; choose another method.")
    edges = topology._single
    lights = list(lights) if isinstance(lights, Sequence) else [lights]
    if not lights:
        raise ShadowmapError("lights: an empty list; give at least one light.")
    check_floats("vertices", vertices, (topology.vertex_count, 3))
    tensors = {f"lights[{k}].{name}": value for k, light in enumerate(lights) for name, value in _checked(light, k).items()}
    if seen is not None:
        check_floats("seen", seen, ("...", "N", 3), (3,))
        tensors["seen"] = plain("seen", seen.reshape(-1, 3), _LOOP)
    check_devices(vertices=vertices, topology=topology.faces, **tensors)
    sizes = [6 if _has_cube(light) else 1 for light in lights]
    if previous is not None:
        check_kind("previous", previous, ShadowMaps)
        check_same("maps of previous", previous.axes.shape[1], sum(sizes), "give maps of the same lights")
    indices = index_array(topology.faces)
    kept: list[tuple[Views, Frusta]] = []

    def run(vertices: TensorXf, *arrays: TensorXf) -> tuple[TensorXf, ...]:
        given = dict(zip(tensors, arrays, strict=True))
        views = [view for k, light in enumerate(lights) for view in _light_views(light, k, given, settings)]
        stacked = _shadow.stack_views(views)
        count = len(views)
        p_light, map_index, _ = _shadow.vertices_in_maps(stacked, vertices.array)
        frusta = _fit(stacked, p_light, map_index, settings, previous, given.get("seen"))
        maps = _shadow.render_maps(p_light, map_index, indices, edges, stacked, frusta, settings)
        bare = replace(stacked, right=IN_TENSOR, up=IN_TENSOR, forward=IN_TENSOR, origin=IN_TENSOR)
        kept.append((dr.detach(bare), frusta))
        size = settings.resolution
        axes = dr.concat([cast(Float, dr.ravel(_full(getattr(stacked, name), count))) for name in _AXES])
        tensor = type(vertices)
        return tensor(maps.values, (count, size, size, maps.channels)), tensor(axes, (len(_AXES), count, 3))

    values, axes = cross(Repeated("render_maps", run, _LOOP), vertices, *tensors.values())
    views, frusta = kept[0]
    with drjit_turn(vertices.device):
        dr.eval(views, frusta)
    first = tuple(sum(sizes[:k]) for k in range(len(sizes)))
    return ShadowMaps(values, axes, settings, first, views, frusta, values.shape[-1])


@eager
def filter_maps(maps: ShadowMaps) -> ShadowMaps:
    """Filter maps with the kernel of their settings. Maps of methods that compare depths in the look-up stay unfiltered."""
    _check_maps(maps)

    def run(values: TensorXf) -> tuple[TensorXf, ...]:
        flat = _shadow.ShadowMaps(values.array, maps._views, maps._frusta, maps.settings, values.shape[-1])
        return (type(values)(_shadow.filter_maps(flat).values, values.shape),)

    return replace(maps, values=cross(Repeated("filter_maps", run), maps.values)[0])


@eager
def visibility(maps: ShadowMaps, points: torch.Tensor, light: int = 0) -> torch.Tensor:
    """Fraction of a light that reaches each point.

    Args:
        maps: filtered maps.
        points: float32 (..., 3), world space.
        light: number of the light.

    Returns:
        float32 (...), 0 dark to 1 lit; 1 outside of the maps. Attached to the points, the casters and the light.
    """
    _check_maps(maps)
    check_floats("points", points, ("...", 3))
    light = number_of("light", light, int)
    if not 0 <= light < len(maps.first):
        raise ShadowmapError(f"light: {light}, but there are {len(maps.first)} lights, counted from 0.")
    check_devices(points=points, maps=maps.values, axes=maps.axes)
    count, start = maps.axes.shape[1], maps.first[light]
    size = (*maps.first, count)[light + 1] - start

    def run(points: TensorXf, values: TensorXf, axes: TensorXf) -> tuple[TensorXf, ...]:
        module = backend(points)
        row = dr.arange(module.UInt32, count)
        right, up, forward, origin = (vector(axes.array, row + k * count) for k in range(len(_AXES)))
        views = replace(maps._views, right=right, up=up, forward=forward, origin=origin)
        flat = _shadow.ShadowMaps(values.array, views, maps._frusta, maps.settings, values.shape[-1])
        p_world = dr.gather(module.Array3f, points.array, dr.arange(module.UInt32, dr.width(points.array) // 3))
        which: UInt32 | int = start
        if size > 1:
            position = vector(dr.detach(axes.array), _AXES.index("origin") * count + start)
            which = start + _shadow.cube_face(dr.detach(p_world) - position)
        result = _shadow.visibility(flat, which, p_world)
        return (type(points)(_full(result, dr.width(p_world)), points.shape[:-1]),)

    return cross(Repeated("visibility", run), points, maps.values, maps.axes)[0]


def _checked(light: Light, number: int) -> dict[str, torch.Tensor]:
    """The (checked) tensors of a light by their names."""
    if not isinstance(light, Light):
        raise ShadowmapError(f"lights[{number}]: {type(light).__name__}, but must be a light of shadowmap_dr.torch.")
    tensors = {name: value for name, value in vars(light).items() if name != "cutoff_angle"}
    for name, value in tensors.items():
        check_floats(f"lights[{number}].{name}", value, (3,))
        numbers = plain(f"lights[{number}].{name}", value, _LOOP)
        if not bool(torch.isfinite(numbers).all()) or (name == "direction" and not bool(numbers.any())):
            raise ShadowmapError(f"lights[{number}].{name}: {numbers.tolist()}; give three finite numbers that make sense.")
    if isinstance(light, SpotLight):
        number_of(f"lights[{number}].cutoff_angle", light.cutoff_angle, float)
    if isinstance(light, SpotLight) and not 0 < light.cutoff_angle <= 180:
        raise ShadowmapError(f"lights[{number}].cutoff_angle: {light.cutoff_angle}; give degrees above 0, up to 180.")
    return tensors


def _has_cube(light: Light) -> bool:
    return isinstance(light, PointLight) or (isinstance(light, SpotLight) and light.cutoff_angle > _WIDEST_SPOT)


def _light_views(light: Light, number: int, given: dict[str, TensorXf], settings: ShadowSettings) -> Sequence[LightView]:
    def own(name: str) -> Vector3f:
        return vector(given[f"lights[{number}].{name}"].array, 0)

    if isinstance(light, PointLight) or _has_cube(light):
        return _shadow.cube_views(own("position"), settings.resolution, settings.filter_size)
    view = _shadow.directional_view(own("direction"))
    if isinstance(light, DirectionalLight):
        return (view,)
    spread = type(view.spread)(math.tan(math.radians(light.cutoff_angle)))
    return (_shadow.spot_view(own("position"), view.right, view.up, view.forward, spread),)


def _fit(
    views: Views,
    p_light: Vector3f,
    map_index: UInt32,
    settings: ShadowSettings,
    previous: ShadowMaps | None,
    seen: TensorXf | None,
) -> Frusta:
    """Frusta of all maps. The casters count as one shape that is not flat."""
    module = backend(map_index)
    bounds = _shadow.shape_bounds(views, p_light, map_index, module.UInt32(0), 1)
    points = None
    if seen is not None:
        number = dr.width(seen.array) // 3
        points = dr.gather(module.Array3f, seen.array, dr.arange(module.UInt32, number)), dr.full(module.Bool, True, number)
    frusta = previous._frusta if previous is not None else None
    size, kernel = settings.resolution, settings.filter_size
    return _shadow.fit_frusta(views, bounds, module.Bool(True), 1, size, kernel, frusta, points)


def _full(value: _ArrayT, width: int) -> _ArrayT:
    """The array itself, or, if its width is 1, its value repeated ``width`` times."""
    return value if dr.width(value) == width else value + dr.zeros(type(value), width)


def _check_maps(maps: ShadowMaps) -> None:
    check_kind("maps", maps, ShadowMaps)
    size, count = maps.settings.resolution, len(maps._frusta.near)
    check_floats("maps.values", maps.values, (count, size, size, maps._channels))
    check_floats("maps.axes", maps.axes, (len(_AXES), count, 3))
