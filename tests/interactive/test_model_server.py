"""The page's server: what it tells whom, and what it refuses."""

from __future__ import annotations

import asyncio
import io
import json
import socket
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import ExitStack

import numpy as np
import pytest
from model_fakes import SIZE, eventually
from PIL import Image

pytest.importorskip("starlette", reason="Starlette is not installed: pip install '.[interactive]'")
pytest.importorskip("httpx")

from starlette.requests import Request
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.interactive import client as client_module
from shadowmap_dr.interactive import exports, server
from shadowmap_dr.interactive.connections import MOST_CLIENTS, Connections

BASE = "http://127.0.0.1:8711"
WS = "ws://127.0.0.1:8711"
OWN = {"origin": BASE}


class Page:
    """A page: it sorts what it gets, and shows frames."""

    def __init__(self, connection) -> None:
        self.connection = connection
        self.hello = json.loads(connection.receive_text())
        self.faces = np.frombuffer(connection.receive_bytes(), "<u4", offset=8)
        self.status = self.target = self.frame = None
        self.frames = 0

    def read(self, until, shows=True):
        while not until():
            message = self.connection.receive()
            if message["type"] == "websocket.close":
                raise WebSocketDisconnect(message["code"], message.get("reason"))
            if message.get("text") is not None:
                self.status = json.loads(message["text"])
                continue
            data = message["bytes"]
            if data[0] == 3:
                self.target = *struct.unpack_from("<4I", data, 4), np.frombuffer(data, np.uint8, offset=20)
                continue
            _, number, _, version, _, speed, count = struct.unpack_from("<4I2fI", data)
            self.frame = number, version, np.frombuffer(data, "<f4", 3 * count, 28).reshape(-1, 3)
            self.frames += 1
            if shows:
                self.send(type="seen", frame=number)
        return self

    def send(self, **message):
        self.connection.send_text(json.dumps(message))

    def paint(self, seq=1, points=(16, 16), **change):
        self.send(**{"type": "stroke", "id": 1, "seq": seq, "mode": "add", "radius": 6, "points": list(points), **change})


@pytest.fixture
def board(fake) -> Connections:
    return Connections(fake.session, fake.sculptor.views[0], "ball")


@pytest.fixture
def client(board) -> Iterator[TestClient]:
    with TestClient(server.create_app(board), base_url=BASE) as client:
        yield client


def live(client):
    return client.websocket_connect(f"{WS}/live", headers=OWN)


def test_pages_are_told_all_they_need(client, fake):
    with live(client) as connection:
        page = Page(connection)
        page.read(lambda: page.frame is not None and page.target is not None and page.status is not None)
        assert page.hello["name"] == "ball" and page.hello["width"] == page.hello["height"] == SIZE
        assert page.hello["forward"] == [0, 0, -1] and page.hello["origin"] == [0, 0, -4]
        np.testing.assert_array_equal(page.faces, [0, 1, 2, 0, 2, 3])
        assert page.status["phase"] == "resting" and page.target[:4] == (0, 0, 0, 0)
        assert (page.target[4] == 191).all()
        np.testing.assert_array_equal(page.frame[2], fake.sculptor.vertices())


def test_strokes_reach_mesh_and_all_pages(client, fake):
    with live(client) as one, live(client) as other:
        pages = [Page(one), Page(other)]
        pages[0].paint(seq=4)
        for page in pages:
            page.read(lambda: page.frame and page.frame[1] == 1 and page.status["phase"] == "resting")  # noqa: B023
            assert page.target[0] == 1 and page.target[2:4] == (1, 0)
            image = page.target[4].reshape(SIZE, SIZE)
            assert image[16, 16] == 0 and image[16, 28] == 191 and 80 < (image == 0).sum() < 130
            assert page.frame[2][0, 0] == pytest.approx(image.mean() / 255, abs=1e-3)
        assert [page.target[1] for page in pages] == [4, 0]  # the number of each one's own last stroke
        pages[1].send(type="undo")
        for page in pages:
            page.read(lambda: page.target[0] == 2)  # noqa: B023
            assert (page.target[4] == 191).all() and page.target[2:4] == (0, 1)
        pages[0].send(type="redo")
        pages[1].read(lambda: pages[1].target[0] == 3)
        assert pages[1].target[4].min() == 0


def test_starting_over_resets_painting_and_mesh(client, fake):
    with live(client) as connection:
        page = Page(connection)
        page.paint()
        page.read(lambda: page.frame and page.frame[1] == 1)
        resets = []
        fake.sculptor.reset = resets.append
        page.send(type="reset")
        page.read(lambda: page.target[0] == 2 and page.frame[1] == 2)
        assert (page.target[4] == 191).all() and resets == [None]


