"""Versions of Mitsuba that were never tried are named."""

from __future__ import annotations

import warnings

import mitsuba as mi
import pytest

from shadowmap_dr.variants import warn_if_untried


def test_the_installed_version_is_one_that_was_tried() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_if_untried(mi.__version__)


@pytest.mark.parametrize("version", ["3.10.0", "3.8.1", "4.0.0.dev1"])
def test_other_versions_are_named_with_a_remedy(version: str) -> None:
    with pytest.warns(UserWarning, match=rf"Mitsuba {version} was never tried .* pip install 'mitsuba=="):
        warn_if_untried(version)
