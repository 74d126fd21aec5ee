"""The parameters of fits in loops of PyTorch: poses, lights, colours and cameras by names, from a tensor of few numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import torch

from ..errors import ShadowmapError, check_variant
from ..fitting.own import Own
from ..fitting.resolve import Resolver
from ..fitting.scene_change import SceneChange
from ..fitting.vary import Vary
from ..jit.types import Float, TensorXf
from .bridge import drjit_turn, number
from .checks import check_devices, check_floats, check_kind
from .crossing import Repeated, cross, eager
from .render import Renderer


class Parameters:
    """Numbers that change a scene, as :func:`shadowmap_dr.fit` has them, for a loop of PyTorch.

    ``renderer.render(**parameters(x))`` is the image at the numbers x, attached to them.

    Numbers are zero in the scene as it was given, and about one where much has changed: radians, shares of an extent, logarithms.
    One step size serves them all.

    Args:
        renderer: of the scene.
        vary: things that vary, as for :func:`shadowmap_dr.fit`: ``"bunny:pose"``, ``"sun:direction"``, or parametrisations
            of your own (:class:`shadowmap_dr.fitting.Own`).

    Attributes:
        count: the number n of numbers.
        labels: names of the numbers.
        units: units of :meth:`values`: "deg", "times", "units" for those of the scene.

    Raises:
        ShadowmapError: names that the scene does not have; textures and vertices, which need no parametrisation.
    """

    @eager
    def __init__(self, renderer: Renderer, vary: str | Vary | Own | Sequence[str | Vary | Own | Mapping[str, Any]]) -> None:
        check_kind("renderer", renderer, Renderer)
        entries = [vary] if isinstance(vary, (str, Vary, Own)) else vary
        self._renderer, self._device = renderer._renderer, renderer._device
        with drjit_turn(self._device):
            check_variant(mi.variant(), renderer._variant)
            chosen = [entry if isinstance(entry, Own) else Vary.of(entry) for entry in entries]
            self._parameters, arrays = Resolver(self._renderer).parameters(chosen)
            if arrays:
                raise ShadowmapError(
                    f"{arrays[0].vary.named}: textures and vertices are tensors already: give them to render() as "
                    "parameters= or vertex_positions=."
                )
            if not self._parameters:
                raise ShadowmapError("nothing varies: name something, for instance 'bunny:pose'.")
            self.labels = tuple(_label(one.vary.label, label) for one in self._parameters for label in one.labels)
            self.units = tuple(unit for one in self._parameters for unit in one.units)
            self.count = len(self.labels)
            self._tensors = [entry for entry, _ in self._found(mi.TensorXf(dr.zeros(mi.Float, self.count)))]

    @property
    def start(self) -> torch.Tensor:
        """Numbers of the scene as it was given: float32 (n,), zeros, which requires gradients. A new tensor each time."""
        return torch.zeros(self.count, device=self._device, requires_grad=True)

    @eager
    def __call__(self, x: torch.Tensor, sensor: int = 0) -> dict[str, Any]:
        """Arguments of :meth:`Renderer.render` for numbers.

        Args:
            x: float32 (n,).
            sensor: number of the scene's sensor.

        Returns:
            ``sensor``, and as far as they change: ``transforms``, ``lights``, ``camera``, ``parameters``, attached to x.

        Raises:
            ShadowmapError: a tensor that does not fit.
        """
        check_floats("x", x, (self.count,))
        check_devices(x=x)
        tensors = cross(Repeated("Parameters", lambda numbers: [one for _, one in self._found(numbers)]), x)
        result: dict[str, Any] = {"sensor": sensor}
        for place, tensor in zip(self._tensors, tensors, strict=True):
            if place.argument == "camera":
                if place.name == sensor:
                    result.setdefault("camera", {})[place.field] = tensor
            elif place.field:
                result.setdefault(place.argument, {}).setdefault(place.name, {})[place.field] = tensor
            else:
                result.setdefault(place.argument, {})[place.name] = tensor
        return result

    def values(self, x: torch.Tensor) -> npt.NDArray[np.float64]:
        """Values (n,) of numbers (n,) in :attr:`units`, detached."""
        check_floats("x", x, (self.count,))
        numbers = x.detach().cpu().double().numpy()
        return np.concatenate([one.scale.shown(numbers[part]) for one, part in self._parts()])

    def numbers(self, values: npt.ArrayLike) -> torch.Tensor:
        """Numbers, float32 (n,), of values (n,) in :attr:`units`, detached."""
        given = np.asarray(values, np.float64)
        if given.shape != (self.count,):
            raise ShadowmapError(f"values: shape {given.shape}, but must be ({self.count},).")
        found = [
            np.log(given[part] / one.scale.offset)
            if one.scale.logarithmic
            else (given[part] - one.scale.offset) / one.scale.factor
            for one, part in self._parts()
        ]
        return torch.tensor(np.concatenate(found), dtype=torch.float32, device=self._device)

    def _parts(self) -> list[tuple[Any, slice]]:  # Any: a Parameter
        """Parameters with their places among the numbers."""
        ends = np.cumsum([0, *(len(one.labels) for one in self._parameters)]).tolist()
        return [(one, slice(a, b)) for one, a, b in zip(self._parameters, ends[:-1], ends[1:], strict=True)]

    def _found(self, x: TensorXf) -> list[tuple[_Entry, TensorXf]]:
        """Tensors of the change of the scene at numbers, with their places in the arguments of ``render``."""
        change = SceneChange(self._renderer)
        for one, part in self._parts():
            one.put([number(x.array, k) for k in range(part.start, part.stop)], change)
        found = [(_Entry("transforms", name), _tensor(matrix)) for name, matrix in change.placements.items()]
        for name, light in change.lights.items():
            found += [(_Entry("lights", name, field), one) for field, one in _changed(self._renderer.light(name), light)]
        for sensor, record in change.cameras.items():
            old = self._renderer.data.cameras(sensor)[0]
            found += [(_Entry("camera", sensor, field), one) for field, one in _changed(old, record)]
        found += [(_Entry("parameters", key), _joined(parts)) for key, parts in change.values.items()]
        return found


@dataclass(frozen=True)
class _Entry:
    """Place of a tensor in the arguments of ``render``: ``name`` of an object, or number of a sensor."""

    argument: str
    name: str | int
    field: str = ""


def _changed(old: Any, new: Any) -> list[tuple[str, TensorXf]]:  # Any: one of several records
    """Fields of a record that are others than those of the old one."""
    names = [field.name for field in fields(new) if getattr(new, field.name) is not getattr(old, field.name)]
    return [(name, _tensor(getattr(new, name))) for name in names]


def _tensor(value: Any) -> TensorXf:  # Any: a transformation, a matrix, a vector, a colour or a number
    """A tensor of a value: (4, 4), (3,) or (1,)."""
    if dr.is_matrix_v(value) or not dr.is_array_v(value):
        matrix: Any = value if dr.is_matrix_v(value) else value.matrix  # Any: entries are numbers, unlike in the stubs
        return mi.TensorXf(_joined([matrix[row, column] for row in range(4) for column in range(4)]).array, (4, 4))
    return _joined([value] if dr.depth_v(value) == 1 else list(value))


def _joined(parts: Sequence[Float]) -> TensorXf:
    """A tensor (n,) of n numbers, each of width 1."""
    return mi.TensorXf(dr.concat([mi.Float(part) for part in parts]))


def _label(entry: str, label: str) -> str:
    return entry if label in ("", "value", "factor") else f"{entry} {label}"
