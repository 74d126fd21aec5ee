"""The page in a real browser: images, meshes and targets, several pages, failures."""

from __future__ import annotations

import numpy as np
import pytest
from browsers import paint
from model_fakes import eventually
from model_pages import NOSE, SIZE, clay, opened, phase, picture, require_browser, same_rest, shown
from PIL import Image

from shadowmap_dr.interactive.library import read_named_target

require_browser()


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
