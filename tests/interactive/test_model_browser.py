"""The page in a real browser: paint, watch, undo, load, download, fail and go on."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from browsers import browser, chromium, paint
from model_fakes import eventually
from PIL import Image

from shadowmap_dr.interactive import Modeller, Session
from shadowmap_dr.inverse import Sculptor, even_sphere, shadow_view

for package in ("playwright", "starlette", "uvicorn", "websockets", "trimesh"):
    pytest.importorskip(package, reason=f"{package} is not installed: pip install '.[test]'")
if chromium() is None:
    pytest.skip("no Chromium is installed (apt install chromium)", allow_module_level=True)

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

    def __init__(self) -> None:
        from shadowmap_dr.interactive.connections import Connections

        self.failure: Exception | None = None
        self.session = Session(self._build)
        self.session.start()
        self.studio = Connections(self.session, shadow_view(size=SIZE), "sphere")
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

    def _build(self) -> Modeller:
        sculptor = Sculptor(*even_sphere(10), [shadow_view(size=SIZE)], map_resolution=SIZE, filter_size=3, consistency=0.02)
        step = sculptor.step

        def sometimes() -> Any:
            if self.failure is not None:
                failure, self.failure = self.failure, None
                raise failure
            return step()

        sculptor.step = sometimes
        return Modeller(sculptor)


@pytest.fixture(scope="module")
def instance() -> Iterator[Any]:
    with browser() as instance:
        yield instance


@pytest.fixture
def place(variant: str) -> Iterator[Place]:
    place = Place()
    yield place
    place.close()


@pytest.fixture
def page(instance: Any, place: Place) -> Iterator[Any]:
    with opened(instance, place) as page:
        yield page


class opened:
    """A page that is ready, and whose errors are errors of the test."""

    def __init__(self, instance: Any, place: Place) -> None:
        self._instance, self._place = instance, place
        self.errors: list[str] = []

    def __enter__(self) -> Any:
        self._context = self._instance.new_context(viewport={"width": 900, "height": 640}, accept_downloads=True)
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


def test_a_stroke_moves_the_mesh_and_undo_moves_it_back(page, place, tmp_path):
    import trimesh

    first = shown(page, 0)
    before = {name: picture(page, name) for name in ("#shadow", "#object")}
    assert before["#object"].std() > 10  # there is something to be seen
    page.fill("#radius", "4")
    paint(page, NOSE, SIZE)
    state = shown(page, place.studio.canvas.version)
    assert state["vertices"][:, 0].max() > 1.5 and state["match"] > 0.93
    assert nose(state) > 1.38 and state["dark"] > first["dark"] + 80
    after = {name: picture(page, name) for name in ("#shadow", "#object")}
    for name, picture_ in after.items():
        assert (np.abs(picture_ - before[name]).max(2) > 30).sum() > 200, name
    # Not only the wall, but the clay before it has changed.
    assert clay(before["#object"]).sum() > 2000 and (clay(before["#object"]) ^ clay(after["#object"])).sum() > 100
    # The nose is dark now, and nothing else is.
    height, width = after["#shadow"].shape[:2]
    assert after["#shadow"][height // 2, int(0.86 * width)].mean() < 110
    assert after["#shadow"][int(0.1 * height), int(0.86 * width)].mean() > 200

    with page.expect_download() as download:
        page.click("text=PLY")
    assert download.value.suggested_filename == "mesh.ply"
    download.value.save_as(tmp_path / "mesh.ply")
    mesh = trimesh.load_mesh(tmp_path / "mesh.ply", process=False)
    assert mesh.is_watertight and len(mesh.faces) == 800
    np.testing.assert_allclose(mesh.vertices, place.session.snapshot.vertices, atol=1e-5)
    assert mesh.bounds[1, 0] > 1.5

    version = place.studio.canvas.version
    page.keyboard.press("Control+z")
    state = shown(page, version + 1)
    # What it comes back to is the shadow: a tip that is too thin to cast one may stay out a little longer.
    assert nose(state) < 1.28 and state["match"] > 0.97 and abs(state["dark"] - first["dark"]) < 20
    assert page.is_disabled("#undo") and page.is_enabled("#redo")


def test_erasing_takes_away(page):
    first = shown(page, 0)["dark"]
    page.click("#erase")
    assert page.get_attribute("#erase", "aria-pressed") == "true"
    paint(page, [(48, 10), (48, 54)], SIZE)
    state = shown(page, 1)
    assert 650 < first < 850 and state["dark"] < first - 100 and state["vertices"][:, 0].max() < 0.85


def test_the_keyboard_paints_too(page, place):
    page.focus("#shadow")
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    page.keyboard.press("]")
    page.keyboard.down(" ")
    for _ in range(4):
        page.keyboard.press("ArrowUp")
    page.keyboard.up(" ")
    eventually(lambda: place.studio.canvas.version >= 1)
    assert page.input_value("#radius") == "14"
    paint(page, NOSE, SIZE)
    assert shown(page, 2)["vertices"][:, 0].max() > 1.5


def test_images_are_loaded(page, place, tmp_path):
    image = Image.new("L", (300, 200), 255)
    image.paste(0, (80, 60, 200, 140))
    image.save(tmp_path / "block.png")
    page.set_input_files("#file", tmp_path / "block.png")
    state = shown(page, 1)
    assert state["vertices"][:, 0].max() > 1.3 and state["vertices"][:, 1].max() == pytest.approx(1.07, abs=0.12)
    (tmp_path / "no.png").write_text("no image")
    page.set_input_files("#file", tmp_path / "no.png")
    page.locator("#reason", has_text="cannot be used").wait_for()
    assert place.studio.canvas.version == 1


def test_several_pages_share_a_session(page, place, instance):
    with opened(instance, place) as other:
        paint(page, NOSE, SIZE)
        first, second = same_rest(other, page)
        assert first["vertices"][:, 0].max() > 1.5
        np.testing.assert_allclose(first["vertices"], second["vertices"])
        paint(other, [(18, 32), (6, 32)], SIZE)
        version = place.studio.canvas.version
        assert shown(page, version)["vertices"][:, 0].min() < -1.4
    other_version = place.studio.canvas.version
    paint(page, [(32, 18), (32, 6)], SIZE)  # the other one has gone
    assert shown(page, other_version + 1)["vertices"][:, 1].max() > 1.4


def test_failures_are_shown_and_the_button_restarts(page, place):
    place.failure = RuntimeError("out of luck")
    paint(page, NOSE, SIZE)
    phase(page, "failed")
    page.locator("#reason", has_text="out of luck").wait_for()
    page.click("#restart")
    state = shown(page, place.studio.canvas.version)
    assert state["vertices"][:, 0].max() > 1.5 and page.is_hidden("#alert")


def test_turning_changes_only_the_view(page, place):
    before, shadow = picture(page, "#object"), picture(page, "#shadow")
    box = page.locator("#object").bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 140, steps=4)
    page.mouse.up()
    page.wait_for_timeout(300)
    assert (np.abs(picture(page, "#object") - before).max(2) > 30).sum() > 500
    page.mouse.wheel(0, 300)
    page.wait_for_timeout(300)
    page.mouse.move(0, 0)
    np.testing.assert_allclose(picture(page, "#shadow"), shadow, atol=3)
    assert place.studio.canvas.version == 0


def test_pages_find_a_server_again(page, place):
    port = place.stop()
    phase(page, "lost")
    place.serve(port)
    phase(page, "resting")
    paint(page, NOSE, SIZE)
    assert shown(page, 1)["vertices"][:, 0].max() > 1.5
