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
from shadowmap_dr.interactive.library import MeshLibrary, read_named_target
from shadowmap_dr.interactive.start_mesh import StartMesh
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


def test_a_list_of_shortcuts_opens_and_closes(page, place):
    for opens in (lambda: page.keyboard.press("?"), lambda: page.click("#help-open")):
        assert page.is_hidden("#help")
        opens()
        assert page.is_visible("#help") and page.locator("#help kbd").count() > 10
        page.keyboard.press("e")  # no shortcut acts meanwhile
        assert page.get_attribute("#erase", "aria-pressed") == "false"
        page.keyboard.press("Escape")
    page.keyboard.press("?")
    page.keyboard.press("?")
    assert page.is_hidden("#help")
    page.keyboard.press("e")
    assert page.get_attribute("#erase", "aria-pressed") == "true"


def scale(page: Any) -> float:
    """Width of the canvas in widths of the board."""
    return page.evaluate("() => shadow.getBoundingClientRect().width / easel.clientWidth")


def test_strokes_land_where_they_are_painted_while_zoomed(page, place):
    page.fill("#radius-number", "2")
    box = page.locator("#easel").bounding_box()
    x, y = box["x"] + 0.8 * box["width"], box["y"] + 0.25 * box["height"]
    page.mouse.move(x, y)
    for _ in range(6):
        page.mouse.wheel(0, -100)
    page.wait_for_timeout(100)
    assert scale(page) > 3
    canvas = page.locator("#shadow").bounding_box()
    # The pixel under the pointer has stayed there.
    assert (x - canvas["x"]) / canvas["width"] == pytest.approx(0.8, abs=0.01)
    assert (y - canvas["y"]) / canvas["height"] == pytest.approx(0.25, abs=0.01)
    before = place.studio.canvas.pixels().copy()
    paint(page, [(50.5, 16.5), (53.5, 16.5)], SIZE)
    eventually(lambda: place.studio.canvas.version >= 1 and place.studio.canvas.pixels()[16, 54] == 0)
    rows, columns = np.nonzero((place.studio.canvas.pixels() < before) & (place.studio.canvas.pixels() < 100))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (15, 17, 49, 54)
    ring = page.locator("#brush").bounding_box()
    assert ring["width"] == pytest.approx(2 * 2 * canvas["width"] / SIZE, abs=1)
    # The middle button moves the view, and paints nothing.
    version = place.studio.canvas.version
    page.mouse.down(button="middle")
    page.mouse.move(x - 60, y + 40, steps=3)
    page.mouse.up(button="middle")
    assert page.locator("#shadow").bounding_box()["x"] < canvas["x"] - 20 and place.studio.canvas.version == version


def test_keys_and_buttons_zoom(page):
    for larger, smaller, whole in (("+", "-", "0"), ("#zoom-in", "#zoom-out", "#zoom-reset")):

        def press(key: str) -> None:
            page.click(key) if key.startswith("#") else page.keyboard.press(key)

        press(larger)
        press(larger)
        two = scale(page)
        assert two > 1.4 and page.inner_text("#zoom-reset") == f"{100 * two:.0f} %"
        press(smaller)
        assert 1 < scale(page) < two
        press(whole)
        assert scale(page) == pytest.approx(1, abs=0.01)
        press(smaller)  # no smaller than the board
        assert scale(page) == pytest.approx(1, abs=0.01)
    # The object has keys of its own.
    page.focus("#object")
    page.keyboard.press("+")
    assert scale(page) == pytest.approx(1, abs=0.01)
    # The brush of the keyboard stays in sight.
    page.focus("#shadow")
    for key in ("+", "+", "+", "+", *["ArrowRight"] * 6):
        page.keyboard.press(key)
    board, brush = page.locator("#easel").bounding_box(), page.locator("#brush").bounding_box()
    assert board["x"] < brush["x"] + brush["width"] / 2 < board["x"] + board["width"]


