"""Origins of scenes: a file or a dictionary. Mitsuba's scenes cannot be copied, but they can be loaded again."""

from __future__ import annotations

import os
import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError, check_variant, mitsuba_message
from ..jit.threads import second_thread
from .transforms import is_transform

#: A dictionary for ``mi.load_dict``: numbers, texts, arrays, transformations, dictionaries.
Description: TypeAlias = Mapping[str, Any]


class SceneOrigin:
    """A scene file or a dictionary, and how to load it. Can be pickled.

    Args:
        file: scene file, with its ``parameters`` (values of ``$name`` in it).
        description: or a dictionary for ``mi.load_dict``.
        tessellation: see :func:`shadowmap_dr.scene.load.load`.
    """

    def __init__(
        self,
        file: str | os.PathLike[str] | None = None,
        description: Description | None = None,
        parameters: Mapping[str, str] | None = None,
        tessellation: int = 64,
    ) -> None:
        if file is None and not isinstance(description, Mapping):
            raise ShadowmapError(f"description: {type(description).__name__}, but must be a dictionary for mi.load_dict.")
        self.file = None if file is None else os.path.abspath(file)
        self.description = None if description is None else dict(description)
        self.parameters = dict(parameters or {})
        self.tessellation, self.variant = tessellation, mi.variant()

    def recording_text(self) -> str:
        """Nothing: recordings do not depend on it."""
        return "origin"

    def load(self) -> mi.Scene:
        """The scene, in the variant in which it was loaded first; shapes keep their names.

        Raises:
            ShadowmapError: another variant is set; there is no such file, or Mitsuba does not understand it.
        """
        check_variant(mi.variant(), self.variant)
        what = self.file or "the dictionary"
        try:
            with second_thread():
                if self.file is None:
                    scene: object = mi.load_dict(self.description, optimize=False)
                else:
                    scene = mi.load_file(self.file, optimize=False, **self.parameters)
        except (RuntimeError, TypeError, UnicodeError) as error:
            raise ShadowmapError(f"cannot load {what}: {mitsuba_message(error)}") from error
        if not isinstance(scene, mi.Scene):
            raise ShadowmapError(f"cannot load {what}: its root is a {type(scene).__name__}, not a scene.")
        return scene

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "description": _packed(self.description, "")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, description=_unpacked(state["description"]))


@dataclass(frozen=True)
class _Packed:
    """An object of Mitsuba's without support for pickle: its ``values``, and the name of its type or pixel format."""

    kind: str
    values: npt.NDArray[Any]
    name: str = ""
    gamma: bool = False


def _packed(value: Any, place: str) -> Any:  # Any: a value of any type
    if isinstance(value, Mapping):
        return {key: _packed(item, f"{place}.{key}" if place else str(key)) for key, item in value.items()}
    if is_transform(value):
        return _Packed("transform", np.array(value.matrix), type(value).__name__)
    if isinstance(value, mi.Bitmap):
        return _Packed("bitmap", np.array(value), value.pixel_format().name, value.srgb_gamma())
    try:
        pickle.dumps(value)
    except Exception as error:
        what = f"'{place}' of the scene's dictionary is a {type(value).__name__}"
        raise ShadowmapError(f"{what}, which cannot be pickled: describe it by a dictionary.") from error
    return value


def _unpacked(value: object) -> Any:  # Any: a value of any type
    if isinstance(value, dict):
        return {key: _unpacked(item) for key, item in value.items()}
    if not isinstance(value, _Packed):
        return value
    if value.kind == "transform":
        return getattr(mi, value.name)(value.values)
    bitmap = mi.Bitmap(value.values, getattr(mi.Bitmap.PixelFormat, value.name))
    bitmap.set_srgb_gamma(value.gamma)
    return bitmap
