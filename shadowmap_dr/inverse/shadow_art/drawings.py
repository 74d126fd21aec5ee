"""Rasterization of drawings (SVG), in a process of its own: no drawing can end ours, stop it, or take its memory."""

from __future__ import annotations

import gzip
import io
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ...errors import ShadowmapError, install_hint

# Pixels along the longer side of rasterized drawings, and their largest aspect ratio.
_SIDE, _MOST_SIDES_DIFFER = 1024, 64
# Limits: bytes of a drawing's text, and memory (address space) and seconds of its rasterization.
_MOST_BYTES, _MOST_MEMORY, _MOST_SECONDS = 64_000_000, 2 << 30, 60
# Syntax of lengths, and their units in pixels.
_LENGTH = re.compile(r"\+?([0-9.]+(?:[eE][-+]?[0-9]+)?)(|%|px|pt|pc|mm|cm|in|em|ex)")
_UNITS = {"": 1, "px": 1, "pt": 4 / 3, "pc": 16, "mm": 96 / 25.4, "cm": 960 / 25.4, "in": 96, "em": 12, "ex": 6}
_UNREADABLE = 3
# The drawing comes as standard input, the PNG leaves as standard output. The lines of a failed allocation are not for users.
_CHILD = f"""
import sys
side, memory, *sys.path = int(sys.argv[1]), int(sys.argv[2]), *sys.argv[3:]
import resvg_py
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
except (ImportError, ValueError, OSError):
    pass  # a system without such limits
try:
    image = resvg_py.svg_to_bytes(svg_string=sys.stdin.buffer.read().decode(), dpi=96, width=side, height=side)
except ValueError:
    sys.exit({_UNREADABLE})
sys.stdout.buffer.write(bytes(image))
"""


def rasterized(path: Path) -> bytes:
    """A PNG of a drawing (.svg, .svgz), its longer side 1024 pixels. ShadowmapError if there can be none."""
    try:
        import resvg_py  # noqa: F401
    except ModuleNotFoundError as error:
        raise ShadowmapError(f"{path}: drawings need the package resvg-py: {install_hint('art')}.") from error
    try:
        text = _text(path)
        width, height = _size(text)
    except (ValueError, ElementTree.ParseError, OSError, EOFError, zlib.error) as error:
        if isinstance(error, ShadowmapError):
            raise
        raise ShadowmapError(f"cannot read {path}: it is no drawing, or it is damaged.") from error
    # The rasterizer rounds the shorter side up to a pixel and makes the longer one fit: millions of pixels in a narrow drawing.
    if max(width, height) > _MOST_SIDES_DIFFER * min(width, height):
        raise ShadowmapError(
            f"cannot read {path}: a drawing of {width:g} x {height:g} is too narrow; its sides may differ by "
            f"{_MOST_SIDES_DIFFER} times."
        )
    # `-I` keeps modules in the current folder out; ours come from where they came from here.
    command = [sys.executable, "-I", "-c", _CHILD, str(_SIDE), str(_MOST_MEMORY), *filter(os.path.isabs, sys.path)]
    limits = f"{_MOST_SECONDS} seconds and {_MOST_MEMORY >> 30} GiB"
    try:
        run = subprocess.run(command, input=text, capture_output=True, timeout=_MOST_SECONDS)
    except subprocess.TimeoutExpired:
        raise ShadowmapError(f"cannot read {path}: the drawing takes more than {limits}; simplify it, or give a PNG.") from None
    except OSError as error:
        raise ShadowmapError(f"cannot read {path}: no process for the rasterizer ({error.strerror or error}).") from error
    if run.returncode == _UNREADABLE:
        raise ShadowmapError(f"cannot read {path}: it is no drawing, or it is damaged.")
    if run.returncode != 0:
        raise ShadowmapError(f"cannot read {path}: the rasterizer ended, within {limits}; simplify it, or give a PNG.")
    return run.stdout


def _text(path: Path) -> bytes:
    with gzip.open(path) if path.suffix.lower() == ".svgz" else path.open("rb") as file:
        text = file.read(_MOST_BYTES + 1)
    if len(text) > _MOST_BYTES:
        raise ShadowmapError(f"cannot read {path}: the drawing has more than {_MOST_BYTES} bytes; simplify it, or give a PNG.")
    return text


def _size(text: bytes) -> tuple[float, float]:
    """(width, height) of a drawing in pixels, at least 1. ValueError if the text is no drawing."""
    root = next((element for _, element in ElementTree.iterparse(io.BytesIO(text), ("start",))), None)
    if root is None or root.tag.rpartition("}")[2] != "svg":
        raise ValueError("no element svg")
    box = [float(number) for number in re.split(r"[\s,]+", root.get("viewBox", "").strip()) if number]
    box = box[2:] if len(box) == 4 else []
    if box and not min(box) > 0:
        raise ValueError("no extent")
    given = [_length(root.get(name, ""), whole) for name, whole in zip(("width", "height"), box or (100.0, 100.0), strict=True)]
    if box:
        # If one length is missing, it follows from the other and the proportions of the box.
        scales = [side / whole for side, whole in zip(given, box, strict=True) if side is not None] or [1.0]
        sides = [scales[0] * whole if side is None else side for side, whole in zip(given, box, strict=True)]
    else:
        sides = [100.0 if side is None else side for side in given]
    if not (np.isfinite(sides).all() and min(sides) > 0):
        raise ValueError("no extent")
    return max(sides[0], 1.0), max(sides[1], 1.0)


def _length(text: str, whole: float) -> float | None:
    """A length of a drawing in pixels, at 96 to the inch; None if it is no length. ``whole``: 100 %, in pixels."""
    found = _LENGTH.fullmatch(text.strip())
    if found is None:
        return None
    return float(found[1]) * (whole / 100 if found[2] == "%" else _UNITS[found[2]])