def test_two_fingers_zoom_and_one_paints(instance, place):
    with opened(instance, place, viewport={"width": 390, "height": 844}, has_touch=True) as page:
        session = page.context.new_cdp_session(page)

        def touch(kind: str, *points: tuple[float, float]) -> None:
            touches = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
            session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})

        box = page.locator("#easel").bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        touch("touchStart", (x - 40, y))
        touch("touchStart", (x - 40, y), (x + 40, y))
        for reach in (60, 80, 100, 120):
            touch("touchMove", (x - reach, y), (x + reach, y))
        touch("touchEnd")
        page.wait_for_timeout(200)
        assert scale(page) == pytest.approx(3, rel=0.05) and place.studio.canvas.version == 0
        page.click("#zoom-reset")
        touch("touchStart", (box["x"] + 0.8 * box["width"], y))
        touch("touchMove", (box["x"] + 0.9 * box["width"], y))
        touch("touchEnd")
        eventually(lambda: place.studio.canvas.version > 0 and place.studio.canvas.pixels()[SIZE // 2, int(0.9 * SIZE)] == 0)


def test_the_size_of_the_brush_is_a_number(page, place):
    assert page.input_value("#radius-number") == page.input_value("#radius") == "12"
    assert page.inner_text("abbr") == "px" and "pixels" in page.get_attribute("abbr", "title")
    page.fill("#radius-number", "5")
    assert page.input_value("#radius") == "5"
    page.press("#radius-number", "e")
    assert page.get_attribute("#erase", "aria-pressed") == "false"  # no shortcut where one writes
    page.fill("#radius", "7")
    assert page.input_value("#radius-number") == "7"
    page.fill("#radius-number", "1000")
    page.press("#radius-number", "Enter")
    assert page.input_value("#radius-number") == page.input_value("#radius") == "60"


def test_brushes_are_no_larger_than_small_shadows(instance, variant):
    place = Place(size=32)
    try:
        with opened(instance, place) as page:
            page.fill("#radius", "32")
            assert page.get_attribute("#radius", "max") == page.get_attribute("#radius-number", "max") == "32"
            paint(page, [(2, 2), (3, 3)], 32)
            eventually(lambda: place.studio.canvas.version > 0)
            assert page.is_hidden("#alert")  # the server has not closed the connection
    finally:
        place.close()


def test_meshes_are_chosen_on_the_page(page, place, instance):
    names = page.locator("#mesh option").all_inner_texts()
    assert names[:2] == ["ball", "sphere"] and "spot" in names and page.input_value("#mesh") == "ball"
    first = len(shown(page, 0)["vertices"])
    with opened(instance, place) as other:
        page.select_option("#mesh", "spot")
        version = place.studio.canvas.version + 1
        spot = shown(page, version)["vertices"]
        assert len(spot) == len(shown(other, version)["vertices"]) > first
        assert page.input_value("#mesh") == other.input_value("#mesh") == "spot"
        np.testing.assert_allclose(spot, place.session.snapshot.vertices, atol=1e-6)
    assert clay(picture(page, "#object")).sum() > 2000
    paint(page, NOSE, SIZE)
    shown(page, version + 1)
    # Somebody has painted: the page asks first.
    page.select_option("#mesh", "ball")
    assert page.is_visible("#replace") and "ball" in page.inner_text("#replace")
    page.click("#replace button:not([value=yes])")
    # Browsers tell later that a dialog has closed.
    eventually(lambda: page.input_value("#mesh") == "spot", 10)
    assert len(place.session.snapshot.vertices) == len(spot)
    page.select_option("#mesh", "ball")
    page.click("#replace button[value=yes]")
    eventually(lambda: place.session.snapshot.start.name == "ball", 60)
    version = place.session.snapshot.target
    state = shown(page, version)
    assert len(state["vertices"]) == first and state["match"] > 0.99 and page.is_disabled("#undo")
    paint(page, NOSE, SIZE)
    assert shown(page, version + 1)["vertices"][:, 0].max() > 1.5


def test_targets_are_chosen_on_the_page(page, place):
    page.select_option("#target", "heart")
    state = shown(page, 1)
    assert page.input_value("#target") == "" and state["match"] > 0.85
    np.testing.assert_allclose(place.studio.canvas.target(), read_named_target("heart", place.view.seen), atol=0.01)
    page.select_option("#target", "blank")
    vertices = shown(page, 2)["vertices"]
    assert (place.studio.canvas.pixels() == 255).all()
    np.testing.assert_allclose(vertices, state["vertices"])  # it waits for something to be painted
    page.select_option("#target", "own")
    assert shown(page, 3)["match"] > 0.95


SIZES = [(1366, 768), (1920, 1080), (390, 844), (844, 390)]


@pytest.mark.parametrize("size", SIZES, ids=lambda size: f"{size[0]}x{size[1]}")
def test_shadow_and_object_fill_the_window_without_scrolling(instance, place, size):
    width, height = size
    with opened(instance, place, viewport={"width": width, "height": height}) as page:
        assert page.evaluate("() => [document.documentElement.scrollWidth, document.documentElement.scrollHeight]") == [*size]
        boxes = [page.locator(name).bounding_box() for name in ("#shadow", "#object", "#add", "#radius-number", "#undo", "#mesh")]
        for box in boxes:
            assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["y"] >= 0 and box["y"] + box["height"] <= height
        shadow, object_ = boxes[:2]
        assert shadow["width"] == pytest.approx(shadow["height"], abs=1.5)
        areas = [box["width"] * box["height"] for box in (shadow, object_)]
        assert sum(areas) > 0.55 * width * height and min(areas) > 0.2 * width * height
        # Some tools lie behind a button where there is no room.
        small = min(width, height) < 500
        assert page.is_visible("#reset") != small and page.is_visible("#more") == small
        if small:
            page.click("#more")
            panel = page.locator("#extra").bounding_box()
            assert panel["x"] >= 0 and panel["y"] >= 0 and panel["x"] + panel["width"] <= width
            for name in ("#target", "#load", "#reset", "text=GLB"):
                box = page.locator(name).bounding_box()
                assert panel["x"] <= box["x"] and box["x"] + box["width"] <= panel["x"] + panel["width"]
            page.keyboard.press("Escape")
            assert page.is_hidden("#reset")


def light_share(page: Any) -> float:
    """Share of pixels that are light."""
    import io

    image = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("L"))
    return float((image > 128).mean())


def test_dark_pages_are_dark_throughout(instance, place):
    with opened(instance, place, color_scheme="dark") as page:
        assert light_share(page) < 0.03
        shadow, object_ = picture(page, "#shadow"), picture(page, "#object")
        middle = shadow.shape[0] // 2
        assert shadow[middle, middle].mean() + 50 < shadow[10, 10].mean() < 110  # a shadow is darker than its ground
        assert np.median(object_) < 60 and clay(object_).sum() > 2000
        page.keyboard.press("?")
        assert light_share(page) < 0.03
        page.keyboard.press("Escape")
        page.click("#theme")
        page.wait_for_timeout(300)
        assert light_share(page) > 0.6 and page.get_attribute("#theme", "aria-pressed") == "false"
        page.reload()  # the choice is kept
        shown(page, 0)
        assert light_share(page) > 0.6
        page.click("#theme")
        page.wait_for_timeout(300)
        assert light_share(page) < 0.03
        page.emulate_media(color_scheme="light")  # without a choice, the page follows the system
        page.wait_for_timeout(300)
        assert light_share(page) > 0.6