def test_failures_are_shown_and_restarts_work(client, fake):
    with live(client) as connection:
        page = Page(connection)
        fake.sculptor.failure = RuntimeError("out of luck")
        page.paint()
        page.read(lambda: page.status and page.status["phase"] == "failed")
        assert page.status["message"] == "RuntimeError: out of luck"
        page.paint(seq=2, points=(20, 20))  # painting goes on
        page.read(lambda: page.target[0] == 2)
        page.send(type="restart")
        page.read(lambda: page.status["phase"] == "resting" and page.frame[1] == 2)
        assert len(fake.sculptors) == 2


def test_slow_pages_miss_frames_but_get_the_newest(client, board, fake, monkeypatch):
    monkeypatch.setattr("shadowmap_dr.interactive.session.SNAPSHOT_INTERVAL", 0.0)
    fake.sculptor.seconds = 0.005
    with live(client) as quick, live(client) as slow:
        fast, late = Page(quick), Page(slow)
        late.read(lambda: late.frame is not None, shows=False)
        for seq in range(1, 4):
            fast.paint(seq=seq, points=(5 * seq, 9))
            fast.read(lambda: fast.frame and fast.frame[1] == seq)  # noqa: B023
        fast.read(lambda: fast.status["phase"] == "resting")
        newest = fake.session.snapshot.number
        late.read(lambda: late.target and late.target[0] == 3 and late.frames == 2, shows=False)
        assert late.frame[0] < newest  # no more than it has not shown
        late.send(type="seen", frame=late.frame[0])
        late.read(lambda: late.frames == 3, shows=False)
        # What it shows until it has the last frame does not rest, even if the optimiser does.
        assert late.frame[0] == newest and late.status["phase"] == "moving"
        late.read(lambda: late.status["phase"] == "resting", shows=False)
        assert late.frames == 3 and fast.frames > 6


@pytest.mark.parametrize("message", ["", "{}", "x" * 20_000, '{"type": "stroke"}', b"\x00\x01"])
def test_nonsense_ends_only_the_connection_it_comes_from(client, message):
    with live(client) as good, live(client) as bad:
        page, other = Page(good), Page(bad)
        send = bad.send_bytes if isinstance(message, bytes) else bad.send_text
        send(message)
        with pytest.raises(WebSocketDisconnect) as closed:
            other.read(lambda: False)
        assert closed.value.code == 1008
        page.paint()
        page.read(lambda: page.frame and page.frame[1] == 1)


def test_pages_are_counted(client, board):
    with ExitStack() as most:
        for _ in range(MOST_CLIENTS - 1):
            Page(most.enter_context(live(client)))
        with live(client) as last:
            Page(last)
            with live(client) as one_too_many, pytest.raises(WebSocketDisconnect) as closed:
                Page(one_too_many)
            assert closed.value.code == 1013
        eventually(lambda: len(board._clients) < MOST_CLIENTS)
        with live(client) as connection:
            Page(connection)


def test_downloads_are_the_mesh(client, fake):
    import trimesh

    for kind in exports.FORMATS:
        answer = client.get(f"/mesh.{kind}")
        assert answer.status_code == 200 and f'filename="mesh.{kind}"' in answer.headers["content-disposition"]
        mesh = trimesh.load_mesh(io.BytesIO(answer.content), file_type=kind, process=False)
        np.testing.assert_allclose(mesh.vertices, fake.sculptor.vertices(), atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, fake.sculptor.faces)
    shadow = np.asarray(Image.open(io.BytesIO(client.get("/shadow.png").content)))
    np.testing.assert_array_equal(shadow, fake.session.snapshot.shadow)


def encoded(image, kind="PNG"):
    buffer = io.BytesIO()
    image.save(buffer, kind)
    return buffer.getvalue()


def test_images_become_targets(client, board, fake):
    same = Image.fromarray(np.arange(SIZE * SIZE).reshape(SIZE, SIZE).astype(np.uint8))
    assert client.post("/image", content=encoded(same), headers=OWN).status_code == 204
    np.testing.assert_array_equal(board.canvas.pixels(), np.asarray(same))
    drawing = Image.new("RGB", (300, 200), "white")
    drawing.paste("black", (40, 90, 60, 110))  # a small square in a corner becomes a large one in the middle
    assert client.post("/image", content=encoded(drawing, "JPEG"), headers=OWN).status_code == 204
    dark = board.canvas.pixels() < 128
    rows, columns = (np.nonzero(dark.any(axis))[0] for axis in (1, 0))
    assert min(len(rows), len(columns)) > SIZE // 2 and abs(len(rows) - len(columns)) <= 2
    assert dark[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].mean() > 0.95
    eventually(lambda: fake.session.snapshot.target == 2)
    board.canvas.undo()
    np.testing.assert_array_equal(board.canvas.pixels(), np.asarray(same))


