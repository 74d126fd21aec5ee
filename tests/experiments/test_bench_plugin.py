"""The benchmark of the plug-in's steps: its contenders compute the same."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.experiments.bench import plugin as bench_plugin
from shadowmap_dr.experiments.bench.common import FULL


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def test_all_kinds_are_measured() -> None:
    assert FULL.plugin_kinds == tuple(bench_plugin.KINDS)


@pytest.mark.parametrize("kind", [kind for kind in bench_plugin.KINDS if kind in bench_plugin._ARGUMENTS])
def test_the_renderer_of_the_plugin_s_steps_has_their_derivatives(kind: str) -> None:
    loop, frozen = bench_plugin._Loop(kind, 32), bench_plugin._Frozen(kind, 32)
    expected, found = (float(call()[0]) for call in (loop, frozen))
    # A number of degrees turns the light of the plug-in; that of the renderer is a component of a unit vector. The maps of
    # both are fitted at other moments.
    scale = -np.pi / 180 if kind == "light" else 1
    assert abs(expected) > 1e-5 and found * scale == pytest.approx(expected, rel=0.06)
