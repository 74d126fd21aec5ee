"""Messages between server and page: JSON texts, and binary records for meshes and images.

The page sends JSON objects of the types below. Any other message ends its connection, with the reason.

- ``stroke``: id (an integer that the page chooses), seq (an integer that comes back in the next target), mode (``add`` or
  ``erase``), radius, points ([x, y, x, y, ...] in pixels from the top left corner), and mesh (the number of the mesh that is
  painted on; optional). Messages with the same id extend the stroke. Strokes on a mesh that has been replaced are dropped.
- ``undo``, ``redo``, ``clear`` (the painting), ``reset`` (painting and mesh), ``restart`` (after a failure).
- ``mesh``: name (of the mesh to begin with, for all pages), ``target``: name (of a figure, or ``blank``). The first message lists
  the names.
- ``seen``: frame (the number of a frame that the page has shown). The server sends few frames ahead of this number.

The server sends the text messages ``hello``, ``mesh`` (name and number of another mesh; its faces follow), ``status`` and
``notice`` (a line for the user), and records of little-endian 32-bit words. The first word is the kind of the record:

- faces (1): F, then 3 F unsigned integers.
- frame (2): number, steps, version of the target, loss and steps per second (floats), V, then 3 V floats, then H W bytes of
  shadow.
- target (3): version, seq of this page's last stroke, 1 if an edit can be undone, 1 if one can be redone, then H W bytes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from ..inverse import ShadowView
from . import exports
from .canvas import Canvas, Mode
from .session import Snapshot, Status

#: Length of the longest text message from a page, and number of points in the longest stroke message.
MOST_BYTES, MOST_POINTS = 16_384, 512
_FACES, _FRAME, _TARGET = 1, 2, 3
# Length of the longest name of a mesh or target.
_MOST_NAME = 200
# Larger integers would not fit into the words of records.
_MOST_INTEGER = 2**31 - 1

Command = Literal["undo", "redo", "clear", "reset", "restart"]
_COMMANDS = ("undo", "redo", "clear", "reset", "restart")


class MessageError(ShadowmapError):
    """A message that no page should send."""


@dataclass(frozen=True)
class Stroke:
    """A part of a stroke, see `Canvas.stroke`. Points: (N, 2). Mesh: number of the mesh, None for any."""

    id: int
    seq: int
    mode: Mode
    radius: float
    points: npt.NDArray[np.float64]
    mesh: int | None = None


@dataclass(frozen=True)
class Seen:
    """The page has shown a frame."""

    frame: int


@dataclass(frozen=True)
class Choice:
    """A mesh or a target by its name."""

    kind: Literal["mesh", "target"]
    name: str


def parse(text: str, shape: tuple[int, int]) -> Stroke | Seen | Choice | Command:
    """Read a page's message.

    Args:
        text: as received.
        shape: (H, W) of the canvas. Strokes may begin and end a little outside of it.

    Raises MessageError for any message but those above.
    """
    if len(text) > MOST_BYTES:
        raise MessageError(f"a message of {len(text)} characters: {MOST_BYTES} are allowed.")
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        raise MessageError("a message that is not JSON.") from None
    kind = value.get("type") if isinstance(value, dict) else None
    if kind == "stroke":
        return _stroke(value, shape)
    if kind == "seen":
        return Seen(_integer(value, "frame"))
    if kind in ("mesh", "target"):
        name = value.get("name")
        if not isinstance(name, str) or len(name) > _MOST_NAME:
            raise MessageError(f"a {kind} without a name.")
        return Choice(kind, name)
    if kind in _COMMANDS:
        return kind
    raise MessageError("a message of an unknown type.")


def _stroke(value: dict[str, Any], shape: tuple[int, int]) -> Stroke:
    height, width = shape
    if value.get("mode") not in ("add", "erase"):
        raise MessageError("a stroke that neither adds nor erases shadow.")
    radius, points = value.get("radius"), value.get("points")
    if not (isinstance(radius, int | float) and _number(radius) and 0.5 <= radius <= max(shape)):
        raise MessageError(f"a stroke whose radius is not a number from 0.5 to {max(shape)}.")
    if not (isinstance(points, list) and 2 <= len(points) <= 2 * MOST_POINTS and len(points) % 2 == 0):
        raise MessageError(f"a stroke without points, or with more than {MOST_POINTS}.")
    if not all(_number(x) for x in points):
        raise MessageError("a stroke whose points are not numbers.")
    line = np.array(points, np.float64).reshape(-1, 2)
    if (np.abs(line) > 2 * max(height, width)).any():
        raise MessageError("a stroke far outside of the canvas.")
    mesh = _integer(value, "mesh") if "mesh" in value else None
    return Stroke(_integer(value, "id"), _integer(value, "seq"), value["mode"], float(radius), line, mesh)


def _number(value: object) -> bool:
    # The comparison also refuses NaN, and integers that are too large for a float.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e9


def _integer(value: dict[str, Any], name: str) -> int:
    number = value.get(name)
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number <= _MOST_INTEGER:
        raise MessageError(f"{name} is not an integer from 0 to {_MOST_INTEGER}.")
    return number


def hello(view: ShadowView, name: str, mesh: int = 0, meshes: Sequence[str] = (), targets: Sequence[str] = ()) -> str:
    """The first message: canvas, receiver (vectors are in world space), and limits of the page's messages.

    Args:
        view: of the session.
        name, mesh: name and number of the mesh.
        meshes, targets: names that the page may choose.
    """
    height, width = view.shape
    return json.dumps({
        "type": "hello", "name": name, "mesh": mesh, "meshes": list(meshes), "targets": list(targets),
        "height": height, "width": width, "half": view.half, "points": MOST_POINTS, "bytes": exports.MOST_BYTES,
        **{axis: getattr(view, axis).tolist() for axis in ("right", "up", "forward", "origin")},
    })  # fmt: skip


def mesh(name: str, number: int) -> str:
    """Name and number of another mesh. Its faces, its painting and its frames follow."""
    return json.dumps({"type": "mesh", "name": name, "mesh": number})


def status(state: Status) -> str:
    """Status of the optimiser."""
    return json.dumps({"type": "status", "phase": state.phase, "message": state.message})


def notice(text: str) -> str:
    """A line for the user."""
    return json.dumps({"type": "notice", "message": text})


def faces(corners: npt.NDArray[np.uint32]) -> bytes:
    """A record of faces (F, 3)."""
    return struct.pack("<2I", _FACES, len(corners)) + corners.astype("<u4").tobytes()


def frame(snapshot: Snapshot) -> bytes:
    """A record of a mesh and its shadow."""
    number, steps, target = (x & 0xFFFFFFFF for x in (snapshot.number, snapshot.steps, snapshot.target))
    head = struct.pack("<4I2fI", _FRAME, number, steps, target, snapshot.loss, snapshot.speed, len(snapshot.vertices))
    return head + snapshot.vertices.astype("<f4").tobytes() + snapshot.shadow.tobytes()


def target(canvas: Canvas, seq: int) -> bytes:
    """A record of the painting, for a page whose last stroke message had the number `seq`."""
    head = struct.pack("<5I", _TARGET, canvas.version & 0xFFFFFFFF, seq, canvas.can_undo, canvas.can_redo)
    return head + canvas.pixels().tobytes()