def bomb(side):
    """A tiny file that says it holds side x side pixels."""
    content = bytearray(encoded(Image.new("L", (8, 8))))
    content[16:24] = struct.pack(">2I", side, side)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    return bytes(content)


def test_unusable_images_change_nothing(client, board):
    blank = encoded(Image.new("L", (50, 50), 255))
    large = b"\0" * (exports.MOST_BYTES + 1)
    for content, reason in ((b"", "no image"), (b"GIF89a", "no image"), (b"<svg/>", "no image"), (blank, "no figure"),
                            (bomb(5_000), "pixels"), (bomb(30_000), "no image"), (large, "bytes")):  # fmt: skip
        answer = client.post("/image", content=content, headers=OWN)
        assert answer.status_code == 422 and reason in answer.text
    assert board.canvas.version == 0


def test_images_are_read_no_further_than_allowed():
    sent = 0

    async def endless():
        nonlocal sent
        sent += 1_000_000
        return {"type": "http.request", "body": b"\0" * 1_000_000, "more_body": True}

    with pytest.raises(ShadowmapError, match="bytes"):
        asyncio.run(server._body(Request({"type": "http", "method": "POST", "headers": []}, endless)))
    assert sent <= server._MOST_READ + 1_000_000


BAD = [
    {"host": "evil.example:8711"}, {"host": "127.0.0.1"}, {"host": "127.0.0.1:80"}, {"host": "127.0.0.1.evil.example:8711"},
    {"host": "localhost:8712"}, {"origin": "http://evil.example"}, {"origin": "null"}, {"origin": "http://127.0.0.1:9999"},
    {"origin": "https://127.0.0.1:8711"}, {"origin": "http://localhost:8711"}, {"origin": "file://"},
]  # fmt: skip


@pytest.mark.parametrize("headers", BAD)
def test_other_sites_get_nothing(client, board, headers):
    for method, path in (("GET", "/"), ("GET", "/mesh.ply"), ("POST", "/image"), ("GET", "/nowhere")):
        answer = client.request(method, path, headers={**(OWN if method == "POST" else {}), **headers})
        assert answer.status_code == 403 and "access-control-allow-origin" not in answer.headers
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"{WS}/live", headers={**OWN, **headers}):
        pass
    assert board.canvas.version == 0 and not board._clients


def test_connections_and_uploads_need_an_origin(client, board):
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"{WS}/live"):
        pass
    assert client.post("/image", content=encoded(Image.new("L", (SIZE, SIZE)))).status_code == 403
    assert board.canvas.version == 0


def test_two_hosts_or_origins_are_none(client):
    headers = [("host", "127.0.0.1:8711"), ("host", "evil.example")]
    assert client.get("/", headers=headers).status_code == 403
    assert client.get("/", headers=[("origin", BASE), ("origin", "http://evil.example")]).status_code == 403


def test_only_the_page_can_be_linked_to(client):
    for site in ("cross-site", "same-site"):
        assert client.get("/", headers={"sec-fetch-site": site}).status_code == 200
        for path in ("/mesh.ply", "/shadow.png", "/page.js"):
            assert client.get(path, headers={"sec-fetch-site": site}).status_code == 403
    assert client.get("/mesh.ply", headers={"sec-fetch-site": "same-origin"}).status_code == 200


def test_localhost_is_the_same_place(board):
    headers = {"origin": "http://localhost:8711"}
    with TestClient(server.create_app(board), base_url="http://localhost:8711") as client:
        assert client.get("/").status_code == 200
        with client.websocket_connect("ws://localhost:8711/live", headers=headers) as connection:
            assert Page(connection).hello["name"] == "ball"


def test_files_of_the_page_and_no_others(client):
    for name in server.PAGE:
        answer = client.get("/" if name == "index.html" else f"/{name}")
        assert answer.status_code == 200 and answer.headers["x-content-type-options"] == "nosniff"
        assert "default-src 'none'" in answer.headers["content-security-policy"]
        assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
    for path in ("/index.html", "/server.py", "/../server.py", "/%2e%2e/server.py", "/..%2fserver.py", "//etc/passwd",
                 "/page/page.js", "/mesh.exe", "/mesh.../../x", "/mesh.%2e%2e%2fx"):  # fmt: skip
        assert client.get(path).status_code == 404, path
    assert client.get("/image").status_code == 405 and client.post("/", headers=OWN).status_code == 405


def test_the_page_fetches_nothing_from_elsewhere():
    from importlib import resources

    for name in server.PAGE:
        text = (resources.files("shadowmap_dr.interactive") / "page" / name).read_text(encoding="utf-8")
        if not name.startswith("three."):
            assert "http://" not in text and "https://" not in text and "//" + "cdn" not in text
    assert "MIT" in (resources.files("shadowmap_dr.interactive") / "page" / "three.LICENSE").read_text()


