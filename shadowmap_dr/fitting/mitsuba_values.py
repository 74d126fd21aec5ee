"""Values of the parameters of Mitsuba's objects: given for a while, also in recordings."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from .scene_change import SceneChange

# Classes of Mitsuba's whose parameters may change in recordings.
_RECORDABLE = (
    *("SRGBReflectanceSpectrum", "SRGBEmitterSpectrum", "UniformSpectrum", "BitmapTextureImpl", "SmoothDiffuse", "TwoSidedBRDF"),
    *("AreaLight", "ConstantBackgroundEmitter", "EnvironmentMapEmitter"),
)
# Those in recordings of gradients only: recordings of derivatives in forward mode take longer here than differences of images.
_RECORDABLE_GRADIENTS = (*_RECORDABLE, "MaskBSDF", "ThinDielectric")


def is_recordable(scene: mi.Scene, key: str, *, gradients: bool = False) -> bool:
    """True if a recording may give the parameter of Mitsuba's called ``key`` another value, and its derivative is right.

    Other objects read their parameters back when these change, on which recordings fail; or their derivatives in forward mode are
    wrong (docs/limits.md). ``gradients``: for recordings of gradients, in reverse mode.
    """
    known = _RECORDABLE_GRADIENTS if gradients else _RECORDABLE
    table = mi.traverse(scene)
    node = table.properties[key][2]
    if isinstance(node, mi.Emitter) and dr.is_tensor_v(table[key]):
        return False  # the pixels of a sky
    while node is not None:
        kind = node.class_name().partition("[")[0]  # without the type of a texture's texels
        if kind not in known and not isinstance(node, (mi.Shape, mi.Scene)):
            return False
        node = table.hierarchy[node][0] if node in table.hierarchy else None
    return True


def set_values(scene: mi.Scene, change: SceneChange, *, all_values: bool = True) -> Callable[[], None]:
    """Give parameters of Mitsuba's objects new values; returns a function that gives them the old ones back.

    Args:
        scene: the scene.
        change: the values. Detached ones, if not all of them are set.
        all_values: false to leave out values that the objects have already. Some objects take long to change: rough plastic
            integrates its transmittance anew for each roughness, for 0.1 s.
    """
    if not change.values and not change.arrays:
        return lambda: None
    table = mi.traverse(scene)
    values = {key: type(table[key])(*parts) for key, parts in change.values.items()}
    if not all_values:
        values = {key: value for key, value in values.items() if not np.array_equal(np.array(value), np.array(table[key]))}
    before = {key: type(table[key])(dr.detach(table[key])) for key in (*values, *change.arrays)}

    def restore() -> None:
        for key, value in before.items():
            table[key] = value
        table.update()

    try:
        for key, value in values.items():
            table[key] = value
        for key, (own, shape) in change.arrays.items():
            kind = type(before[key])
            table[key] = kind(own, shape) if dr.is_tensor_v(kind) else kind(own)
        table.update()
    except RuntimeError:
        restore()
        raise
    return restore
