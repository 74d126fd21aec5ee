"""The connections of a modelling session: pages that paint on one canvas and watch one mesh."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable

import anyio
import numpy.typing as npt
from starlette.concurrency import run_in_threadpool
from starlette.websockets import WebSocket, WebSocketDisconnect

from ..errors import ShadowmapError
from ..inverse import ShadowView
from . import brush, messages
from .canvas import Canvas, Change
from .client import Client, FrameCache, ShownMesh
from .library import MeshLibrary, read_named_target, target_names
from .session import Session
from .start_mesh import StartMesh

#: Largest number of pages at a time.
MOST_CLIENTS = 8
# Seconds until a page that does not read its messages is given up.
_PATIENCE = 20.0
# A connection ends with one of these when the page has gone, or is asleep.
_GONE = (WebSocketDisconnect, TimeoutError, ConnectionError)


class Connections:
    """State that pages share. It lives in the event loop's thread; the session's thread does all work on meshes.

    Each page has a task that sends the newest state to it. Messages that a slow page misses are never queued. A page that sends
    too much is read more slowly, and other pages get their turn between any two of its messages.

    Undo restores the mesh of the moment before the edit: the session keeps a state of the mesh before and after each edit.

    When a page chooses another mesh, all pages get it, with a new canvas. Until the session has prepared it, edits are dropped.

    Args:
        session: started.
        view: of the session's sculptor.
        name: of the mesh.
        library: meshes that pages may choose. None: no other mesh.

    Attributes:
        canvas: of the mesh that pages see. Another mesh has another canvas.
    """

    def __init__(self, session: Session, view: ShadowView, name: str, library: MeshLibrary | None = None) -> None:
        self.session, self.view, self._library = session, view, library
        snapshot = session.snapshot
        self.canvas = Canvas(snapshot.shadow / 255)
        self._mesh = ShownMesh(0, name, snapshot.start, messages.faces(snapshot.faces))
        self._coming: StartMesh | None = None  # a mesh that the session prepares
        self._clients: set[Client] = set()
        self._numbers = itertools.count()
        self._frames = FrameCache()

    def attach(self) -> None:
        """Let the session wake the pages from now on. Call it once, in the event loop."""
        loop = asyncio.get_running_loop()

        def woken() -> None:
            try:
                loop.call_soon_threadsafe(self.wake)
            except RuntimeError:
                pass  # the event loop has ended, so the session ends soon

        self.session.on_change = woken

    def wake(self) -> None:
        """Let all pages look for news."""
        for client in self._clients:
            client.wake.set()

    def replace(self, image: npt.ArrayLike) -> None:
        """Put an image (H, W), 0 (dark) to 1 (lit), on top of everything that has been painted.

        Raises ShadowmapError while another mesh is prepared.
        """
        self._take_mesh()
        if self._coming is not None:
            raise ShadowmapError("another mesh is being prepared: send the image again.")
        self._begun(self.canvas.replace(image))
        self._paint()

    async def serve(self, socket: WebSocket) -> None:
        """Serve a connection from beginning to end."""
        await socket.accept()
        if len(self._clients) >= MOST_CLIENTS:
            await socket.close(1013, f"{MOST_CLIENTS} pages are open already: close one of them.")
            return
        client = Client(next(self._numbers), socket)
        self._clients.add(client)
        try:
            async with anyio.create_task_group() as group:

                async def run(half: Callable[[Client], Awaitable[None]]) -> None:
                    try:
                        await half(client)
                    except _GONE:
                        pass
                    group.cancel_scope.cancel()

                group.start_soon(run, self._send)
                group.start_soon(run, self._receive)
            if client.refusal is not None:  # nothing is sent any more
                with anyio.fail_after(_PATIENCE):
                    await socket.close(1008, client.refusal)
        except _GONE:
            pass
        finally:
            self._clients.discard(client)

    async def _receive(self, client: Client) -> None:
        """Read messages until the page has gone, or has sent one that it may not send."""
        while True:
            message = await client.socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            try:
                if message.get("text") is None:
                    raise messages.MessageError("a binary message: pages send texts only.")
                await self._handle(client, messages.parse(message["text"], self.canvas.shape))
            except ShadowmapError as error:
                client.refusal = str(error)[:120]
                return
            # A message that has arrived already is received without a pause: other pages would wait until none is left.
            await client.slow_down()

    async def _handle(self, client: Client, message: object) -> None:
        self._take_mesh()
        if isinstance(message, messages.Seen):
            client.shown(message.frame)
        elif isinstance(message, messages.Choice):
            await self._choose(message)
        elif message == "restart":
            self.session.restart()
        elif self._coming is not None and not isinstance(message, messages.Stroke):
            pass  # the edit is of a mesh that goes
        elif isinstance(message, messages.Stroke):
            await self._stroke(client, message)
        elif message == "undo":
            self._go_back(self.canvas.undo(), leaves="after", finds="before")
        elif message == "redo":
            self._go_back(self.canvas.redo(), leaves="before", finds="after")
        else:
            self._begun(self.canvas.clear())
            if message == "reset":
                self.session.reset()
            self._paint()

    async def _stroke(self, client: Client, stroke: messages.Stroke) -> None:
        """Paint a part of a stroke. Other pages get their turn while a long one is drawn."""
        mesh = self._mesh
        lines = list(brush.parts(stroke.points, stroke.radius, self.canvas.shape))
        for left, line in zip(reversed(range(len(lines))), lines, strict=True):
            if self._coming is not None or self._mesh is not mesh or stroke.mesh not in (None, mesh.number):
                client.seq = stroke.seq
                self.wake()  # the page takes back what it has drawn
                return
            self._begun(self.canvas.stroke((client.number, stroke.id), stroke.mode, stroke.radius, line))
            if left:
                await asyncio.sleep(0)
        client.seq = stroke.seq
        self._paint()

    async def _choose(self, choice: messages.Choice) -> None:
        """Begin with another mesh, or put a target on top of everything. Raises MessageError for unknown names."""
        if choice.kind == "target":
            if choice.name not in target_names():
                raise messages.MessageError("a target that does not exist.")
            mesh = self._mesh
            image = await run_in_threadpool(read_named_target, choice.name, self.view.seen)
            self._take_mesh()
            if self._coming is None and self._mesh is mesh:
                self.replace(image)
            return
        library = self._library
        if library is None or choice.name not in library.names:
            raise messages.MessageError("a mesh that does not exist.")
        start = await run_in_threadpool(library.load, choice.name)
        self._coming = start
        self.session.begin(lambda: library.build(start), self.canvas.version + 1)
        self.wake()

    def _take_mesh(self) -> None:
        """Show the session's mesh, if it is another one. Its canvas is its shadow."""
        snapshot = self.session.snapshot
        if snapshot.start is None or snapshot.start is self._mesh.start:
            return
        self.canvas = Canvas(snapshot.shadow / 255, snapshot.target)
        self._mesh = ShownMesh(self._mesh.number + 1, snapshot.start.name, snapshot.start, messages.faces(snapshot.faces))
        if snapshot.start is self._coming:
            self._coming = None

    def _begun(self, edit: int | None) -> None:
        """Keep the mesh for undo, if an edit has begun."""
        if edit is not None:
            self.session.keep(("before", edit))

    def _go_back(self, change: Change | None, leaves: str, finds: str) -> None:
        """Show the canvas after undo or redo, with the mesh of that moment, and keep the mesh of this one."""
        if change is None:
            return
        self.session.keep((leaves, change.edit))
        self.session.set_target(self.canvas.target(), self.canvas.version, go_back=(finds, change.edit), exact=change.exact)
        self.wake()

    def _paint(self) -> None:
        """Tell optimiser and pages that the canvas has changed."""
        self.session.set_target(self.canvas.target(), self.canvas.version)
        self.wake()

    async def _send(self, client: Client) -> None:
        self._take_mesh()
        mesh = self._mesh
        client.mesh = mesh.number
        meshes = self._library.names if self._library is not None else ()
        await client.socket.send_text(messages.hello(self.view, mesh.name, mesh.number, meshes, target_names()))
        await client.socket.send_bytes(mesh.faces)
        client.wake.set()
        while True:
            await client.wake.wait()
            client.wake.clear()
            self._take_mesh()
            for content in client.news(self.session, self.canvas, self._mesh, self._frames):
                with anyio.fail_after(_PATIENCE):
                    if isinstance(content, str):
                        await client.socket.send_text(content)
                    else:
                        await client.socket.send_bytes(content)
