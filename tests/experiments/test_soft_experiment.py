"""The experiment with extended lights: its measures, its scenes, and a small run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.soft import experiment as soft
from shadowmap_dr.experiments.soft import report as soft_report
from shadowmap_dr.experiments.soft import scenes as soft_scenes
from shadowmap_dr.experiments.soft.experiment import SoftOptions, Traced, run_soft


def noisy(mean: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    return (mean + np.random.default_rng(seed).normal(0, sigma, mean.shape)).astype(np.float32)


def test_noise_of_the_reference_is_not_counted() -> None:
    truth = np.full((64, 64, 3), 2.0)
    traced = Traced(noisy(truth, 0.1, 0), noisy(truth, 0.1, 1), np.ones((64, 64), bool), 16)
    assert traced.variance == pytest.approx(0.1**2 / 2, rel=0.05)
    assert traced.noise == pytest.approx(0.1 * 4 / 2, rel=0.05)
    # Far above what chance leaves of 64 x 64 x 3 values.
    assert traced.error(truth.astype(np.float32)) < 0.01
    # A twentieth of the mean, of which the mask leaves out half.
    wrong = truth.copy()
    wrong[:, 32:] += 0.1
    assert traced.error(wrong.astype(np.float32)) == pytest.approx(0.05 / np.sqrt(2), rel=0.05)
    assert traced.bias(wrong.astype(np.float32)) == pytest.approx(0.025, rel=0.05)
    mask = np.zeros((64, 64), bool)
    mask[:, :32] = True
    assert replace(traced, mask=mask).error(wrong.astype(np.float32)) < 0.01


def test_outlines_emitters_and_the_background_are_not_counted(variant: str) -> None:
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 40, "height": 40, "rfilter": {"type": "box"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "orthographic", "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]), "film": film},
            "square": {"type": "rectangle", "to_world": T().scale(0.5)},
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([0.75, 0, 0.5]) @ T().scale(0.1),
                "emitter": {"type": "area"},
            },
        }
    )
    mask = soft.counted_pixels(scene)
    expected = np.zeros((40, 40), bool)
    expected[12:28, 12:28] = True  # 10 to 30 are covered; the outermost two rows lie on or next to the outline
    assert np.array_equal(mask, expected)


def test_reading_names_what_is_above_the_bar() -> None:
    def entry(errors: list[float], glossy: bool = False) -> dict[str, object]:
        return {"glossy": glossy, "errors": [{"error": e} for e in errors]}

    scenes = {"good": entry([0.03, 0.02, 0.01]), "bad": entry([0.02, 0.03, 0.04]), "shiny": entry([0.5, 0.5, 0.5], True)}
    first, above, rising = soft_report.reading({"scenes": scenes})
    assert first.startswith("1 of 2") and "bad (4.00 %)" in above and "good" not in above
    assert rising.endswith("samples: bad.")


@pytest.mark.parametrize("name", soft_scenes.SCENES)
def test_scenes_have_something_to_count(variant: str, name: str) -> None:
    scene = soft_scenes.build(name, 48)
    assert soft.counted_pixels(scene).mean() > 0.2
    assert len(scene.emitters()) >= 1


def test_small_run(variant: str, tmp_path: Path) -> None:
    options = SoftOptions(
        scenes=("desk",),
        samples=((4, 4), (32, 4)),
        resolution=24,
        map_resolution=64,
        reference_spp=256,
        timed=False,
        out=tmp_path / "s",
    )
    record = run_soft(options)
    stored = json.loads((tmp_path / "s" / "soft.json").read_text())
    assert {"shadowmap_dr", "machine", "settings"} <= stored.keys()
    assert stored["scenes"]["desk"]["errors"] == record["scenes"]["desk"]["errors"]
    coarse, fine = (entry["error"] for entry in record["scenes"]["desk"]["errors"])
    assert fine < 0.05 and fine < coarse
    assert (tmp_path / "s" / "soft.png").stat().st_size > 1000 and "desk" in (tmp_path / "s" / "soft.md").read_text()
    assert soft_report.table(record).row_count == 1
    # What is there is kept, not measured again.
    again = run_soft(replace(options, resume=True))
    assert again["scenes"] == stored["scenes"]
    with pytest.raises(ShadowmapError, match="other settings"):
        run_soft(replace(options, resume=True, spp=1))
    # Entries that are none are made again.
    (tmp_path / "s" / "soft.json").write_text(json.dumps({**stored, "scenes": {"desk": {}}}))
    assert run_soft(replace(options, resume=True))["scenes"]["desk"]["errors"]
    (tmp_path / "s" / "soft.json").write_text("[]")
    with pytest.warns(UserWarning, match="soft.json is no record"):
        assert run_soft(replace(options, resume=True))["scenes"]["desk"]["errors"]


@pytest.mark.parametrize(
    ("change", "word"), [({"scenes": ("moon",)}, "moon"), ({"samples": ()}, "samples"), ({"reference_spp": 1}, "reference")]
)
def test_bad_options_are_named(change: dict[str, object], word: str) -> None:
    with pytest.raises(ShadowmapError, match=word):
        SoftOptions(**change)


def test_samples_of_equal_error() -> None:
    """An error of zero asked for more samples than Mitsuba takes, and ended the command."""
    assert soft.equal_error_samples(0.02, 0.5, 96 * 96) == 625
    assert soft.equal_error_samples(0.0, 0.5, 96 * 96) == soft.equal_error_samples(0.005, 0.5, 96 * 96) == 10_000
    assert soft.equal_error_samples(0.5, 0.1, 96 * 96) == 1
    assert soft.equal_error_samples(0.0, 1e6, 512 * 512) * 512 * 512 < 2**32


def test_images_without_pixels_to_count_are_refused(variant: str, tmp_path: Path) -> None:
    chosen = {"samples": ((1, 1),), "map_resolution": 32, "spp": 1, "reference_spp": 16, "timed": False, "out": tmp_path}
    with pytest.raises(
        ShadowmapError, match="scene 'desk' has no lit pixel away from silhouettes in 8 x 8 pixels: give a larger"
    ):
        run_soft(SoftOptions(scenes=("desk",), resolution=8, **chosen))
