"""Filters of films and their weighted sums, against Mitsuba's filters and a slow twin."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import ShadowmapError
from shadowmap_dr.rendering.film.reconstruction import reconstruct
from shadowmap_dr.scene.pixel_filter import Filter

FILTERS: dict[str, dict[str, Any]] = {
    "box": {"type": "box"},
    "tent": {"type": "tent"},
    "narrow tent": {"type": "tent", "radius": 0.4},
    "wide tent": {"type": "tent", "radius": 2.5},
    "gaussian": {"type": "gaussian"},
    "wide gaussian": {"type": "gaussian", "stddev": 0.8},
    "mitchell": {"type": "mitchell"},
    "other mitchell": {"type": "mitchell", "B": 0.2, "C": 0.3},
    "catmullrom": {"type": "catmullrom"},
    "lanczos": {"type": "lanczos"},
    "short lanczos": {"type": "lanczos", "lobes": 2},
}


def filter_of(name: str) -> tuple[Filter, Any]:
    film = mi.load_dict({"type": "hdrfilm", "rfilter": FILTERS[name]})
    return Filter.read(film, "eye"), film.rfilter()


@pytest.mark.parametrize("name", FILTERS)
def test_profile_is_that_of_mitsuba(variant: str, name: str) -> None:
    ours, theirs = filter_of(name)
    x = np.linspace(-4, 4, 1000)
    # Mitsuba's Gaussian is a polynomial that comes this near to one.
    assert np.abs(ours.evaluate(x) - theirs.eval(mi.Float(x)).numpy()).max() < 5e-4
    assert ours.border == theirs.border_size() and ours.is_box == theirs.is_box_filter()


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("factor", [1, 2, 3, 8])
def test_weights(variant: str, name: str, factor: int) -> None:
    ours, _ = filter_of(name)
    weights = np.array(ours.weights(factor))
    assert weights.sum() == pytest.approx(1) and np.allclose(weights, weights[::-1])
    assert len(weights) % 2 == factor % 2 and len(weights) <= factor * (2 * ours.border + 1)
    if FILTERS[name]["type"] in ("box", "tent", "gaussian"):
        assert weights.min() >= 0


@pytest.mark.parametrize("name", FILTERS)
def test_blurred_edge_approaches_that_of_the_filter(variant: str, name: str) -> None:
    """An edge at any place in a pixel: the weighted cells, each with its share of it, against the filter's own integral."""
    ours, _ = filter_of(name)
    x = np.linspace(-ours.radius, ours.radius, 20001)
    step = np.cumsum(ours.evaluate(x))
    step /= step[-1]
    bound = {"box": 0.0, "tent": 0.11, "gaussian": 0.11, "lanczos": 0.3}.get(FILTERS[name]["type"], 0.16)
    for factor in (1, 2, 4, 8):
        weights = np.array(ours.weights(factor))
        knots = (np.arange(len(weights) + 1) - 0.5 * len(weights)) / factor
        made = np.interp(x, knots, np.concatenate([[0], np.cumsum(weights)]))
        if factor * ours.radius >= 1:  # nothing narrower than a cell can be shown
            assert np.sqrt(np.mean((made - step) ** 2)) < bound / (factor * ours.radius) ** 2 + 1e-4


def twin(size: tuple[int, int], ours: Filter, factor: int, border: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices from samples to pixels, along rows and columns: each pixel from all samples whose weights reach it."""
    weights = np.array(ours.weights(factor))
    tables = []
    for samples in size:
        pixels = samples // factor - 2 * border
        table = np.zeros((pixels, samples))
        for pixel in range(pixels):
            for k, weight in enumerate(weights):
                sample = (pixel + border) * factor - (len(weights) - factor) // 2 + k
                if 0 <= sample < samples:
                    table[pixel, sample] = weight
        tables.append(table / table.sum(1, keepdims=True))
    return tables[0], tables[1]


@pytest.mark.parametrize("bordered", [False, True])
@pytest.mark.parametrize("name, factor", [("tent", 1), ("gaussian", 1), ("gaussian", 2), ("lanczos", 3), ("wide tent", 4)])
@pytest.mark.parametrize("channels", [1, 3, 4])
def test_reconstruct_in_all_modes(variant: str, name: str, factor: int, channels: int, bordered: bool) -> None:
    ours, _ = filter_of(name)
    border = ours.border if bordered else 0
    # Three rows are fewer than the filters reach across.
    height, width = 3, 9
    rng = np.random.default_rng(0)
    size = ((height + 2 * border) * factor, (width + 2 * border) * factor, channels)
    samples, tangent = rng.random(size), rng.normal(size=size)
    adjoint = rng.normal(size=(height, width, channels))

    down, across = twin(size[:2], ours, factor, border)
    values = mi.TensorXf(samples)
    dr.enable_grad(values)
    image = reconstruct(values, ours, factor, border)
    assert image.shape == (height, width, channels)
    assert np.allclose(image.numpy(), np.einsum("yr,xc,rck->yxk", down, across, samples), atol=1e-5)

    dr.set_grad(values, mi.TensorXf(tangent))
    forward = dr.forward_to(image).numpy()
    assert np.allclose(forward, np.einsum("yr,xc,rck->yxk", down, across, tangent), atol=1e-5)

    values = mi.TensorXf(samples)
    dr.enable_grad(values)
    dr.backward(dr.sum(reconstruct(values, ours, factor, border) * mi.TensorXf(adjoint)))
    assert np.allclose(dr.grad(values).numpy(), np.einsum("yr,xc,yxk->rck", down, across, adjoint), atol=1e-5)


class _UnknownFilter:
    def class_name(self) -> str:
        return "SplineFilter"


class _Film:
    def rfilter(self) -> Any:
        return _UnknownFilter()


def test_unknown_filter_is_named() -> None:
    with pytest.raises(ShadowmapError, match="sensor 'eye'.*SplineFilter.*gaussian"):
        Filter.read(_Film(), "eye")
