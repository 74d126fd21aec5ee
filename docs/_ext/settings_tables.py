"""Tables of the plug-in's parameters and of further channels, from the records that define them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from dataclasses import Field, fields

from sphinx.errors import ExtensionError
from tables import code, table

from shadowmap_dr import ShadowmapError
from shadowmap_dr.integrator.options import Options
from shadowmap_dr.rendering.film.aovs import AOVS
from shadowmap_dr.rendering.settings import AUTO

#: Values of channels, their units, and their value where nothing is seen.
CHANNELS = {
    "depth": ("distance from the camera along the ray, world units", "0"),
    "position": ("point that is seen, world space", "0"),
    "normal": ("shading normal, world space, unit length", "0"),
    "shape_index": ("number of the shape, counted from 0", "-1"),
    "prim_index": ("number of the triangle in its shape, counted from 0", "-1"),
    "opacity": ("share of the light from behind all surfaces that they take away, anti-aliased where some are translucent", "0"),
    "transmittance": ("share of the light that translucent casters let through; three channels for each such light", "1"),
    "visibility": ("fraction of the light that arrives; a channel for each light but area lights and skies, named after it", "1"),
}
#: Largest number that is tried.
_MOST = 1 << 24


def settings() -> str:
    """A table (Markdown) of all parameters: type, default, accepted values, meaning."""
    texts = _descriptions()
    rows = []
    for option in fields(Options):
        if option.name not in texts:
            raise ExtensionError(f"the docstring of Options does not describe '{option.name}'.")
        rows.append((code(option.name), type(option.default).__name__, code(_shown(option.default)), _accepted(option)))
    return table(("Parameter", "Type", "Default", "Values", "Meaning"), [(*row, texts[row[0].strip("`")]) for row in rows])


def channels() -> str:
    """A table (Markdown) of all further channels."""
    if CHANNELS.keys() != AOVS.keys():
        raise ExtensionError(f"channels without a description: {sorted(AOVS.keys() ^ CHANNELS.keys())}.")
    rows = []
    for name, suffixes in AOVS.items():
        names = ", ".join(code(name + suffix) for suffix in suffixes) or code(f"{name}.LIGHT")
        rows.append((code(name), names, *CHANNELS[name]))
    return table(("Name", "Channels", "Value", "Where nothing is seen"), rows)


def _descriptions() -> dict[str, str]:
    """Text of each parameter in the docstring of the record."""
    texts: dict[str, str] = {}
    name = ""
    for line in inspect.getdoc(Options).splitlines()[1:]:
        item = re.fullmatch(r"(\w+) {2,}(\S.*)", line)
        if item:
            name, texts[item[1]] = item[1], item[2]
        elif name and line.strip():
            texts[name] += " " + line.strip()
    return {name: text.replace("``", "`") for name, text in texts.items()}


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if value != "" else '""'


def _accepted(option: Field[object]) -> str:
    """Values that the records accept for a parameter while all others have their defaults, found by trying."""
    if option.name == "aovs":
        return "[channels](channels.md)"
    if option.name == "recorded":
        return f"{code(AUTO)}, `true`, `false`"
    if isinstance(option.default, bool):
        return "`true`, `false`"
    if option.name in ("shadow_map_resolution", "area_light_samples", "translucent_layers"):
        return f"{code(AUTO)}; {_whole_numbers(lambda value: _error(option.name, value) is None)}"
    if isinstance(option.default, str):
        return ", ".join(map(code, _choices(option.name)))

    def accepts(value: float) -> bool:
        return _error(option.name, value) is None

    return _whole_numbers(accepts) if isinstance(option.default, int) else _numbers(accepts)


def _error(name: str, value: object) -> str | None:
    try:
        Options(**{name: value}).render_settings()
    except (ShadowmapError, ValueError) as error:
        return str(error)
    return None


def _choices(name: str) -> list[str]:
    """Names that a parameter accepts, as the error for a wrong one lists them."""
    words = re.split(r"choose (?:one of )?", _error(name, "?") or "")[-1]
    names = [word for word in re.findall(r"\w+", words) if word != "or"]
    wrong = [word for word in names if _error(name, word) is not None]
    if wrong or not names:
        raise ExtensionError(f"the error for a wrong '{name}' does not list its values: {words!r}.")
    return names


def _whole_numbers(accepts: Callable[[float], bool]) -> str:
    low = [value for value in range(-4, 33) if accepts(value)]
    if low[:2] == [0, 1] and not accepts(2):  # 0 has a meaning of its own
        return "0; " + _whole_numbers(lambda value: value > 0 and accepts(value))
    odd, even = (all(value % 2 == rest for value in low) for rest in (1, 0))
    step = 2 if odd or even else 1
    words = "odd, " if odd else "even, " if even else ""
    least = low[0]
    if accepts(_MOST + least):
        return f"{words}{least} or more"
    good, bad = least, _MOST + least
    while bad - good > step:
        middle = good + (bad - good) // (2 * step) * step
        good, bad = (middle, bad) if accepts(middle) else (good, middle)
    return f"{words}{least} to {good}"


def _numbers(accepts: Callable[[float], bool]) -> str:
    low = "any" if accepts(-1.0) else "0 or more" if accepts(0.0) else "above 0"
    if accepts(float(_MOST)):
        return low
    return {"0 or more": "0 to below 1", "above 0": "above 0, below 1"}[low] if not accepts(1.0) else f"{low}, up to 1"
