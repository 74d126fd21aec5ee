"""One page: its connection, and the messages that it has had."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

from starlette.websockets import WebSocket

from . import messages
from .canvas import Canvas
from .rate_limit import RateLimit
from .session import Session, Snapshot, Status
from .start_mesh import StartMesh

#: Messages that a page may send in a second, and at once after a pause. A page that is drawn on sends about 80 a second.
MOST_MESSAGES, BURST = 400, 200
# Frames that were sent to a page but not shown by it yet. A page that shows none gets no more.
_UNSEEN = 2
# Shortest time between two images of the painting, seconds.
_TARGET_INTERVAL = 1 / 60


class FrameCache:
    """The record of the newest frame, which is the same for all pages."""

    def __init__(self) -> None:
        self._number, self._record = 0, b""

    def record(self, snapshot: Snapshot) -> bytes:
        if self._number != snapshot.number:
            self._number, self._record = snapshot.number, messages.frame(snapshot)
        return self._record


@dataclass(frozen=True, eq=False)
class ShownMesh:
    """The mesh that pages work on.

    Attributes:
        number: grows with each mesh.
        name: of the mesh.
        start: of the session's snapshots of this mesh.
        faces: their record.
    """

    number: int
    name: str
    start: StartMesh | None
    faces: bytes


@dataclass(eq=False)
class Client:
    """A page.

    Attributes:
        number: tells pages apart.
        socket: the connection.
        wake: set when there may be something new to send.
        seq: number of the page's last stroke message.
        mesh: number of the mesh that the page knows.
        rate: of messages from the page.
        refusal: reason why the connection ends, None while it goes on.
    """

    number: int
    socket: WebSocket
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    seq: int = 0
    mesh: int = 0
    rate: RateLimit = field(default_factory=lambda: RateLimit(MOST_MESSAGES, BURST))
    refusal: str | None = None
    _status: Status | None = None
    _target: tuple[int, int] | None = None
    _target_due: float = 0.0
    _frame: int = 0
    _unseen: list[int] = field(default_factory=list)
    _notices: list[str] = field(default_factory=list)
    _slowed: bool = False

    @property
    def frame(self) -> int:
        """Number of the last frame that was sent."""
        return self._frame

    def shown(self, frame: int) -> None:
        """The page has shown a frame, so it may get another one."""
        self._unseen = [number for number in self._unseen if number > frame]
        self.wake.set()

    async def slow_down(self) -> None:
        """Count a message of the page, and let other tasks run, for long enough to keep to the limit. Tells the page once."""
        delay = self.rate.delay(asyncio.get_running_loop().time())
        if delay > 0 and not self._slowed:
            self._slowed = True
            self._notices.append(f"This page sends more than {MOST_MESSAGES} messages a second: they are handled with a delay.")
            self.wake.set()
        await asyncio.sleep(delay)

    def news(self, session: Session, canvas: Canvas, mesh: ShownMesh, frames: FrameCache) -> list[str | bytes]:
        """Messages that the page has not had yet.

        Another mesh comes before its painting and its frames. A painting comes before the frames of meshes that follow it. The
        status "moving" comes before the first frame of a movement, "resting" after the last one.
        """
        # In this order, the status is not older than the snapshot.
        snapshot, status = session.snapshot, session.status
        if snapshot.start is not mesh.start:
            return []  # the canvas is still that of the last mesh; the session wakes the pages
        first: list[str | bytes] = [messages.notice(text) for text in self._notices]
        self._notices.clear()
        if self.mesh != mesh.number:
            self.mesh, self._target = mesh.number, None
            self._unseen.clear()  # the page shows no more frames of the last mesh
            first += [messages.mesh(mesh.name, mesh.number), mesh.faces]
        has_frame = snapshot.number > self._frame and len(self._unseen) < _UNSEEN
        if self._takes_target(canvas, at_once=has_frame):
            first.append(messages.target(canvas, self.seq))
        frame: list[str | bytes] = []
        told: list[str | bytes] = []
        if has_frame:
            frame.append(frames.record(snapshot))
            self._frame = snapshot.number
            self._unseen.append(snapshot.number)
        rests = status.phase == "resting"
        if self._status != status and not (rests and self._frame < session.snapshot.number):
            self._status = status
            told.append(messages.status(status))
        return first + (frame + told if rests else told + frame)

    def _takes_target(self, canvas: Canvas, at_once: bool) -> bool:
        """True if the painting is new to the page, and is due. A new one that is not due yet wakes the page when it is."""
        newest = canvas.version, self.seq
        if self._target == newest:
            return False
        loop = asyncio.get_running_loop()
        now = loop.time()
        if now < self._target_due and not at_once:
            loop.call_at(self._target_due, self.wake.set)
            return False
        self._target, self._target_due = newest, now + _TARGET_INTERVAL
        return True
