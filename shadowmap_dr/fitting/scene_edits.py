"""Edits of a scene file's text, one for each change of a fit, and whether they are found in what Mitsuba reads again."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Protocol

import mitsuba as mi
import numpy as np

from ..scene.transforms import is_transform
from .changes import Array
from .parsed_scene import ParsedScene
from .xml_text import Element, XmlText

#: Largest relative difference between a value and what Mitsuba reads from the written file; of textures, absolute.
TOLERANCE, TEXTURE_TOLERANCE = 1e-4, 1e-3
#: Folder of meshes and pictures beside the scene file.
FILES_FOLDER = "scene_files"


class Unwritable(Exception):
    """A reason why a change cannot be written: a clause for a note."""


class EditedScene(Protocol):
    """A scene whose text is edited. ``changed``: names of parameters that are."""

    parsed: ParsedScene
    changed: set[str]

    def new_file(self, stem: str, suffix: str) -> Path:
        """A file in the folder, with a name that is not taken."""


class Step(ABC):
    """One change: how it is written, and how it is found again. ``owner``: begin of the names of parameters that it changes."""

    owner: str

    @abstractmethod
    def apply(self, scene: EditedScene) -> None:
        """Edit the texts. Raises Unwritable if the change cannot be expressed in a scene file."""

    @abstractmethod
    def difference(self, before: ParsedScene, after: ParsedScene) -> str:
        """The reason why the written scene does not have the change; empty if it has."""


def element_of(parsed: ParsedScene, shape: mi.Shape) -> tuple[XmlText, Element]:
    found = parsed.shape_element(shape)
    if found is None:
        raise Unwritable("it belongs to nothing in the file")
    return found


def text_of(values: Any, between: str = " ") -> str:  # Any: numbers, nested or not
    """Numbers as text, in single precision."""
    return between.join(f"{float(value):.9g}" for value in np.ravel(values))


def matrix_of(value: Any) -> Array:  # Any: a transformation of Mitsuba's, or an array
    matrix = np.array(value.matrix if is_transform(value) else value, np.float64)
    if matrix.ndim == 3:  # of arrays with one entry
        matrix = matrix.reshape(matrix.shape[:2])
    if matrix.shape not in ((4, 4), (3, 3)):
        raise Unwritable(f"its shape {matrix.shape} is not (4, 4)")
    return matrix


def is_close(found: Array, expected: Array, tolerance: float = TOLERANCE) -> bool:
    if found.shape != expected.shape:
        return False
    if not expected.size:
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        most = float(np.abs(np.nan_to_num(expected)).max())
        return bool(np.abs(np.nan_to_num(found) - np.nan_to_num(expected)).max() <= tolerance * max(most, 1e-12))


def numbers_of(value: Any) -> Array | None:  # Any: parameters have values of all kinds
    """A parameter's value in double precision; None if it is no number."""
    try:
        return matrix_of(value) if is_transform(value) else np.array(value, np.float64)
    except (TypeError, ValueError, Unwritable):
        return None
