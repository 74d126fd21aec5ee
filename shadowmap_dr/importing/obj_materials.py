"""Values of OBJ files' materials (.mtl) that trimesh reads, but leaves out of a material of metal and roughness.

Format: Wavefront, "MTL material format"; Pr and Pm are those of the extension for physically based rendering that Blender writes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from .model import Array, Material

# Pictures that are left out, by their keys.
_PICTURES = {
    **dict.fromkeys(("map_bump", "bump"), "bump maps"),
    "norm": "normal maps",
    "map_d": "pictures of opacity",
    "map_ke": "pictures of emission",
    **dict.fromkeys(("map_pr", "map_pm", "map_ns"), "pictures of roughness and metal"),
}


def completed(material: Material, values: Mapping[str, Any]) -> Material:  # Any: words of a line
    """A material with the opacity (d, Tr), emission (Ke), roughness (Pr) and metal (Pm) of its library.

    ``values``: words by the key, in lower case. Opacities of zero are those of exporters that mean one: such a surface is whole.
    """
    opacity = _number(values.get("d"))
    if opacity is None and (transparency := _number(values.get("tr"))) is not None:
        opacity = 1 - transparency
    emission, roughness, metallic = _numbers(values.get("ke")), _number(values.get("pr")), _number(values.get("pm"))
    return replace(
        material,
        opacity=opacity if opacity is not None and 0 < opacity < 1 else material.opacity,
        emission=np.maximum(emission, 0) if len(emission) == 3 else material.emission,
        roughness=material.roughness if roughness is None else float(np.clip(roughness, 0, 1)),
        metallic=material.metallic if metallic is None else float(np.clip(metallic, 0, 1)),
    )


def left_out(values: Mapping[str, Any]) -> list[str]:  # Any: words of a line
    """Names of pictures that a material has and that are not read."""
    return sorted({words for key, words in _PICTURES.items() if key in values})


def _number(words: Sequence[str] | None) -> float | None:
    numbers = _numbers(words)
    return float(numbers[-1]) if len(numbers) else None


def _numbers(words: Sequence[str] | None) -> Array:
    """The finite numbers of a line; none if it has other words, but for the option -halo."""
    try:
        numbers = np.array([float(word) for word in words or () if word != "-halo"], np.float64)
    except ValueError:
        return np.empty(0)
    return numbers if np.isfinite(numbers).all() else np.empty(0)


def objects_of(names: Mapping[str, str]) -> dict[str, str]:
    """Names of meshes without their materials, where an object has one material alone.

    ``names``: of materials, by names of meshes, which trimesh makes of an object and its material: ``door_wood``.
    """
    found = {name: name.removesuffix(f"_{material}") for name, material in names.items()}
    plain = list(found.values())
    return {name: short if plain.count(short) == 1 and short not in names else name for name, short in found.items()}
