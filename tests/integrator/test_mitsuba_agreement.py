"""Scenes on which Mitsuba tests its own derivatives: ours against stored references that Mitsuba has rendered (`agreement/`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from tests.agreement import measure, references
from tests.agreement.cases import BY_NAME, CASES, Case


@dataclass(frozen=True)
class Known:
    """A deviation that is larger than the tolerance: the mean error may not exceed ``bound``, a little more than was measured."""

    bound: float
    reason: str


KNOWN = {
    ("corner_moves", "forward"): Known(0.065, "shadows that rows of directions throw alike, and the contact: 5.93 %"),
    ("corner_moves", "reverse"): Known(0.035, "the same: 3.0 %"),
    ("painted_plane_moves", "reverse"): Known(0.02, "a hundredth of its terms, at texels that samples meet by chance: 1.5 %"),
    ("occluder_in_sky", "reverse"): Known(0.025, "a penumbra of 256 sharper shadows, of which each is sampled: 2.14 %"),
}


@pytest.mark.parametrize("mode", measure.MODES)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_agreement(variant: str, case: Case, mode: str) -> None:
    found, known = measure.error(case, mode), KNOWN.get((case.name, mode))
    bound = known.bound if known else measure.TOLERANCES[mode]
    reason = f" ({known.reason})" if known else ""
    assert found.mean <= bound, f"mean error {found.mean:.2%}, largest {found.largest:.0%}{reason}"


def test_sixty_of_sixty_six_agree() -> None:
    assert len(CASES) * len(measure.MODES) == 66 and len(KNOWN) <= 6
    assert all(known.bound > measure.TOLERANCES[mode] for (_, mode), known in KNOWN.items())


@pytest.mark.parametrize("name", ["square_in_constant", "occluder_of_point"])
def test_references_are_mitsubas(variant: str, name: str) -> None:
    stored, anew = references.load(BY_NAME[name]), references.traced(BY_NAME[name], samples=256, seeds=1)
    np.testing.assert_allclose(anew.image.mean(), stored.image.mean(), rtol=2e-3)
    assert np.abs(anew.image - stored.image).mean() < 0.01 * stored.image.mean()
    assert anew.slope == pytest.approx(stored.slope, rel=0.05)


def test_references_are_precise() -> None:
    """Their noise is at most half the tolerance in reverse mode."""
    for case in CASES:
        stored = references.load(case)
        assert stored.noise <= 0.5 * measure.TOLERANCES["reverse"] * abs(stored.slope), case.name
