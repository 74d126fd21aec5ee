"""Messages, pictures and requests for the server of the modelling page."""

from __future__ import annotations

import atexit
import functools
import io
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from model_fakes import SIZE, FakeSession
from PIL import Image
from starlette.testclient import TestClient

from shadowmap_dr.interactive import messages, server
from shadowmap_dr.interactive.connections import Connections

from .outcome import Refused, Wrong, check
from .values import INTEGERS, NUMBERS, OTHERS, chance, integer, mutated, mutated_text, number, pick

_BASE = "http://127.0.0.1:8711"
_STROKE = {"type": "stroke", "id": 3, "seq": 7, "mode": "add", "radius": 4.5, "points": [1, 2, 3.5, 4]}
_COMMANDS = ("undo", "redo", "clear", "reset", "restart")


def run(rng: np.random.Generator, folder: Path) -> str:
    """Send something to the server."""
    return pick(rng, (_parse, _parse, _parse, _live, _live, _post, _post, _get))(rng, folder)


@functools.cache
def _client() -> TestClient:
    """A client of a session whose optimiser does nothing."""
    fake = FakeSession()
    fake.session.start()
    atexit.register(fake.session.close)
    stack = ExitStack()
    client = stack.enter_context(
        TestClient(server.create_app(Connections(fake.session, fake.sculptor.views[0], "ball")), base_url=_BASE)
    )
    atexit.register(stack.close)
    return client


def _value(rng: np.random.Generator) -> Any:
    choices = (
        lambda: integer(rng), lambda: number(rng), lambda: [number(rng) for _ in range(int(rng.integers(6)))],
        lambda: [integer(rng) for _ in range(int(pick(rng, (2, 4, 1024, 1026))))], lambda: pick(rng, _COMMANDS),
        lambda: pick(rng, [value for value in OTHERS if isinstance(value, str | list | dict | None | bool)]),
        lambda: [float(x) for x in rng.uniform(0, SIZE, 2 * int(rng.integers(1, 20)))],
    )  # fmt: skip
    return pick(rng, choices)()


def _message(rng: np.random.Generator) -> str:
    """A text message, valid in one of three cases or so."""
    value: dict[str, Any] = dict(_STROKE) if chance(rng, 0.6) else {"type": pick(rng, (*_COMMANDS, "seen")), "frame": 1}
    if value["type"] == "stroke":
        value["mode"] = pick(rng, ("add", "erase"))
        value["points"] = [float(x) for x in rng.uniform(-SIZE, 2 * SIZE, 2 * int(rng.integers(1, 30)))]
    if chance(rng, 0.5):
        value[pick(rng, tuple(value))] = _value(rng)
    if chance(rng, 0.1):
        del value[pick(rng, tuple(value))]
    text = json.dumps(value)
    if chance(rng, 0.2):
        text = mutated_text(rng, text)
    if chance(rng, 0.05):
        text = pick(rng, ("[" * 16_000, "1" * 16_000, " " * 20_000, "", "null", '"\\ud800"', "1e999", "NaN"))
    return text


def _parse(rng: np.random.Generator, folder: Path) -> str:
    found = messages.parse(_message(rng), (SIZE, SIZE + 3))
    if isinstance(found, messages.Stroke):
        check(np.isfinite(found.points).all() and found.points.shape[1] == 2 and found.radius >= 0.5, "a stroke that is none")
    return type(found).__name__


def _live(rng: np.random.Generator, folder: Path) -> str:
    """Messages on the live connection. It goes on, or is closed with a reason."""
    with _client().websocket_connect("ws://127.0.0.1:8711/live", headers={"origin": _BASE}) as connection:
        connection.receive_text(), connection.receive_bytes()
        for _ in range(int(rng.integers(1, 6))):
            if chance(rng, 0.1):
                connection.send_bytes(rng.bytes(int(rng.integers(50))))
            else:
                connection.send_text(_message(rng))
        connection.send_text(json.dumps({**_STROKE, "seq": 12345}))
        for _ in range(2000):
            message = connection.receive()
            if message["type"] == "websocket.close":
                check(
                    message["code"] == 1008 and message.get("reason"), f"closed with {message['code']}, {message.get('reason')!r}"
                )
                raise Refused(message["reason"])
            data = message.get("bytes")
            if data and data[0] == 3 and int.from_bytes(data[8:12], "little") == 12345:
                return "answered"
    raise Wrong("the last stroke was never answered")


def _post(rng: np.random.Generator, folder: Path) -> str:
    """Pictures."""
    buffer = io.BytesIO()
    size = (SIZE, SIZE) if chance(rng, 0.5) else tuple(int(n) for n in rng.integers(1, 90, 2))
    pixels = (rng.random((size[1], size[0])) > 0.5).astype(np.uint8) * 255
    Image.fromarray(pixels).convert(pick(rng, ("L", "RGB", "RGBA"))).save(buffer, format=pick(rng, ("PNG", "WEBP", "TIFF")))
    data = buffer.getvalue() if chance(rng, 0.3) else mutated(rng, buffer.getvalue())
    return _answer(_client().post("/image", content=data, headers={"origin": _BASE, **_header(rng)}))


def _get(rng: np.random.Generator, folder: Path) -> str:
    """Requests for files, and for others."""
    names = (
        "/",
        "/page.js",
        "/mesh.ply",
        "/mesh.obj",
        "/mesh.glb",
        "/shadow.png",
        "/live",
        "/image",
        "/../server.py",
        "/mesh.exe",
        "/mesh.",
    )
    path = pick(rng, names)
    if chance(rng, 0.4):
        path = "/" + "".join(
            pick(rng, ("%2e", "..", "/", "%00", "a", "%ff", "mesh.", "é", "?x=1", "%")) for _ in range(int(rng.integers(6)))
        )
    method = pick(rng, ("GET", "GET", "GET", "POST", "HEAD", "PUT", "OPTIONS", "DELETE"))
    return _answer(_client().request(method, _BASE + path, headers=_header(rng)))


def _header(rng: np.random.Generator) -> dict[str, str]:
    if chance(rng, 0.7):
        return {}
    names = ("host", "origin", "range", "content-length", "content-type", "sec-fetch-site", "x" * 50)
    values = (
        "127.0.0.1:8711",
        "http://evil.example",
        "null",
        "bytes=0-1",
        "-1",
        "0",
        "",
        str(pick(rng, INTEGERS)),
        str(pick(rng, NUMBERS)),
    )
    return {pick(rng, names): pick(rng, values)}


def _answer(response: Any) -> str:
    check(response.status_code < 500, f"status {response.status_code}: {response.text[:200]!r}")
    if response.status_code >= 400:
        raise Refused(response.text.strip() or f"status {response.status_code}")
    return f"status {response.status_code}"
