"""Figures: read from images, drawings and text, filled, and placed in views."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.inverse.shadow_art import target_images

WIDTH, HEIGHT = 60, 40


def drawing():
    """A rectangle in the left half, upper part: (H, W) mask."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[8:20, 10:26] = True
    return mask


def save(path, dark_on_light=True, mode="L", alpha=False):
    mask = drawing()
    grey = np.where(mask == dark_on_light, 0, 255).astype(np.uint8)
    image = Image.fromarray(grey).convert(mode)
    if alpha:
        image = Image.merge("RGBA", [Image.new("L", (WIDTH, HEIGHT), 255)] * 3 + [Image.fromarray(mask.astype(np.uint8) * 255)])
    image.save(path)


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.png", {}),
        ("a.png", {"dark_on_light": False}),
        ("a.png", {"mode": "RGB"}),
        ("a.png", {"alpha": True}),
        ("a.gif", {"mode": "P"}),
        ("a.bmp", {}),
    ],
)
def test_figures_are_what_differs_from_the_border(tmp_path, name, options):
    save(tmp_path / name, **options)
    np.testing.assert_allclose(target_images.read_figure(tmp_path / name), drawing(), atol=0.02)


def test_jpegs_are_figures_too(tmp_path):
    save(tmp_path / "a.jpg")
    assert ((target_images.read_figure(tmp_path / "a.jpg") > 0.5) == drawing()).mean() > 0.99


def test_grey_of_16_bits_is_scaled(tmp_path):
    # Lit ground a little darker than white, and a figure of a third of it: to whoever clips at 255, both are white.
    pixels = np.full((40, 40), 60000, np.uint16)
    pixels[10:30, 10:30] = 20000
    Image.fromarray(pixels).save(tmp_path / "deep.png")
    figure = target_images.read_figure(tmp_path / "deep.png")
    np.testing.assert_array_equal(figure > 0.5, pixels == 20000)


def test_drawings_become_figures(tmp_path):
    pytest.importorskip("resvg_py")
    path = tmp_path / "a.svg"
    rectangle = '<rect x="10" y="8" width="16" height="12"/>'
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 60 40">{rectangle}</svg>')
    figure = target_images.read_figure(path)
    height, width = figure.shape
    assert width / height == pytest.approx(1.5, rel=0.01) and width >= 500
    assert figure.mean() == pytest.approx(drawing().mean(), rel=0.02)
    assert figure[int(0.35 * height), int(0.3 * width)] == 1 and figure[int(0.8 * height), int(0.3 * width)] == 0
    path.write_text("<svg")
    with pytest.raises(ShadowmapError, match="a.svg"):
        target_images.read_figure(path)


def test_without_the_package_drawings_say_so(tmp_path, monkeypatch):
    (tmp_path / "a.svg").write_text("<svg/>")
    monkeypatch.setitem(sys.modules, "resvg_py", None)
    with pytest.raises(ShadowmapError, match="resvg-py"):
        target_images.read_figure(tmp_path / "a.svg")


def test_what_is_no_figure_is_named(tmp_path):
    Image.new("L", (9, 9), 200).save(tmp_path / "blank.png")
    (tmp_path / "broken.png").write_bytes(b"\x89PNG nonsense")
    (tmp_path / "a.txt").write_text("no image")
    for name in ("blank.png", "broken.png", "a.txt", "missing.png"):
        with pytest.raises(ShadowmapError, match=name) as caught:
            target_images.read_figure(tmp_path / name)
        assert "\n" not in str(caught.value)


