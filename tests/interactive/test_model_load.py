"""The server under load: pages that send too much, and messages and images that are too large."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator

import numpy as np
import pytest
from model_fakes import FakeSession, eventually

pytest.importorskip("starlette", reason="Starlette is not installed: pip install '.[interactive]'")
pytest.importorskip("uvicorn")
pytest.importorskip("websockets")

from live_server import LivePage, live, serving

from shadowmap_dr.interactive import Canvas, modeller, server
from shadowmap_dr.interactive.client import BURST, MOST_MESSAGES
from shadowmap_dr.interactive.connections import Connections
from shadowmap_dr.interactive.rate_limit import RateLimit

SIZE = 256


@pytest.fixture
def board() -> Iterator[Connections]:
    fake = FakeSession(SIZE)
    fake.session.start()
    fake.sculptor.seconds = 0.005
    yield Connections(fake.session, fake.sculptor.views[0], "ball")
    fake.session.close()


@pytest.fixture
def port(board: Connections) -> Iterator[int]:
    with serving(board) as port:
        yield port


def test_a_flood_of_strokes_does_not_hold_up_another_page(port, monkeypatch):
    monkeypatch.setattr(modeller, "PATIENCE", 10**6)  # the mesh keeps moving
    monkeypatch.setattr(modeller, "MOST_STEPS", 10**6)
    with live(port) as one, live(port) as other:
        page, flood = LivePage(other), LivePage(one)
        page.round_trip(1, [20, 20])
        points = np.random.default_rng(0).uniform(0, SIZE, (1000, 2)).round(1)
        began = time.monotonic()
        for k, (x, y) in enumerate(points, 1):
            flood.stroke(k, [x, y, x + 5, y])
        latencies = []
        while flood.seq < len(points):
            latencies.append(page.round_trip(len(latencies) + 2, [30, 30, 40, 40]))
            assert time.monotonic() - began < 60
        seconds = time.monotonic() - began
        frames = sum(began <= t <= began + seconds for t in page.frames)
        print(f"{seconds:.2f} s, latency at most {max(latencies):.3f} s, {frames / seconds:.1f} frames a second")
        assert seconds > (len(points) - BURST) / MOST_MESSAGES - 0.5  # the limit holds
        assert len(latencies) >= 3 and max(latencies) < 1.0 and frames / seconds > 5
        assert len(flood.notices) == 1 and f"{MOST_MESSAGES} messages a second" in flood.notices[0] and page.notices == []


def test_no_stroke_of_a_flood_is_lost(port, board):
    first = Canvas(board.canvas.target())
    with live(port) as connection:
        page = LivePage(connection)
        for k in range(1, 2 * BURST):
            page.stroke(k, [k % 250, k // 2])
            first.stroke(k, "add", 3.0, [(k % 250, k // 2)])
        page.until(lambda: page.seq == 2 * BURST - 1)
        np.testing.assert_array_equal(page.pixels.reshape(SIZE, SIZE), first.pixels())


def test_limits_allow_a_burst_and_a_rate():
    limit = RateLimit(rate=100, burst=10)
    assert [limit.delay(5.0) for _ in range(10)] == [pytest.approx(0, abs=1e-9)] * 10
    assert limit.delay(5.0) == pytest.approx(0.01) and limit.delay(5.0) == pytest.approx(0.02)
    assert limit.delay(5.03) == pytest.approx(0, abs=1e-9) and limit.delay(9.0) == 0


@pytest.mark.parametrize("size", [17_000, 5_000_000])
def test_long_messages_end_their_connection_with_the_reason(port, size):
    from websockets.exceptions import ConnectionClosed

    for _ in range(5):
        with live(port) as connection:
            with pytest.raises(ConnectionClosed) as closed:
                connection.send("x" * size)
                while True:
                    connection.recv(timeout=20)
        assert closed.value.rcvd.code == 1008 and f"{size} characters" in closed.value.rcvd.reason


def test_messages_after_a_wrong_one_are_read_but_not_obeyed(port, board):
    from websockets.exceptions import ConnectionClosed

    with live(port) as connection:
        with pytest.raises(ConnectionClosed) as closed:
            connection.send("{}")
            for _ in range(20_000):
                connection.send(json.dumps({"type": "clear", "padding": "x" * 1000}))
            while True:
                connection.recv(timeout=20)
    assert closed.value.rcvd.code == 1008 and "unknown type" in closed.value.rcvd.reason
    eventually(lambda: not board._clients)
    assert board.canvas.version == 0


def post(port: int, size: int, *headers: str) -> socket.socket:
    connection = socket.create_connection((server.ADDRESS, port))
    connection.settimeout(20)
    lines = ["POST /image HTTP/1.1", f"Host: 127.0.0.1:{port}", f"Origin: http://127.0.0.1:{port}", f"Content-Length: {size}"]
    connection.sendall("\r\n".join([*lines, *headers, "", ""]).encode())
    return connection


def answer(connection: socket.socket, end: bytes) -> bytes:
    data = b""
    while end not in data and (part := connection.recv(65536)):
        data += part
    return data


@pytest.mark.parametrize("header", ["Connection: close", "Connection: keep-alive"])
def test_large_images_are_answered_after_they_are_sent(port, header):
    for _ in range(3):
        with post(port, 30_000_000, header) as connection:
            for _ in range(30):
                connection.sendall(b"\0" * 1_000_000)
            assert b" 422 " in answer(connection, b"are allowed.")
            if header.endswith("keep-alive"):  # the next request on the connection
                connection.sendall(f"GET /style.css HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
                assert b" 200 " in answer(connection, b"}\n")


def test_images_that_never_end_or_arrive_are_answered_and_closed(port, monkeypatch):
    # By name: other tests import the module again.
    monkeypatch.setattr("shadowmap_dr.interactive.server._MOST_READ", 10_000_000)
    with post(port, 10**12) as connection:
        connection.sendall(b"\0" * 10_000_001)
        text = answer(connection, b"never")
        assert b" 422 " in text and b"connection: close" in text.lower() and b"are allowed." in text
    monkeypatch.setattr("shadowmap_dr.interactive.server._UPLOAD_SECONDS", 0.3)
    with post(port, 1000) as connection:
        connection.sendall(b"\0")
        text = answer(connection, b"never")
        assert b" 408 " in text and b"connection: close" in text.lower() and b"has not arrived" in text
