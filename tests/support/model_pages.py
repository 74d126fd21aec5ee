"""The page of modelling in a real browser."""

from __future__ import annotations

import socket
import threading
from typing import Any

import numpy as np
import pytest
from browsers import chromium
from model_fakes import eventually
from PIL import Image

from shadowmap_dr.interactive import Modeller, Session
from shadowmap_dr.interactive.library import MeshLibrary
from shadowmap_dr.interactive.start_mesh import StartMesh
from shadowmap_dr.inverse import Sculptor, even_sphere, shadow_view

SIZE = 64
# What pages show, told by themselves: see the end of `show` in page.js.
WATCH = """document.addEventListener("frame", ({ detail }) => {
    window.shown = { target: detail.target, match: detail.match, vertices: Array.from(detail.vertices),
                     dark: detail.shadow.filter((v) => v < 128).length };
});"""
# What the browser itself logs about an upload that is refused, and a server that has gone.
EXPECTED = ("422 (Unprocessable", "ERR_CONNECTION_REFUSED")


class Place:
    """A server with a sculptor that can be made to fail."""

    def __init__(self, size: int = SIZE) -> None:
        from shadowmap_dr.interactive.connections import Connections

        self.failure: Exception | None = None
        self.view = shadow_view(size=size)
        library = MeshLibrary(StartMesh("ball", *even_sphere(10)), self._build)
        self.session = Session(lambda: self._build(library.first))
        self.session.start()
        self.studio = Connections(self.session, self.view, "ball", library)
        self.serve(0)

    def serve(self, port: int) -> None:
        import uvicorn

        from shadowmap_dr.interactive import server

        self._listener = socket.socket()
        self._listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._listener.bind((server.ADDRESS, port))
        self.url = f"http://{server.ADDRESS}:{self._listener.getsockname()[1]}/"
        self._server = uvicorn.Server(server.config(self.studio))
        self._thread = threading.Thread(target=self._server.run, kwargs={"sockets": [self._listener]})
        self._thread.start()
        eventually(lambda: self._server.started)

    def stop(self) -> int:
        """Ends the server, not the session; returns its port."""
        port = self._listener.getsockname()[1]
        self._server.should_exit = True
        self._thread.join(20)
        self._listener.close()
        return port

    def close(self) -> None:
        self.stop()
        self.session.close()

    def _build(self, start: StartMesh) -> Modeller:
        sculptor = Sculptor(start.vertices, start.faces, [self.view], map_resolution=SIZE, filter_size=3, consistency=0.02)
        step = sculptor.step

        def sometimes() -> Any:
            if self.failure is not None:
                failure, self.failure = self.failure, None
                raise failure
            return step()

        sculptor.step = sometimes
        return Modeller(sculptor, start)


class opened:
    """A page that is ready, and whose errors are errors of the test."""

    def __init__(self, instance: Any, place: Place, **settings: Any) -> None:
        self._instance, self._place = instance, place
        self._settings = {"viewport": {"width": 900, "height": 640}, "accept_downloads": True, **settings}
        self.errors: list[str] = []

    def __enter__(self) -> Any:
        self._context = self._instance.new_context(**self._settings)
        page = self._context.new_page()
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", self._console)
        page.on("request", lambda request: self.errors.append(request.url) if not self._own(request.url) else None)
        page.add_init_script(WATCH)
        page.goto(self._place.url)
        shown(page, 0)
        return page

    def __exit__(self, *args: Any) -> None:
        self._context.close()
        assert args[0] is not None or self.errors == []

    def _console(self, message: Any) -> None:
        if message.type == "error" and not any(text in message.text for text in EXPECTED):
            self.errors.append(message.text)

    def _own(self, url: str) -> bool:
        return url.startswith((self._place.url, "data:", "ws:" + self._place.url[5:]))


def phase(page: Any, name: str) -> None:
    page.locator(f"body[data-phase={name}]").wait_for(timeout=60_000)


def shown(page: Any, target: int) -> dict[str, Any]:
    """The mesh on the page once it rests at a version of the target."""
    for _ in range(600):
        # Both in one look: what is shown may change between two.
        state, phase = page.evaluate("() => [window.shown, document.body.dataset.phase]")
        if state and state["target"] >= target and phase == "resting":
            state["vertices"] = np.array(state["vertices"]).reshape(-1, 3)
            return state
        page.wait_for_timeout(50)
    raise AssertionError(f"the mesh does not come to rest: {state}")


def same_rest(one: Any, other: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Images of two pages once both rest at the same version: of a stroke that was just painted more may be on its way."""
    first = shown(one, 1)
    second = shown(other, first["target"])
    while first["target"] != second["target"]:
        first = shown(one, second["target"])
        second = shown(other, first["target"])
    return first, second


def picture(page: Any, name: str) -> np.ndarray:
    import io

    return np.asarray(Image.open(io.BytesIO(page.locator(name).screenshot())).convert("RGB"), np.float32)


def clay(image: np.ndarray) -> np.ndarray:
    """Pixels of the object: it is redder than walls and shadows."""
    return image[..., 0] > 1.4 * image[..., 2]


NOSE = [(46, 32), (50, 32), (54, 32), (58, 32)]


def nose(state: dict[str, Any]) -> float:
    """Distance that the 20 outermost vertices reach towards where a nose is painted, on average."""
    return float(np.sort(state["vertices"][:, 0])[-20:].mean())


def require_browser() -> None:
    """Skip a module where there is no browser, or where packages for the page are missing."""
    for package in ("playwright", "starlette", "uvicorn", "websockets", "trimesh"):
        pytest.importorskip(package, reason=f"{package} is not installed: pip install '.[test]'")
    if chromium() is None:
        pytest.skip("no Chromium is installed (apt install chromium)", allow_module_level=True)
