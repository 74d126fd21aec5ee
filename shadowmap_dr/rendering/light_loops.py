"""Many lights of one kind, summed up in a loop on the device.

Unrolled, forty lights and their derivatives make a program that takes minutes to compile.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import drjit as dr
import mitsuba as mi

from ..jit.arrays import device_array
from ..jit.pytree import tree_map
from ..jit.types import Bool, Color3f, Float, Point3f, PyTree, UInt32, Vector3f
from ..scene.lights.light import Illumination
from ..scene.lights.punctual import SpotLight
from ..scene.lights.read import Light
from ..scene.lights.soft_outline import Softened, share_inside
from ..scene.sums import attached_parameters, sum_over
from ..shadow import ShadowMaps, cube_face
from .direct_light import passes_gate
from .gbuffer.surface import Surface
from .light_colours import untextured
from .shadow_pass import MapPlan, share_through

#: Least number of lights of a kind that are summed up in a loop.
MANY_LIGHTS = 8


@dataclass(frozen=True)
class LightTable:
    """Lights of one kind, K of them.

    Attributes:
        light: the first one, for its type.
        numbers: ``Float`` (N K,): the N numbers of each light, one light after the other. Attached.
        first: ``UInt32`` (K,), number of each light's first map.
        cube: True if each light has the six maps of a cube.
    """

    light: Light
    numbers: Float
    first: UInt32
    cube: bool

    @classmethod
    def of(cls, lights: Sequence[Light], first: Sequence[int], cube: bool) -> LightTable:
        """Collect lights of one kind. ``first``: number of each light's first map."""
        numbers = [number for light in lights for number in _numbers(light)]
        chosen = [k for k, number in enumerate(numbers) if dr.grad_enabled(number)]
        if dr.flag(dr.JitFlag.FreezingScope):
            table = dr.concat([mi.Float(number) for number in numbers])
        else:
            dr.eval(numbers)
            table = device_array(mi.Float, [number[0] for number in numbers])
            if chosen:
                attached = dr.concat([numbers[k] for k in chosen]) if len(chosen) > 1 else numbers[chosen[0]]
                dr.scatter(table, attached, device_array(mi.UInt32, chosen), mode=dr.ReduceMode.NoConflicts)
        return cls(tree_map(lights[0], dr.detach), table, _indices(first), cube)

    @property
    def size(self) -> int:
        """K."""
        return dr.width(self.first)

    def at(self, index: UInt32) -> Light:
        """Light number ``index`` (UInt32, for each lane). Attached."""
        each, place = dr.width(self.numbers) // self.size, count()
        row = index * each
        return tree_map(self.light, lambda array: _filled(array, lambda: dr.gather(mi.Float, self.numbers, row + next(place))))


@dataclass(frozen=True)
class Places:
    """Points in the footprints of N pixels, as offsets (Vector3f each) from the pixels' surface points. Detached.

    ``spots``: points of visibility look-ups; ``around``: points half way to the pixel's corners.
    """

    spots: list[Vector3f]
    around: list[Vector3f]

    @classmethod
    def of(cls, p_world: Point3f, spots: Sequence[Point3f], around: Sequence[Point3f]) -> Places:
        """Convert points (Point3f each) to offsets from ``p_world``."""
        middle = dr.detach(p_world)
        offsets = [[mi.Vector3f(dr.detach(point) - middle) for point in points] for points in (spots, around)]
        return cls(*offsets)


def in_tables(lights: Sequence[Light], plan: MapPlan) -> tuple[list[LightTable], list[int]]:
    """(tables of lights, one for each kind with many lights; numbers of the lights in no table)."""
    plain = [untextured(light) for light in lights]
    kinds: dict[Any, list[int]] = {}
    for k, (light, kind) in enumerate(zip(plain, plan.kinds, strict=True)):
        if light is not None:
            kinds.setdefault((type(light), kind), []).append(k)
    many = {kind: members for kind, members in kinds.items() if len(members) >= MANY_LIGHTS}
    tables = [
        LightTable.of([one for k in members if (one := plain[k]) is not None], [plan.first[k] for k in members], kind == "cube")
        for (_, kind), members in many.items()
    ]
    taken = {k for members in many.values() for k in members}
    return tables, [k for k in range(len(lights)) if k not in taken]