def test_letters_are_cut_out_closely():
    letter = target_images.text_figure("L")
    assert (letter[1:-1].max(1) > 0.5).all() and (letter[:, 1:-1].max(0) > 0.5).all()
    height, width = letter.shape
    assert letter[height // 2, width // 4] == 1 and letter[height // 4, 3 * width // 4] == 0
    assert target_images.text_figure("LL").shape[1] > 1.7 * width
    for text in ("", "  ", "x" * 41):
        with pytest.raises(ShadowmapError):
            target_images.text_figure(text)
    with pytest.raises(ShadowmapError, match="DejaVu Sans has no 你 好: give an image"):
        target_images.text_figure("a 你好")


def test_only_enclosed_holes_are_filled():
    ring = np.zeros((20, 20))
    ring[2:18, 2:18] = 1
    ring[6:10, 6:14] = 0
    ring[14:20, 8:12] = 0  # a bay that is open to the outside
    ring[5, 6:14] = 0.5
    whole = target_images.filled(ring)
    expected = ring.copy()
    expected[5:10, 6:14] = 1
    np.testing.assert_array_equal(whole, expected)


def test_figures_fill_their_share_of_the_view_undistorted():
    seen = np.ones((100, 100), bool)
    target = target_images.fit(drawing(), seen, 0.8)
    dark = target < 0.5
    rows, columns = np.flatnonzero(dark.any(1)), np.flatnonzero(dark.any(0))
    assert len(columns) == pytest.approx(76, abs=6) and len(columns) / len(rows) == pytest.approx(16 / 12, rel=0.05)
    assert rows.mean() == pytest.approx(49.5, abs=1) and columns.mean() == pytest.approx(49.5, abs=1)
    assert (1 - target).sum() == pytest.approx(len(rows) * len(columns), rel=0.05)


def test_figures_stay_within_what_is_seen():
    row, column = np.mgrid[:100, :100]
    seen = (column > 20) & (column < 80) & (row + column > 70)
    dark = target_images.fit(drawing(), seen, 1.0) < 0.5
    assert dark.any() and not dark[~seen].any()
    assert dark.sum() > 0.2 * seen.sum()


def test_heights_can_be_given():
    seen = np.ones((128, 128), bool)
    for figure in (drawing(), target_images.text_figure("I")):
        assert np.count_nonzero((target_images.fit(figure, seen, high=60) < 0.5).any(1)) == pytest.approx(60, abs=1)


@pytest.mark.parametrize(
    ("size", "shape"),
    [
        ('width="1" height="40"', (1024, 26)),
        ('width="30mm" height="1cm"', (341, 1024)),
        ('width="50%" viewBox="0 0 100 200"', (1024, 512)),
        ('viewBox="0,0,20,10" height="50"', (512, 1024)),
    ],
)
def test_longer_side_of_drawings_is_bounded(tmp_path: Path, size: str, shape: tuple[int, int]) -> None:
    pytest.importorskip("resvg_py")
    path = tmp_path / "a.svg"
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {size}><rect width="100%" height="50%"/></svg>')
    figure = target_images.read_figure(path)
    assert np.abs(np.subtract(figure.shape, shape)).max() <= 4  # from a size in whole pixels


@pytest.mark.parametrize(
    "size", ['width="1" height="100000"', 'width="1e9" height="1e3"', 'width="0" height="10"', 'width="1e999" height="1"']
)
def test_narrow_drawings_are_refused(tmp_path: Path, size: str) -> None:
    """They ended the process, or took gigabytes."""
    pytest.importorskip("resvg_py")
    path = tmp_path / "a.svg"
    path.write_text(f'<svg xmlns="http://www.w3.org/2000/svg" {size}><rect width="1" height="1"/></svg>')
    with pytest.raises(ShadowmapError, match="cannot read .*a.svg"):
        target_images.read_figure(path)


def test_noisy_grey_photographs_are_cut_at_otsus_threshold(tmp_path: Path) -> None:
    """The extremes of noise are no figure: such a picture ended at an intersection over union of 0.01."""
    row, column = np.mgrid[:240, :320]
    disk = ((column - 160) / 75) ** 2 + ((row - 120) / 85) ** 2 < 1
    noise = np.random.default_rng(0).normal(0, 0.09, disk.shape)
    grey = np.where(disk, 0.35, 0.6) + 0.15 * (column / 320 - 0.5) + noise
    for name, values in (("dark.png", grey), ("bright.png", 1 - grey)):
        Image.fromarray((np.clip(values, 0, 1) * 255).astype(np.uint8)).save(tmp_path / name)
        figure = target_images.read_figure(tmp_path / name) > 0.5
        assert (figure & disk).sum() > 0.95 * (figure | disk).sum()


def test_otsus_threshold_separates_best() -> None:
    values = np.random.default_rng(0).random(500)
    threshold, separation = target_images.otsu(values)

    def between(t: float) -> float:
        below, above = values[values < t], values[values >= t]
        return len(below) * len(above) * (below.mean() - above.mean()) ** 2 / len(values) ** 2

    best = max(between(t) for t in np.linspace(0.01, 0.99, 99))
    assert between(threshold) >= 0.99 * best and separation == pytest.approx(best / values.var(), rel=0.02)
    assert target_images.otsu([0.2, 0.2, 0.8])[0] == pytest.approx(0.5, abs=0.01)
    assert target_images.otsu([0.2, 0.8])[1] == pytest.approx(1) and target_images.otsu([0.3, 0.3])[1] == 0
