"""Paths of the scenes, meshes and pictures in the package."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import ShadowmapError, did_you_mean
from .files import check_name


def scenes_dir() -> Path:
    """Folder of the XML scenes: `scenes/` of a source checkout, else the copy inside the installed package."""
    package = Path(__file__).resolve().parents[1]
    for folder in (package.parent / "scenes", package / "_scenes"):
        if (folder / "meshes").is_dir():
            return folder
    raise ShadowmapError(f"the folder of scenes is missing beside {package}: reinstall shadowmap-dr.")


def scene_names() -> list[str]:
    """Names that `scene` accepts."""
    return sorted(path.stem for path in scenes_dir().glob("*.xml"))


def scene(name: str) -> Path:
    """Path of a scene by its name ("pose"), or of an XML file given by path."""
    return _find(name, ".xml", scenes_dir(), scene_names(), "scene")


def mesh_names() -> list[str]:
    """Names that `mesh` accepts."""
    return sorted(path.stem for path in (scenes_dir() / "meshes").glob("*.ply"))


def mesh(name: str) -> Path:
    """Path of a mesh by its name ("spot"), or of a mesh file given by path."""
    return _find(name, ".ply", scenes_dir() / "meshes", mesh_names(), "mesh")


def target_names() -> list[str]:
    """Names that `target` accepts."""
    return sorted(path.stem for path in (scenes_dir() / "targets").glob("*.png"))


def target(name: str) -> Path:
    """Path of a picture for shadow art by its name ("heart"), or of an image file given by path."""
    return _find(name, ".png", scenes_dir() / "targets", target_names(), "image")


def _find(name: str, suffix: str, folder: Path, known: list[str], kind: str) -> Path:
    if name in known:
        return folder / (name + suffix)
    check_name(name)
    path = Path(name)
    if os.path.isfile(path):
        return path.resolve()
    raise ShadowmapError(f"no {kind} {name!r}: give a file that exists, or one of {', '.join(known)}.{did_you_mean(name, known)}")
