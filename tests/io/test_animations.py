"""Animated images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io.animations import write_animation


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".WEBP"])
def test_frames_and_durations(tmp_path: Path, suffix: str) -> None:
    frames = [np.full((8, 10, 3), 60 * k, np.uint8) for k in range(3)]
    write_animation(tmp_path / f"a{suffix}", frames, last_ms=500)
    with Image.open(tmp_path / f"a{suffix}") as animation:
        assert animation.n_frames == 3 and animation.size == (10, 8)  # type: ignore[attr-defined]  # animations
        animation.seek(2)
        animation.load()
        assert animation.info["duration"] == 500 and animation.info["loop"] == 0
        assert abs(int(np.asarray(animation.convert("RGB")).mean()) - 120) < 4


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match=r"\.webp, \.gif"):
        write_animation(tmp_path / "a.mp4", [np.zeros((8, 8, 3), np.uint8)])
