"""Kernels of images of many sizes do not stay."""

from __future__ import annotations

import threading
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from renderer_scenes import build

import shadowmap_dr  # noqa: F401  registers the plug-in
from shadowmap_dr.jit import kernel_cache


@pytest.fixture
def flushed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows with each time that kernels are let go; they are after three sizes."""
    calls: list[int] = []
    flush = dr.flush_kernel_cache
    monkeypatch.setattr(dr, "flush_kernel_cache", lambda: calls.append(1) or flush())
    monkeypatch.setattr(kernel_cache, "_MOST_SIZES", 3)
    monkeypatch.setattr(kernel_cache, "_sizes", set())
    monkeypatch.setattr(threading, "active_count", lambda: 1)  # parallel tests have a thread of their own
    return calls


def image(scene: Any, params: Any, integrator: Any, width: int) -> np.ndarray:
    params["camera.film.size"] = params["camera.film.crop_size"] = [width, 8]
    params.update()
    return np.array(mi.render(scene, integrator=integrator, spp=1))


@pytest.mark.parametrize("recorded", [False, True])
def test_images_of_many_sizes(variant: str, flushed: list[int], recorded: bool) -> None:
    """Kernels go, images stay what they were, recordings included."""
    scene = build()
    params = mi.traverse(scene)
    integrator = mi.load_dict({"type": "shadowmap", "shadow_map_resolution": 16, "recorded": recorded})
    first = [image(scene, params, integrator, 8) for _ in range(3)][-1]
    for width in (9, 10, 9, 10, 8):
        image(scene, params, integrator, width)
    assert not flushed
    image(scene, params, integrator, 11)
    assert len(flushed) == 1
    for _ in range(3):
        np.testing.assert_array_equal(image(scene, params, integrator, 8), first)
    assert len(flushed) == 1


def test_other_threads_keep_their_kernels(variant: str, flushed: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "active_count", lambda: 2)
    for size in range(9):
        kernel_cache.note_size(size)
    assert not flushed
