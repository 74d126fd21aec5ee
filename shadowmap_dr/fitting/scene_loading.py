"""Scene files, loaded so that all of their textures can vary."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi

from ..io.files import no_file
from .parsed_scene import instantiated, parsed, resolving, search_folders, texts_of


def load_scene(file: str | os.PathLike[str], parameters: Mapping[str, str] | None = None) -> mi.Scene:
    """Load a scene file as ``mi.load_file(file, optimize=False)`` does, but with textures in floating-point numbers.

    Mitsuba keeps pictures of 8 bits as they are, and no derivatives flow to them.

    Args:
        file: scene file.
        parameters: values of ``$name`` in it.

    Raises:
        ShadowmapError: Mitsuba does not understand the file, or it is no scene.
    """
    path = Path(file).absolute()
    if not os.path.isfile(path):
        raise no_file("scene", file)
    config, state = parsed(path, parameters or {})
    for node in state.nodes:
        if node.props.plugin_name() == "bitmap" and "format" not in node.props:
            node.props["format"] = "variant"
    with resolving(search_folders(texts_of(state), parameters or {})):
        return instantiated(config, state, path)
