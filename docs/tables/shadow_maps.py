"""Tables of shadow maps."""

from __future__ import annotations

from shadowmap_dr.io.console import markdown

from . import formats
from .records import Lines, record

_MAPS = ("rmse", "rmse_shadowed", "bleeding", "acne", "contour_shift_texels", "derivative_cosine", "derivative_scale")


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
