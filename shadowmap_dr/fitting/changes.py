"""Changes that a fit makes to a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy.typing as npt

#: Numbers of any type.
Array: TypeAlias = npt.NDArray[Any]


@dataclass(frozen=True)
class Changes:
    """New values of a scene's parameters.

    Args:
        values: by names of ``mi.traverse(scene)``: floats, colours (3,) or (1,), ``to_world`` (4, 4), ``position`` (3,), and
            textures (H, W, C), linear, under the name of a texture's ``data`` or of a colour's ``value`` that becomes a texture.
            Attributes of meshes, flat.
        transforms: by names of shapes: affine maps (4, 4) of world space, applied after the shape's own ``to_world``.
        vertices: by names of meshes: vertices (V, 3) in world space. They are final: a map of the same shape is not applied.

    The name of a shape is its id, or ``shape_N`` for the N-th shape of the scene, as in :class:`shadowmap_dr.Renderer`.
    """

    values: dict[str, Array] = field(default_factory=dict)
    transforms: dict[str, Array] = field(default_factory=dict)
    vertices: dict[str, Array] = field(default_factory=dict)


@dataclass(frozen=True)
class FittedScene:
    """A scene as a fit leaves it.

    Attributes:
        changes: the fitted values.
        source: the scene's file, or its dictionary; None if neither is known.
        parameters: values of ``$name`` in the file.
        names: names of ``mi.traverse(scene)``, all and in order.
    """

    changes: Changes
    source: Path | Mapping[str, Any] | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    names: Sequence[str] = ()
