"""Scene files, loaded so that all of their textures can vary."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..errors import ShadowmapError, mitsuba_message
from .parsed_scene import resolving


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
    if not path.is_file():
        raise ShadowmapError(f"no scene {str(file)!r}: the file does not exist.")
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    with resolving([path.parent]):
        try:
            state = mi.parser.parse_file(config, str(path), **(parameters or {}))
            for node in state.nodes:
                if node.props.plugin_name() == "bitmap" and "format" not in node.props:
                    node.props["format"] = "variant"
            mi.parser.transform_all(config, state)
            scene: Any = mi.parser.instantiate(config, state)  # Any: no stub says it is a scene
        except (RuntimeError, TypeError, UnicodeError) as error:
            raise ShadowmapError(f"cannot load {file}: {mitsuba_message(error)}") from error
    scene = scene[0] if isinstance(scene, list) and len(scene) == 1 else scene
    if not isinstance(scene, mi.Scene):
        raise ShadowmapError(f"cannot load {file}: its root is a {type(scene).__name__}, not a scene.")
    return scene
