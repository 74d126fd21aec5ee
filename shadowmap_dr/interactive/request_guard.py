"""Refuses requests of other web sites to a server on the loopback interface.

A browser sends requests of any web site to a port of its own machine. The headers tell them from requests of our own page. Host
is the name in the address: a site can let its own name point to 127.0.0.1, but the browser then sends that name. Origin and
Sec-Fetch-Site tell from which page the request comes.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

#: Host names that are accepted.
NAMES = ("127.0.0.1", "localhost")

_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "cache-control": "no-store",
}


class Guard:
    """ASGI middleware. It answers 403 to requests of other pages, and adds security headers to all other answers."""

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        reason = refusal(scope)
        if reason is None:
            await self._app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.close", "code": 1008, "reason": reason})
        else:
            body = f"{reason}\n".encode()
            headers = [(b"content-type", b"text/plain; charset=utf-8"), (b"content-length", str(len(body)).encode())]
            await _with_headers(send)({"type": "http.response.start", "status": 403, "headers": headers})
            await send({"type": "http.response.body", "body": body})


def refusal(scope: Scope) -> str | None:
    """Reason for refusing a request, None if it is allowed."""
    hosts, origins, sites = (_all(scope, name) for name in (b"host", b"origin", b"sec-fetch-site"))
    port = scope["server"][1]
    allowed = {f"{name}:{port}" for name in NAMES} | (set(NAMES) if port == 80 else set())
    if len(hosts) != 1 or hosts[0] not in allowed:
        return "This server answers only under its own address."
    own = f"http://{hosts[0]}"
    if len(origins) > 1 or any(origin != own for origin in origins):
        return "This server answers only its own page."
    if scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD"):
        return None if origins else "This server answers only its own page."
    # Other sites may link to the page, but may not fetch or embed any other path.
    if scope["path"] != "/" and any(site not in ("same-origin", "none") for site in sites):
        return "This server answers only its own page."
    return None


def _all(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1").lower() for key, value in scope["headers"] if key == name]


def _with_headers(send: Send) -> Send:
    async def wrapped(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            given = {key for key, _ in message.get("headers", ())}
            extra = [(key.encode(), value.encode()) for key, value in _HEADERS.items() if key.encode() not in given]
            message = {**message, "headers": [*message.get("headers", ()), *extra]}
        await send(message)

    return wrapped