def many_lights(
    seen: Surface,
    lights: Sequence[Light],
    plan: MapPlan,
    maps: ShadowMaps | None,
    spots: Sequence[Point3f],
    around: Callable[[], Sequence[Point3f]],
    nodes: Sequence[Any],
) -> tuple[Color3f | int, list[int]]:
    """(radiance towards the camera of all lights in tables (:func:`in_tables`), numbers of the other lights).

    ``spots``: points of visibility look-ups (Point3f (N,) each); ``around``: makes the points half way to the pixel's corners.
    Other arguments and gradients as in :func:`light_of_table`.
    """
    tables, others = in_tables(lights, plan)
    if not tables:
        return 0, others
    places = Places.of(seen.p_world, spots, around())
    return sum(light_of_table(seen, places, table, maps, nodes) for table in tables), others


def light_of_table(seen: Surface, places: Places, table: LightTable, maps: ShadowMaps | None, nodes: Sequence[Any]) -> Color3f:
    """Radiance (colour, N) towards the camera of all lights of a table. Attached to the surface, lights and maps.

    ``maps`` None: unshadowed. ``nodes``: :attr:`~shadowmap_dr.scene.load.SceneData.materials`.
    """

    def one_light(index: UInt32, own: PyTree, shared: PyTree) -> Color3f:
        (seen, places), (table, maps) = own, shared
        light: Illumination = table.at(index)
        if isinstance(light, SpotLight):
            inside = share_inside(light, seen.p_world, [seen.p_world + offset for offset in places.around])
            light = Softened(light, inside)
        wo_world, weight = light.illuminate(seen.p_world, seen.active)
        wo = seen.si.to_local(wo_world)
        active = seen.active & passes_gate(seen, wo_world, wo)
        value = seen.evaluate(wo, active) * weight
        if maps is not None:
            lit = [_share(table, maps, index, light, seen.p_world + offset, seen.active) for offset in places.spots]
            value *= sum(lit) * (1 / len(lit))
        return dr.select(active, value, 0)

    start = dr.zeros(mi.UnpolarizedSpectrum, dr.width(seen.shape))
    implicit = [] if seen.colour is not None else attached_parameters(nodes)
    return sum_over(one_light, table.size, start, (seen, places), (table, maps), implicit, seen.active)


def _share(
    table: LightTable, maps: ShadowMaps, index: UInt32, light: Illumination, p_world: Point3f, active: Bool
) -> Float | Color3f:
    which = dr.gather(mi.UInt32, table.first, index)
    if table.cube:
        punctual: Any = light.light if isinstance(light, Softened) else light  # Any: lights with maps of cubes have a position
        position = punctual.position
        which += cube_face(dr.detach(mi.Vector3f(p_world - position)))
    return share_through(maps, which, p_world, active)


def _numbers(light: Light) -> list[Float]:
    """All numbers of a light, in a fixed order."""
    found: list[Float] = []
    tree_map(light, lambda array: _filled(array, lambda: None, found))
    return found


def _filled(array: Any, number: Callable[[], Float | None], found: list[Float] | None = None) -> Any:
    """An array with other numbers in the place of its own, which are put into ``found`` instead if that is given."""
    if dr.depth_v(array) > 1:
        parts = [_filled(part, number, found) for part in array]
        return array if found is not None else type(array)(*parts)
    if found is not None:
        found.append(array)
        return array
    return number()


def _indices(values: Sequence[int]) -> UInt32:
    if dr.flag(dr.JitFlag.FreezingScope):
        return dr.concat([mi.UInt32(value) for value in values])
    return device_array(mi.UInt32, values)
