"""Loops as Mitsuba's users write them, in which only the integrator is exchanged. Beside the originals: `bench --only loops`."""

from __future__ import annotations

import warnings

import pytest

from shadowmap_dr.experiments.bench.loops import LOOPS, OURS

SIZE = 24
# Loops that need all their steps to come below their bar; of the others these are enough.
_SLOW = {"large steps", "more and more lights", "vertex colours", "remeshing", "cells run again"}
_STEPS = 12
_NEEDS = {"PyTorch": "torch", "large steps": "cholespy", "remeshing": "cholespy"}


@pytest.mark.parametrize("name", LOOPS)
def test_loop(variant: str, name: str) -> None:
    if name in _NEEDS:
        pytest.importorskip(_NEEDS[name])
    loop = LOOPS[name]
    steps = loop.steps(OURS, SIZE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        errors = [next(steps) for _ in range(loop.count if name in _SLOW else _STEPS)]
    assert errors[-1] < loop.bar * errors[0]
