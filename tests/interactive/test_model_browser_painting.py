"""The page in a real browser: painting and erasing, brushes, undo."""

from __future__ import annotations

import numpy as np
from browsers import paint
from model_fakes import eventually
from model_pages import NOSE, SIZE, Place, clay, nose, opened, picture, require_browser, shown

require_browser()


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
