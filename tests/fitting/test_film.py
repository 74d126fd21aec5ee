"""Films of fits: size, order of the frames, nearest neighbours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fit_results import picture
from PIL import Image

from shadowmap_dr.errors import OutputError, ShadowmapError
from shadowmap_dr.fitting import film
from shadowmap_dr.fitting.film import MOST_BYTES, MOST_FRAMES, still, write_film


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_the_film_goes_from_the_start_to_the_fit(tmp_path: Path, suffix: str) -> None:
    write_film([picture()], tmp_path / f"film{suffix}")
    with Image.open(tmp_path / f"film{suffix}") as animation:
        assert animation.n_frames == 8 and animation.size[0] > 2 * animation.size[1]  # type: ignore[attr-defined]  # animations
        durations = []
        for k in range(8):
            animation.seek(k)
            animation.load()
            durations.append(animation.info["duration"])
    assert durations[-1] == 2000 and max(durations[:-1]) < 300


def test_coarse_frames_are_squares() -> None:
    """A frame of 8 pixels for a target of 32 is enlarged without interpolation."""
    frame = film._frames([picture()], 256, 60)[1]
    tile = frame[film._LINE + film._GAP :][:192, 2 * film._GAP + 256 :][:, :256]
    blocks = tile.reshape(6, 32, 8, 32, 3)
    assert np.array_equal(np.broadcast_to(blocks[:, :1, :, :1], blocks.shape), blocks)
    assert len(np.unique(tile)) == 2


def test_long_and_noisy_films_stay_small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    made = picture(48, 64, frames=[(f"step {k}", rng.random((48, 64, 3)).astype(np.float32)) for k in range(150)])
    assert len(film._frames([made], 32, MOST_FRAMES)) == MOST_FRAMES <= 60 and MOST_BYTES <= 2_000_000
    monkeypatch.setattr(film, "MOST_BYTES", 100_000)
    monkeypatch.setattr(film, "_ATTEMPTS", [attempt for attempt in film._ATTEMPTS if attempt[0] < 200])
    write_film([made], tmp_path / "film.webp")
    assert (tmp_path / "film.webp").stat().st_size <= 100_000


def test_all_targets_are_shown_up_to_four() -> None:
    pictures = [picture(24, 32), picture(48, 20, frames=[]), picture(7, 9), picture(1, 1), picture()]
    heights = [still(pictures[:count]).shape[0] for count in range(1, 6)]
    assert heights[:4] == sorted(set(heights[:4])) and heights[3] == heights[4]
    assert still([picture(frames=[])]).shape == still([picture()]).shape


def test_names_of_any_length_and_script(tmp_path: Path) -> None:
    names = ["x" * 500, "写真 <b>.png", "a\nb"]
    made = [picture(name=name, frames=[(name, picture().start)]) for name in names]
    assert film._frames(made, 64, 3)[0].shape == film._frames([picture()] * 3, 64, 3)[0].shape


def test_numbers_that_are_not_finite_are_drawn() -> None:
    made = picture()
    for image in (made.fit, made.start, made.target):
        image[0, 0], image[1, 1] = np.nan, np.inf
    assert still([made]).dtype == np.uint8
    assert still([picture(weight=np.zeros((24, 32)))]).any()


def test_films_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="not one of"):
        write_film([picture()], tmp_path / "film.mp4")
    with pytest.raises(ShadowmapError, match="no pictures"):
        write_film([], tmp_path / "film.webp")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        write_film([picture()], tmp_path / "file" / "film.webp")
