"""The web page's server on the loopback interface."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from importlib import resources

import anyio
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute

from ..errors import ShadowmapError
from . import exports
from .connections import Connections
from .request_guard import Guard

ADDRESS = "127.0.0.1"
#: The page's files: name -> media type. The server sends no other files to a browser.
PAGE = {
    "index.html": "text/html; charset=utf-8",
    "style.css": "text/css; charset=utf-8",
    "page.js": "text/javascript; charset=utf-8",
    "painting.js": "text/javascript; charset=utf-8",
    "pinch.js": "text/javascript; charset=utf-8",
    "stage.js": "text/javascript; charset=utf-8",
    "theme.js": "text/javascript; charset=utf-8",
    "zoom.js": "text/javascript; charset=utf-8",
    "three.core.min.js": "text/javascript; charset=utf-8",
    "three.module.min.js": "text/javascript; charset=utf-8",
    "three.LICENSE": "text/plain; charset=utf-8",
}
# Connections of all kinds at a time. Further ones are answered 503.
_MOST_CONNECTIONS = 64
# Bytes of a request that are read at most. Those beyond the size of an image are thrown away: a client that is still sending when
# its connection is closed would not see the answer.
_MOST_READ = 64_000_000
# Seconds for an image to arrive.
_UPLOAD_SECONDS = 30.0
# Bytes of a message on the live connection that are read at most. Messages longer than `messages.MOST_BYTES` are refused with a
# reason, which gets lost if a message is not read to its end.
_MOST_MESSAGE = 8_000_000
# An answer to a request that has not been read to its end is the last one on its connection.
_LAST = {"connection": "close"}


def create_app(connections: Connections) -> Starlette:
    """The ASGI application: the page, its live connection (``/live``), an upload for images, and downloads."""
    decoding = asyncio.Semaphore(1)

    async def upload(request: Request) -> Response:
        try:
            with anyio.fail_after(_UPLOAD_SECONDS):
                data = await _body(request)
        except _Endless as error:
            return PlainTextResponse(str(error), 422, headers=_LAST)
        except ShadowmapError as error:
            return PlainTextResponse(str(error), 422)
        except TimeoutError:
            return PlainTextResponse(f"the image has not arrived within {_UPLOAD_SECONDS:.0f} seconds.", 408, headers=_LAST)
        except ClientDisconnect:
            return Response(status_code=400)
        try:
            async with decoding:
                target = await run_in_threadpool(exports.read_target, data, connections.view.seen)
            connections.replace(target)
        except ShadowmapError as error:
            return PlainTextResponse(str(error), 422)
        return Response(status_code=204)

    async def mesh(request: Request) -> Response:
        kind = request.path_params["kind"]
        if kind not in exports.FORMATS:
            return PlainTextResponse("There is no such format.", 404)
        snapshot = connections.session.snapshot
        async with decoding:
            content = await run_in_threadpool(exports.mesh_bytes, kind, snapshot.vertices, snapshot.faces)
        return _download(content, exports.FORMATS[kind], f"mesh.{kind}")

    async def shadow(request: Request) -> Response:
        content = await run_in_threadpool(exports.shadow_bytes, connections.session.snapshot.shadow)
        return _download(content, "image/png", "shadow.png")

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        connections.attach()
        yield

    page = [Route("/" if name == "index.html" else f"/{name}", _file(name, kind)) for name, kind in PAGE.items()]
    routes = [
        *page,
        Route("/image", upload, methods=["POST"]),
        Route("/mesh.{kind}", mesh),
        Route("/shadow.png", shadow),
        WebSocketRoute("/live", connections.serve),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard)], lifespan=lifespan)


def listen(port: int = 0) -> socket.socket:
    """Open a socket for pages on 127.0.0.1. Port 0 stands for any free one. Raises ShadowmapError if the port is not free."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((ADDRESS, port))
        listener.listen(64)
    except (OSError, OverflowError) as error:
        listener.close()
        raise ShadowmapError(f"cannot serve on port {port}: {getattr(error, 'strerror', None) or error}.") from error
    return listener


def serve(
    connections: Connections,
    listener: socket.socket,
    stop: Callable[[], bool],
    on_start: Callable[[str], None] = lambda url: None,
) -> None:
    """Serve until `stop` returns True. The caller handles signals.

    Args:
        connections: with a started session, which stays open afterwards.
        listener: from :func:`listen`. It stays open, too.
        stop: called ten times a second.
        on_start: called with the page's address as soon as the page can be opened.
    """
    on_start(f"http://{ADDRESS}:{listener.getsockname()[1]}/")
    _Server(config(connections), stop).run(sockets=[listener])


class _Server(uvicorn.Server):
    """Stops when a function says so. Uvicorn's own server handles signals, and raises them again at the end."""

    def __init__(self, settings: uvicorn.Config, stop: Callable[[], bool]) -> None:
        super().__init__(settings)
        self._stop = stop

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def on_tick(self, counter: int) -> bool:
        return await super().on_tick(counter) or self._stop()


def config(connections: Connections) -> uvicorn.Config:
    """Uvicorn's settings: messages of bounded size, few connections, no header that names the server."""
    return uvicorn.Config(
        create_app(connections), log_level="warning", access_log=False, server_header=False, proxy_headers=False,
        ws_max_size=_MOST_MESSAGE, ws_per_message_deflate=False, limit_concurrency=_MOST_CONNECTIONS,
        timeout_graceful_shutdown=2,
    )  # fmt: skip


def _file(name: str, kind: str) -> Callable[[Request], Response]:
    content = (resources.files(__package__) / "page" / name).read_bytes()

    def answer(request: Request) -> Response:
        return Response(content, media_type=kind)

    return answer


def _download(content: bytes, kind: str, name: str) -> Response:
    return Response(content, media_type=kind, headers={"content-disposition": f'attachment; filename="{name}"'})


class _Endless(ShadowmapError):
    """A request that is not read to its end."""


async def _body(request: Request) -> bytes:
    """All of a request's body. Raises ShadowmapError for a body that is larger than images may be, after reading it."""
    parts: list[bytes] = []
    size = 0
    async for part in request.stream():
        size += len(part)
        if size <= exports.MOST_BYTES:
            parts.append(part)
        elif size <= _MOST_READ:
            parts.clear()
        else:
            raise _Endless(f"the image has more than {_MOST_READ} bytes: {exports.MOST_BYTES} are allowed.")
    if size > exports.MOST_BYTES:
        raise ShadowmapError(f"the image has {size} bytes: {exports.MOST_BYTES} are allowed.")
    return b"".join(parts)
