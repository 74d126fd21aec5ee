"""Scenes whose parameters change between two images of the plug-in, and derivatives by one of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .outcome import Refused, check
from .scenes import SMALL, random_scene, scene_entry
from .values import NUMBERS, chance, pick

# Parameters that Mitsuba trusts: wrong ones end the process there.
_TRUSTED = ("faces", "_count", "size", "crop", "grid", "knot", "lod")
_LARGE = 1e6


def run(rng: np.random.Generator, folder: Path) -> str:
    """Render, change parameters, render again, and differentiate."""
    plugins = random_scene(rng, folder, damaged=False)
    own = {name: value for name, value in plugins.pop("integrator", {}).items() if name != "type"}
    integrator: Any = _loaded({"type": "shadowmap", **SMALL, **own})
    scene: Any = _loaded({"type": "scene", **{name: scene_entry(part) for name, part in plugins.items()}})
    if not scene.sensors():
        raise Refused("the scene has no sensor.")
    params = mi.traverse(scene)
    before = mi.render(scene, params, integrator=integrator, spp=1).numpy()
    check(np.isfinite(before).all(), "the first image is not finite")
    names = [name for name in params.keys() if not any(word in name for word in _TRUSTED)]  # noqa: SIM118
    moderate = True
    for _ in range(int(rng.integers(0, 3))):
        name = pick(rng, names)
        changed = _changed(rng, params[name])
        if changed is not None:
            params[name] = changed
            moderate &= _is_moderate(changed)
    try:
        params.update()
    except (RuntimeError, ValueError, TypeError) as error:  # of Mitsuba's: a value that it does not take
        if any(type(e).__name__ == "ShadowmapError" for e in (error, error.__cause__, error.__context__)):
            raise
        raise Refused(" ".join(str(error).split())[:300] or "Mitsuba does not take the value") from error
    by = pick(rng, names)
    value = params[by]
    attached = dr.is_array_v(value) and dr.is_diff_v(value) and dr.is_float_v(value)
    if attached:
        dr.enable_grad(params[by])
        params.set_dirty(by)
        params.update()
    image = mi.render(scene, params, integrator=integrator, spp=1)
    pixels = image.numpy()
    check(pixels.shape == before.shape, f"an image of shape {pixels.shape} after one of {before.shape}")
    check(np.isfinite(pixels).all() or not moderate, f"an image is not finite after finite changes ({by})")
    if attached and dr.grad_enabled(image):
        dr.backward(dr.sum(image.array))
        gradient = np.asarray(dr.ravel(dr.grad(params[by])).numpy())
        check(np.isfinite(gradient).all() or not moderate, f"the gradient by {by} is not finite")
        return f"gradient by {by}"
    return f"mean {pixels.mean():.3f}"


def _loaded(description: dict[str, Any]) -> Any:
    try:
        return mi.load_dict(description, optimize=False)
    except (RuntimeError, TypeError, UnicodeError) as error:
        raise Refused("Mitsuba does not load it") from error


def _changed(rng: np.random.Generator, value: Any) -> Any:
    """Another value of the same type and size; None for types that have none."""
    if isinstance(value, (float, int)) and not isinstance(value, bool):
        return None
    if not (dr.is_array_v(value) and dr.is_float_v(value)) or dr.is_matrix_v(value):
        return None
    flat = np.array(dr.ravel(value).numpy(), np.float32)
    if not flat.size:
        return None
    kind = int(rng.integers(4))
    if kind == 0:
        flat = flat * np.float32(rng.uniform(0.5, 1.5))
    elif kind == 1:
        flat = flat + rng.normal(0, 0.1, flat.shape).astype(np.float32)
    elif kind == 2:
        flat = np.zeros_like(flat)
    else:
        with np.errstate(over="ignore"):
            flat[int(rng.integers(flat.size))] = np.float32(pick(rng, NUMBERS))
    if dr.is_tensor_v(value):
        return type(value)(flat.reshape(value.shape))
    if dr.depth_v(value) == 1:
        return type(value)(flat) if chance(rng, 0.95) else type(value)(flat[: max(1, flat.size // 2)])
    return dr.unravel(type(value), dr.leaf_t(type(value))(flat)) if dr.width(value) == 1 else None


def _is_moderate(value: Any) -> bool:
    """True if values are finite and no extreme ones."""
    flat = np.abs(np.asarray(dr.ravel(value).numpy(), np.float64))
    return bool(np.isfinite(flat).all() and flat.max(initial=0) < _LARGE)
