"""Reports of fits: one file, all texts escaped, readable for everybody."""

from __future__ import annotations

import base64
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsers import browser, chromium
from fit_results import LABELS, estimate, history, picture, result, vertices
from PIL import Image

from shadowmap_dr.errors import OutputError
from shadowmap_dr.fitting import report
from shadowmap_dr.fitting.report import report_html, write_report
from shadowmap_dr.fitting.report_numbers import strong_pairs
from shadowmap_dr.fitting.result import FitResult, read_fit

NASTY = "<script>alert('1')</script> & \"q\" $x$ é 写真 \u202e"
VOID = {"meta", "img", "input", "br", "source", "col"}


class Page(HTMLParser):
    """Elements and texts of a page; it fails for elements that are not closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] not in ("script", "style"):
            self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def nasty() -> FitResult:
    """A result whose texts would be markup."""
    return result(
        found=False,
        words=[NASTY],
        estimates=[estimate(name=NASTY, labels=(NASTY, *LABELS[1:]), units=(NASTY,) * 6)],
        names=[NASTY] * 7,
        pictures=[picture(name=NASTY, frames=[(NASTY, picture().start)])],
        history=[{**step, "stage": NASTY[:38]} for step in history()],  # type: ignore[typeddict-item]  # a Step, as mypy cannot see
        command=f"shadowmap-dr fit {NASTY}",
        settings={NASTY: NASTY, "table": {NASTY: [NASTY]}},
        made={"shadowmap_dr": NASTY, "machine": {NASTY: NASTY}},
    )


def test_the_report_has_all_sections(tmp_path: Path) -> None:
    write_report(result(), tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    for words in ("Found: the scene matches", "translation z is not determined.", "-12.35", "0.03", "have the correlation −0.97"):
        assert words in page.text
    for words in ("photo.png", "rendered colours × 1.25", "shadowmap-dr fit scene.xml", "starts = 3", "mitsuba", "12 s from 3"):
        assert words in page.text
    alts = [str(attributes["alt"]) for attributes in page.all("img")]
    for title in ("Target of", "Start of", "Fit of", "Difference of", "Mask of", "Shadows of", "Film", "Error over seconds"):
        assert any(alt.startswith(title) for alt in alts), title
    assert len(page.all("h1")) == 1 and page.all("html") == [{"lang": "en"}]


def test_a_fit_that_was_not_found_looks_like_one() -> None:
    page = Page(report_html(result(found=False, words=["Give more starts."])))
    assert "Not found: the scene does not match" in page.text and "Give more starts." in page.text
    assert "verdict lost" in str(page.all("header")) and "✗" in page.text and "✓" not in page.text
    assert "Do not take them for estimates" in page.text
    assert "0.034" not in page.text and "not determined" not in page.text.split("Estimates")[1].split("Correlations")[0]


@pytest.mark.parametrize("make", [result, nasty])
def test_nothing_is_loaded_and_nothing_foreign_runs(make: Any) -> None:
    html = report_html(make())
    page = Page(html)
    assert not page.all("link") and not page.all("iframe") and len(page.all("script")) == 1
    for _, attributes in page.elements:
        assert not any(name.startswith("on") for name in attributes)
        for name in ("src", "srcset", "href"):
            assert str(attributes.get(name, "data:image/")).startswith("data:image/")
    assert "url(" not in html and "@import" not in html
    assert "script-src 'sha256-" in str(page.all("meta")[1]["content"])
    if make is nasty:
        assert page.text.count(NASTY) > 10 and "alert('1')</script>" not in html


@pytest.mark.parametrize("count", [0, 1, 4])
def test_any_number_of_pictures(count: int) -> None:
    page = Page(report_html(result(pictures=[picture(name=f"{k}.png") for k in range(count)])))
    identities = [attributes["id"] for _, attributes in page.elements if "id" in attributes]
    assert len(identities) == len(set(identities)) == 2 * count
    assert f"matches the {count} pictures" in page.text or count < 2


def test_parts_that_are_missing_are_left_out(tmp_path: Path) -> None:
    bare = picture(weight=np.ones((24, 32)), shadows=None, frames=[], name="", exposure=1.0)
    page = Page(report_html(result(pictures=[bare], history=[], estimates=[], names=[], correlations=np.zeros((0, 0)), words=[])))
    for words in ("Mask", "Shadows", "Film", "Course", "Estimates", "Correlations"):
        assert words not in page.text
    result().write_json(tmp_path / "fit.json")
    assert "has no pictures" in Page(report_html(read_fit(tmp_path / "fit.json"))).text


def test_numbers_that_are_not_finite() -> None:
    broken = picture()
    broken.fit[:] = np.nan
    correlations = np.full((7, 7), np.nan)
    steps = history()
    for step in steps[::2]:
        step["error"] = float("nan")
    made = result(pictures=[broken], correlations=correlations, history=steps, seconds=float("nan"))
    page = Page(report_html(made))
    assert "Empty: a number is not determined" in page.text and "unknown time" in page.text
    for step in steps:
        step["error"] = float("inf")
    assert "No start has an error that is a number" in Page(report_html(made)).text
    Page(report_html(result(pictures=[picture(weight=np.zeros((24, 32)))] * 2)))


def test_strong_correlations_are_named_strongest_first() -> None:
    made = result(correlations=np.eye(7))
    assert not strong_pairs(made) and "tell all of them apart" in report_html(made)
    for k, value in enumerate((0.96, -0.999, 0.94)):
        made.correlations[k, k + 1] = made.correlations[k + 1, k] = value
    assert [(second, value) for _, second, value in strong_pairs(made)] == [
        ("bunny:pose rotation z", -0.999),
        ("bunny:pose rotation y", 0.96),
    ]
    text = Page(report_html(made)).text
    assert "−0.999" in text and text.count("have the correlation") == 2
    many = result(names=[f"n{k}" for k in range(60)], correlations=np.ones((60, 60)))
    text = Page(report_html(many)).text
    assert "So have 1762 further pairs" in text and "all 60 numbers is in fit.json" in text


def test_large_pictures_are_embedded_smaller_and_small_ones_whole() -> None:
    large = picture(600, 2000, frames=[], shadows=None)
    for made, size in ((large, (1024, 307)), (picture(), (32, 24))):
        source = str(Page(report_html(result(pictures=[made]))).all("img")[0]["src"])
        assert Image.open(io.BytesIO(base64.b64decode(source.split(",")[1]))).size == size


def test_commands_have_a_line_for_each_option() -> None:
    command = (
        "shadowmap-dr fit scene.xml --target '0=a b.png' --vary bunny:pose --vary wall.bsdf.reflectance --exposure --out fit"
    )
    lines = report._in_lines(command).split("\n")
    assert (
        lines[0] == "shadowmap-dr fit scene.xml \\" and lines[1] == "    --target '0=a b.png' \\" and lines[-1] == "    --out fit"
    )
    for other in ("short --out x", "unclosed ' " + 100 * "x", f"a '{50 * 'x'}\n{50 * 'x'}'"):
        assert report._in_lines(other) == other


def test_reports_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        write_report(result(), tmp_path)


def test_letters_have_contrast() -> None:
    """WCAG 2: 4.5 to 1, in both modes."""
    style = (Path(report.__file__).parent / "page" / "report.css").read_text(encoding="utf-8")
    light, dark = (dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6})", block)) for block in style.split("@media")[:2])
    for colours in (light, dark):
        pairs = [(ink, page) for ink in ("ink", "pale", "accent", "good", "bad") for page in ("page", "raised")]
        pairs += [(ink, f"{kind}-page") for kind in ("good", "bad") for ink in (kind, "ink", "pale")]
        for ink, page in pairs:
            low, high = sorted(_luminance(colours[name]) for name in (ink, page))
            assert (high + 0.05) / (low + 0.05) >= 4.5, (ink, page)


def _luminance(colour: str) -> float:
    channels = [int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))


@pytest.mark.skipif(chromium() is None, reason="no Chromium")
def test_in_a_browser(tmp_path: Path) -> None:
    """Nothing is wider than a telephone, the slider compares, and the page is whole without JavaScript."""
    pytest.importorskip("playwright")
    made = nasty()
    made.estimates += [vertices(), estimate(name="a" * 90)]
    made.pictures.append(picture(40, 20, name="b" * 90))
    write_report(made, tmp_path / "report.html")
    address = (tmp_path / "report.html").as_uri()
    with browser() as chrome:
        for width in (320, 400, 1280):
            page = chrome.new_page(viewport={"width": width, "height": 800})
            messages: list[str] = []
            page.on("console", lambda message, seen=messages: seen.append(message.text))
            page.on("dialog", lambda dialog, seen=messages: (seen.append("dialog"), dialog.dismiss()))
            page.goto(address)
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert not messages
            assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
        slider = page.locator(".compare input").first
        assert slider.is_visible() and page.locator(".compare img").count() == 4
        slider.fill("80")
        assert "80%" in page.locator(".compare img").nth(1).evaluate("image => image.style.clipPath")
        plain = chrome.new_context(java_script_enabled=False).new_page()
        plain.goto(address)
        assert not plain.locator(".compare").first.is_visible() and plain.locator("figure img").first.is_visible()