@pytest.fixture
def running(board) -> Iterator[int]:
    """The real server, on a free port."""
    import uvicorn

    listener = socket.socket()
    listener.bind((server.ADDRESS, 0))
    real = uvicorn.Server(server.config(board))
    thread = threading.Thread(target=real.run, kwargs={"sockets": [listener]})
    thread.start()
    eventually(lambda: real.started)
    yield listener.getsockname()[1]
    real.should_exit = True
    thread.join(20)
    listener.close()


def test_the_real_server_talks_and_refuses(running, board):
    import httpx
    from websockets.exceptions import ConnectionClosedError, InvalidStatus
    from websockets.sync.client import connect

    base = f"http://127.0.0.1:{running}"
    assert httpx.get(base, trust_env=False).status_code == 200
    assert "server" not in httpx.get(base, trust_env=False).headers
    assert httpx.get(base, headers={"host": f"evil.example:{running}"}, trust_env=False).status_code == 403
    for origin in (None, "http://evil.example"):
        with pytest.raises(InvalidStatus) as refused:
            connect(f"ws://127.0.0.1:{running}/live", origin=origin, proxy=None)
        assert refused.value.response.status_code == 403
    with connect(f"ws://127.0.0.1:{running}/live", origin=base, proxy=None) as connection:
        assert json.loads(connection.recv())["name"] == "ball"
        connection.send("x" * 100_000)  # longer than a message may be
        with pytest.raises(ConnectionClosedError) as closed:
            for _ in range(20):
                connection.recv(timeout=10)
        assert closed.value.rcvd.code == 1008 and "100000 characters" in closed.value.rcvd.reason
    eventually(lambda: not board._clients)


def test_a_page_that_reads_nothing_does_not_hold_up_others(running, board, fake, monkeypatch):
    from websockets.sync.client import connect

    monkeypatch.setattr(client_module, "_UNSEEN", 10**6)  # so that only the connection itself is in the way
    monkeypatch.setattr("shadowmap_dr.interactive.session.SNAPSHOT_INTERVAL", 0.0)
    base = f"http://127.0.0.1:{running}"
    deaf = socket.create_connection((server.ADDRESS, running))
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    request = ["GET /live HTTP/1.1", f"Host: 127.0.0.1:{running}", f"Origin: {base}", "Upgrade: websocket", "Connection: Upgrade",
               "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13", "", ""]  # fmt: skip
    deaf.sendall("\r\n".join(request).encode())
    eventually(lambda: len(board._clients) == 1)
    slow = next(iter(board._clients))
    with connect(f"ws://127.0.0.1:{running}/live", origin=base, proxy=None) as connection:
        began = time.monotonic()
        for seq in range(1, 30):
            points = [seq, 9]
            message = {"type": "stroke", "id": seq, "seq": seq, "mode": "add", "radius": 3, "points": points}
            connection.send(json.dumps(message))
            while True:
                data = connection.recv(timeout=10)
                if isinstance(data, bytes) and data[0] == 2 and struct.unpack_from("<4I", data)[3] == seq:
                    break
        assert time.monotonic() - began < 30
    assert slow.frame <= fake.session.snapshot.number
    deaf.close()


def test_ports_that_are_taken_are_an_error():
    with socket.socket() as other:
        other.bind((server.ADDRESS, 0))
        other.listen(1)
        port = other.getsockname()[1]
        with pytest.raises(ShadowmapError, match=f"cannot serve on port {port}"):
            server.listen(port)


class ClosingSocket:
    """A connection whose page sends a message that is refused. Like Starlette's, it sends nothing after it has been closed."""

    def __init__(self, board: Connections) -> None:
        self.board, self.closed = board, None

    async def accept(self) -> None:
        pass

    async def receive(self) -> dict[str, str]:
        await asyncio.sleep(0.02)
        return {"type": "websocket.receive", "text": "nonsense"}

    async def send_text(self, text: str) -> None:
        await self.send_bytes(b"")

    async def send_bytes(self, data: bytes) -> None:
        if self.closed is not None:
            raise RuntimeError('Cannot call "send" once a close message has been sent.')
        await asyncio.sleep(0)

    async def close(self, code: int, reason: str) -> None:
        self.closed = code, reason
        self.board.replace(np.full((SIZE, SIZE), 0.5))  # news for the page
        await asyncio.sleep(0.1)


def test_nothing_is_sent_to_a_page_that_is_being_refused(board):
    socket = ClosingSocket(board)

    async def serve() -> None:
        board.attach()
        await board.serve(socket)

    asyncio.run(serve())
    assert socket.closed == (1008, "a message that is not JSON.")
