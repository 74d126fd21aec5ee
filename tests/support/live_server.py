"""The modelling page's real server on a free port, and connections to it."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from model_fakes import eventually


@contextmanager
def serving(connections: Any) -> Iterator[int]:
    """Runs the server in a thread. Yields its port."""
    import uvicorn

    from shadowmap_dr.interactive import server

    listener = socket.socket()
    listener.bind((server.ADDRESS, 0))
    running = uvicorn.Server(server.config(connections))
    thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        eventually(lambda: running.started)
        yield listener.getsockname()[1]
    finally:
        running.should_exit = True
        thread.join(20)
        listener.close()


@contextmanager
def live(port: int) -> Iterator[Any]:
    """A page's connection."""
    from websockets.sync.client import connect

    with connect(f"ws://127.0.0.1:{port}/live", origin=f"http://127.0.0.1:{port}", proxy=None, max_queue=None) as connection:
        yield connection


class LivePage:
    """Reads a connection in a thread, and shows all frames at once."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection
        self.seq = self.version = -1
        self.pixels: np.ndarray | None = None
        self.vertices: np.ndarray | None = None
        self.phase = ""
        self.frames: list[float] = []  # when they came
        self.notices: list[str] = []
        threading.Thread(target=self._read, daemon=True).start()

    def send(self, **message: Any) -> None:
        self.connection.send(json.dumps(message))

    def stroke(self, seq: int, points: list[float], radius: float = 3.0) -> None:
        self.send(type="stroke", id=seq, seq=seq, mode="add", radius=radius, points=points)

    def round_trip(self, seq: int, points: list[float]) -> float:
        """Seconds from a stroke until the painting with it has come back."""
        began = time.monotonic()
        self.stroke(seq, points)
        self.until(lambda: self.seq == seq)
        return time.monotonic() - began

    def until(self, condition: Callable[[], bool], seconds: float = 60.0) -> None:
        eventually(condition, seconds)

    def _read(self) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            for data in self.connection:
                self._take(data)
        except ConnectionClosed:
            pass

    def _take(self, data: str | bytes) -> None:
        if isinstance(data, str):
            message = json.loads(data)
            if message["type"] == "status":
                self.phase = message["phase"]
            elif message["type"] == "notice":
                self.notices.append(message["message"])
        elif data[0] == 3:
            self.pixels = np.frombuffer(data, np.uint8, offset=20)
            self.version, self.seq = struct.unpack_from("<2I", data, 4)
        elif data[0] == 2:
            number, count = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<I", data, 24)[0]
            self.vertices = np.frombuffer(data, "<f4", 3 * count, 28).reshape(-1, 3)
            self.frames.append(time.monotonic())
            self.send(type="seen", frame=number)
