"""The page in a real browser: turning, zooming, sizes of windows, colours."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from browsers import paint
from model_fakes import eventually
from model_pages import SIZE, clay, opened, picture, require_browser, shown
from PIL import Image

require_browser()


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
