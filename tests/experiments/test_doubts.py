"""Warnings of art and faces where a picture is not matched: reasons, and what to try."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from shadowmap_dr.experiments.art import advice
from shadowmap_dr.experiments.faces.image import chance_of_weights, doubts


def art_record(iou: float, holes: float = 0.0, curve: tuple[float, ...] = (0.5, 0.5), **settings: Any) -> dict[str, Any]:
    return {
        "settings": {"targets": ["a.png"], **settings},
        "views": [{"iou": iou, "holes": holes}],
        "iou_curve": {"iou": [[value] for value in curve]},
    }


def disk(radius: float, *centres: tuple[int, int]) -> np.ndarray:
    row, column = np.mgrid[:64, :64]
    return 1 - np.max([np.hypot(row - y, column - x) < radius for y, x in centres], axis=0).astype(np.float32)


def said(record: dict[str, Any], target: np.ndarray, **options: bool) -> str:
    return " ".join(advice.warnings_of(record, [target], **{"fill_holes": False, **options}))


def test_shadows_that_match_badly_have_reasons() -> None:
    whole = disk(20, (32, 32))
    assert said(art_record(0.95), whole) == ""
    assert "(IoU 0.500)" in said(art_record(0.5), whole) and "--smoothness" in said(art_record(0.5), whole)
    assert "target-1.png" in said(art_record(0.5), whole)
    assert "--fill-holes" in said(art_record(0.5, holes=0.2), whole)
    assert "--fill-holes" not in said(art_record(0.5, holes=0.2), whole, fill_holes=True)
    parts = disk(8, (12, 12), (12, 50), (50, 30))
    assert "3 pieces" in said(art_record(0.5), parts)
    assert "pieces" not in said(art_record(0.5, collection="spot"), parts)
    assert "--iterations" in said(art_record(0.5, curve=(0.1, 0.3, 0.5)), whole)
    line = np.ones((64, 64), np.float32)
    line[30:33] = 0
    assert "--resolution" in said(art_record(0.5), line)


def test_widths_and_pieces_of_figures() -> None:
    line = np.ones((64, 200), np.float32)
    line[30:34, 10:190] = 0
    assert advice.thickness(line) == pytest.approx(4, rel=0.05)
    assert advice.pieces(line) == 1 and advice.pieces(np.ones((9, 9), np.float32)) == 0
    noise = (np.random.default_rng(0).random((64, 64)) > 0.1).astype(np.float32)
    assert advice.pieces(noise) == 21
    assert "more than 20 pieces" in said(art_record(0.1), noise)


@pytest.mark.parametrize("count", [3, 20, 40])
def test_chances_of_weights_are_those_of_normal_weights(count: int) -> None:
    drawn = np.random.default_rng(count).normal(size=(4000, count))
    chances = np.sort([chance_of_weights(weights) for weights in drawn])
    assert np.abs(chances - np.linspace(0, 1, len(chances))).max() < 0.03  # uniform
    stats = pytest.importorskip("scipy.stats")
    for size in (0.5, 1.0, 1.5, 2.0):
        exact = stats.chi2.sf(count * size**2, count)
        assert np.log(chance_of_weights(np.full(count, size))) == pytest.approx(np.log(exact), abs=0.03 - 0.05 * np.log(exact))


def test_pictures_of_no_head_are_doubted() -> None:
    usual = {"weights": [0.5] * 20, "chance_of_weights": chance_of_weights([0.5] * 20), "image_error": 0.03}
    assert doubts(usual) == []
    odd = {"weights": [2.0] * 20, "chance_of_weights": chance_of_weights([2.0] * 20), "image_error": 0.3}
    rare, different = doubts(odd)
    assert "one of 1e+08 heads or fewer" in rare and "2.0 standard deviations" in rare and "--prior" in rare
    assert "0.30" in different and "silhouette" in different
