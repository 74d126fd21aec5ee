"""The connections of a modelling session: pages that paint on one canvas and watch one mesh."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

import anyio
from starlette.websockets import WebSocket, WebSocketDisconnect

from ..inverse import ShadowView
from . import messages
from .canvas import Canvas
from .session import Session, Status

#: Most pages at a time.
MOST_CLIENTS = 8
# Frames that a page has been sent but has not shown; a page that shows none gets no more.
_UNSEEN = 2
# Seconds until a page that takes nothing off its connection is given up.
_PATIENCE = 20.0
# What a connection ends with when the page has gone: closed, or asleep.
_GONE = (WebSocketDisconnect, TimeoutError, ConnectionError)


@dataclass(eq=False)
class _Client:
    """A page."""

    number: int
    socket: WebSocket
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    seq: int = 0
    status: Status | None = None
    target: tuple[int, int] | None = None
    frame: int = 0
    unseen: list[int] = field(default_factory=list)


class Connections:
    """State that pages share. Lives in the event loop's thread; all work on meshes is done in the session's.

    Each page has a task that sends whatever it lacks of the newest state. What a slow page misses is never queued.

    Args:
        session: started.
        view: of the session's sculptor.
        name: of the mesh.
    """

    def __init__(self, session: Session, view: ShadowView, name: str) -> None:
        self.session, self.view = session, view
        self.canvas = Canvas(session.snapshot.shadow / 255)
        self._hello = messages.hello(view, name)
        self._faces = messages.faces(session.faces)
        self._clients: set[_Client] = set()
        self._numbers = itertools.count()
        self._frame = (0, b"")

    def attach(self) -> None:
        """To be called once in the event loop: from then on, the session wakes the pages."""
        loop = asyncio.get_running_loop()

        def woken() -> None:
            try:
                loop.call_soon_threadsafe(self.wake)
            except RuntimeError:
                pass  # the loop has ended; so will the session

        self.session.on_change = woken

    def wake(self) -> None:
        """Let all pages look for what is new."""
        for client in self._clients:
            client.wake.set()

    def paint(self) -> None:
        """Tell optimiser and pages that the canvas has changed."""
        self.session.set_target(self.canvas.target(), self.canvas.version)
        self.wake()

    async def serve(self, socket: WebSocket) -> None:
        """A connection, from beginning to end."""
        await socket.accept()
        if len(self._clients) >= MOST_CLIENTS:
            await socket.close(1013, f"{MOST_CLIENTS} pages are open already: close one of them.")
            return
        client = _Client(next(self._numbers), socket)
        self._clients.add(client)
        try:
            async with anyio.create_task_group() as group:

                async def run(half: Callable[[_Client], Awaitable[None]]) -> None:
                    try:
                        await half(client)
                    except _GONE:
                        pass
                    group.cancel_scope.cancel()

                group.start_soon(run, self._send)
                group.start_soon(run, self._receive)
        finally:
            self._clients.discard(client)

    async def _receive(self, client: _Client) -> None:
        while True:
            message = await client.socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            try:
                if message.get("text") is None:
                    raise messages.MessageError("a binary message.")
                self._handle(client, messages.parse(message["text"], self.canvas.shape))
            except messages.MessageError as error:
                await client.socket.close(1008, str(error)[:120])
                return

    def _handle(self, client: _Client, message: object) -> None:
        if isinstance(message, messages.Seen):
            client.unseen = [number for number in client.unseen if number > message.frame]
            client.wake.set()
            return
        if isinstance(message, messages.Stroke):
            self.canvas.stroke((client.number, message.id), message.mode, message.radius, message.points)
            client.seq = message.seq
        elif message == "undo":
            self.canvas.undo()
        elif message == "redo":
            self.canvas.redo()
        elif message in ("clear", "reset"):
            self.canvas.clear()
        if message == "restart":
            self.session.restart()
            return
        if message == "reset":
            self.session.reset()
        self.paint()

    async def _send(self, client: _Client) -> None:
        await client.socket.send_text(self._hello)
        await client.socket.send_bytes(self._faces)
        client.wake.set()
        while True:
            await client.wake.wait()
            client.wake.clear()
            for content in self._news(client):
                with anyio.fail_after(_PATIENCE):
                    if isinstance(content, str):
                        await client.socket.send_text(content)
                    else:
                        await client.socket.send_bytes(content)

    def _news(self, client: _Client) -> list[str | bytes]:
        """Messages that the page has not had yet: of a movement before its first frame, of rest after the last one."""
        # In this order, the status is not older than the snapshot.
        snapshot, status = self.session.snapshot, self.session.status
        target: list[str | bytes] = []
        frame: list[str | bytes] = []
        told: list[str | bytes] = []
        if client.target != (self.canvas.version, client.seq):
            client.target = (self.canvas.version, client.seq)
            target.append(messages.target(self.canvas, client.seq))
        if snapshot.number > client.frame and len(client.unseen) < _UNSEEN:
            if self._frame[0] != snapshot.number:
                self._frame = (snapshot.number, messages.frame(snapshot))
            client.frame = snapshot.number
            client.unseen.append(snapshot.number)
            frame.append(self._frame[1])
        rests = status.phase == "resting"
        if client.status != status and not (rests and client.frame < self.session.snapshot.number):
            client.status = status
            told.append(messages.status(status))
        return target + (frame + told if rests else told + frame)
