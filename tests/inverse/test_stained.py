"""Sheets of tinted panes whose coloured shadow is a picture."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.inverse import StainedSheet
from shadowmap_dr.inverse.shadow_art.stained import description

SIZE, PANES = 24, 12


def picture() -> npt.NDArray[np.float64]:
    """Smooth colours."""
    x, y = np.meshgrid(*(np.linspace(0, 1, SIZE),) * 2)
    return np.stack([0.2 + 0.6 * x, 0.5 + 0.3 * np.sin(6 * y), 0.8 - 0.6 * x * y], -1)


def sheet() -> StainedSheet:
    return StainedSheet(picture(), panes=PANES, map_resolution=96)


def test_steps_make_the_floor_the_picture(variant: str) -> None:
    made = sheet()
    first = np.sqrt(np.mean((made.picture() - picture()) ** 2))
    losses = [float(np.array(made.step())[0]) for _ in range(60)]
    last = np.sqrt(np.mean((made.picture() - picture()) ** 2))
    assert losses[0] == pytest.approx(first**2, rel=1e-3)
    assert first > 0.15 and last < 0.03
    assert made.steps == 60 and made.recordings() <= 2
    assert made.tints().shape == (PANES + 4, PANES + 4, 3)
    assert 0 <= made.tints().min() and made.tints().max() <= 1


def test_the_floor_is_what_mitsuba_renders(variant: str) -> None:
    """Upright, and as bright: clear panes make it white."""
    rng = np.random.default_rng(3)
    tints = rng.uniform(0.1, 1, (PANES + 4, PANES + 4, 3)).astype(np.float32)
    made = sheet()
    made.load_state({**made.state(), "tints": tints})
    traced = np.array(mi.render(mi.load_dict(description(tints, PANES, SIZE)), spp=64))
    np.testing.assert_allclose(made.tints(), tints)
    assert np.sqrt(np.mean((made.picture() - traced) ** 2)) < 0.1  # one sample per pixel, at edges of panes
    inner = tints[2:-2, 2:-2].repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_allclose(traced, inner, atol=0.02)
    made.load_state({**made.state(), "tints": np.ones_like(tints)})
    np.testing.assert_allclose(made.picture(), 1, atol=1e-3)


def test_states_go_on_where_they_were(variant: str) -> None:
    one, other = sheet(), sheet()
    for _ in range(3):
        one.step()
    other.load_state(one.state())
    assert other.steps == 3
    np.testing.assert_allclose(np.array(one.step()), np.array(other.step()), rtol=1e-4)
    np.testing.assert_allclose(one.tints(), other.tints(), atol=1e-4)


@pytest.mark.parametrize(
    ("pixels", "settings", "words"),
    [
        (np.ones((4, 5, 3)), {}, "square"),
        (np.ones((4, 4)), {}, "square"),
        (np.full((4, 4, 3), 1.5), {}, "outside of 0"),
        (np.ones((4, 4, 3)), {"panes": 0}, "0 panes"),
        (np.ones((4, 4, 3)), {"step_size": -1}, "step size"),
    ],
)
def test_unusable_input_is_named(variant: str, pixels: npt.ArrayLike, settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ShadowmapError, match=words):
        StainedSheet(pixels, **settings)
