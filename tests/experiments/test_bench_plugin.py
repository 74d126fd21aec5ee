"""The benchmark of the plug-in's steps: its contenders compute the same."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.experiments.bench import plugin as bench_plugin
from shadowmap_dr.experiments.bench import torch_steps as bench_torch
from shadowmap_dr.experiments.bench.common import FULL


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")


def test_all_kinds_are_measured() -> None:
    assert FULL.plugin_kinds == tuple(bench_plugin.KINDS)


def test_titles_name_what_differs() -> None:
    steps = [bench_plugin.Step("camera", 8, spp=4), bench_plugin.Step("camera", 8, lights=3, points=True)]
    assert [str(step) for step in steps] == ["camera, 4 spp@8", "camera, 3 points@8"]
    assert [len(bench_plugin.scene_of(step).emitters()) for step in steps] == [1, 3]


@pytest.mark.parametrize("spp", [1, 2])
def test_steps_through_pytorch_have_the_same_derivatives(spp: int) -> None:
    pytest.importorskip("torch")
    step = bench_plugin.Step("vertices", 32, spp)
    ours, frozen = bench_torch.TorchStep(step), bench_plugin.Frozen(step)
    for _ in range(3):
        found, expected = ours(), float(frozen()[0])
        assert found is not None and abs(expected) > 1e-5 and float(found) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("kind", [kind for kind in bench_plugin.KINDS if kind in bench_plugin._ARGUMENTS])
def test_the_renderer_of_the_plugin_s_steps_has_their_derivatives(kind: str) -> None:
    step = bench_plugin.Step(kind, 32)
    loop, frozen = bench_plugin._Loop(step), bench_plugin.Frozen(step)
    expected, found = (float(call()[0]) for call in (loop, frozen))
    # A number of degrees turns the light of the plug-in; that of the renderer is a component of a unit vector. The maps of
    # both are fitted at other moments.
    scale = -np.pi / 180 if kind == "light" else 1
    assert abs(expected) > 1e-5 and found * scale == pytest.approx(expected, rel=0.06)
