"""Tables of shadow maps."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from shadowmap_dr.io.console import markdown

from . import formats
from .records import Lines, record

_MAPS = ("rmse", "rmse_shadowed", "bleeding", "acne", "contour_shift_texels", "derivative_cosine", "derivative_scale")

_MOTIONS = ("sun", "height", "place")


def shadow_maps() -> Lines:
    """All methods on all scenes."""
    digits = (4, 3, 4, 4, 3, 3, 3)
    rows = [
        [
            *(scene, method),
            *(formats.number(e[key], n) for key, n in zip(_MAPS, digits, strict=True)),
            f"{e['seconds_over_plain_vsm']:.2f}",
        ]
        for scene, entries in record("maps")["scenes"].items()
        for method, e in entries.items()
    ]
    return markdown(["scene", "method", "RMSE", "in shadow", "bleeding", "acne", "shift", "cosine", "scale", "time"], rows)


def views() -> Lines:
    """Means over views under the sun: contacts by scene, cities by the camera's place."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for name, view in record("maps-views")["views"].items():
        place = re.sub(r"city, (\w+).*", r"city, \1", name)
        for method, entry in view["methods"].items():
            groups.setdefault((place, method), []).append(entry)
    faults = ("light_in_shadow", "light_in_shadow_inside", "dark_in_light", "rmse", "detachment_pixels")
    digits = (3, 3, 4, 3, 1)
    rows = []
    for (place, method), entries in sorted(groups.items(), key=lambda each: list(groups).index(each[0])):
        numbers = [formats.number(_mean([e.get(key) for e in entries]), n) for key, n in zip(faults, digits, strict=True)]
        moved = [e["derivatives"] for e in entries]
        pairs = [[_mean([m.get(motion, {}).get(key) for m in moved]) for key in ("cosine", "scale")] for motion in _MOTIONS]
        seconds = _mean([e.get("seconds") for e in entries])
        time = "-" if seconds is None else formats.time(max(seconds, 1e-6))
        rows.append([place, method, *numbers, time, *(_pair(*pair) for pair in pairs)])
    columns = ["scene", "method", "light in shadow", "inside", "dark in light", "RMSE", "detached"]
    return markdown([*columns, "time", *(f"{motion}: c, s" for motion in _MOTIONS)], rows)


def _pair(cosine: float | None, scale: float | None) -> str:
    return "-" if cosine is None else f"{formats.number(cosine, 2)}, {formats.number(scale, 2)}"


def _mean(values: list[float | None]) -> float | None:
    """Mean of those that are numbers."""
    found = [value for value in values if value is not None and np.isfinite(value)]
    return float(np.mean(found)) if found else None


def poses_by_map() -> Lines:
    """Poses found with all methods."""
    rows = [
        [name, f"{e['found']} of {e['runs']}", f"{e['median_rotation_deg']:.3f} deg", f"{e['median_offset_x100']:.3f}"]
        for name, e in record("maps")["poses"].items()
    ]
    return markdown(["method", "found", "rotation", "100 x offset"], rows)


def methods() -> Lines:
    """The choice of a method."""
    scenes = record("maps")["scenes"]
    stored = {"vsm": 2, "esm": 1, "evsm2": 2, "evsm4": 4, "msm": 4, "csm": 16, "pcf": 3}
    rows = [
        [
            f"`{name}`" + ", `shadow_order` 8" * (name == "csm"),
            str(numbers),
            f"{scenes['tiers'][name]['bleeding']:.4f}",
            f"{scenes['sheet'][name]['rmse']:.4f}",
            f"{scenes['tiers'][name]['seconds_over_plain_vsm']:.2f}",
        ]
        for name, numbers in stored.items()
    ]
    return markdown(["method", "numbers a texel", "bleeding, `tiers`", "RMSE, `sheet`", "time, `tiers`"], rows)
