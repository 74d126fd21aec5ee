"""Images of analytic shapes and curves against Mitsuba's: shading, outlines and shadows. Their derivatives: test_gradients.py."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients.cases import CASES_BY_NAME
from scipy import ndimage

from mitsuba_baselines import reference, unshadowed
from shadowmap_dr import Renderer

SPP = 256
SHAPES = [("shapes", "ball"), ("shapes", "tube"), ("shapes", "plate"), ("curves", "wire"), ("curves", "stick")]


@lru_cache(maxsize=4)
def images(variant: str, case: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ours and Mitsuba's without shadows, and our shape at each of 4 x 4 places of a pixel."""
    build = CASES_BY_NAME[case].build
    ours = np.array(Renderer.from_scene(build(), shadow_method="none").render(spp=64))
    fine = build()
    film = mi.traverse(fine)
    film["camera.film.size"] = [4 * side for side in film["camera.film.size"]]
    film.update()
    seen = np.array(Renderer.from_scene(fine, shadow_method="none", antialias=False, aovs=("shape_index",)).render())[..., 3]
    return ours, unshadowed.unshadowed(build(), spp=SPP).image, seen


@pytest.mark.parametrize(("case", "name"), SHAPES)
def test_shading_of_the_inside(variant: str, case: str, name: str) -> None:
    ours, target, seen = images(variant, case)
    names = [info.name for info in Renderer.from_scene(CASES_BY_NAME[case].build()).data.geometry.shapes]
    own = (seen == names.index(name)).reshape(*[n for side in target.shape[:2] for n in (side, 4)]).all((1, 3))
    inside = ndimage.binary_erosion(own, np.ones((3, 3)))
    assert inside.sum() > 100
    error = np.sqrt(np.mean((ours - target)[inside] ** 2) / np.mean(target[inside] ** 2))
    assert error < 0.015, f"relative RMSE {error:.2%}"


@pytest.mark.parametrize("case", ["shapes", "curves"])
def test_outlines(variant: str, case: str) -> None:
    ours, target, _ = images(variant, case)
    error = np.abs(ours - target).mean() / target.mean()
    assert error < 0.003, f"mean absolute error {error:.2%} of the mean"


@pytest.mark.parametrize("case", ["shapes", "curves"])
def test_shadows(variant: str, case: str) -> None:
    build = CASES_BY_NAME[case].build
    ours = np.array(Renderer.from_scene(build(), shadow_map_resolution=1024).render(spp=64))
    target = reference.path_traced(build(), spp=SPP).image
    error = np.abs(ours - target).mean() / target.mean()
    assert error < 0.015, f"mean absolute error {error:.2%} of the mean"


def test_frozen_rendering_of_curves(variant: str) -> None:
    """Scenes with curves cross the border of a frozen function, whose recording knows none of their vertices."""
    renderer = Renderer.from_scene(CASES_BY_NAME["curves"].build(), shadow_map_resolution=64)
    rest = renderer.data.geometry.shape_positions("stick")

    @dr.freeze
    def image(renderer: Renderer, positions: Any) -> Any:
        return renderer.render(vertex_positions={"stick": positions})

    frozen = replace(renderer)
    for k in range(4):
        moved = rest + mi.Vector3f(0.1 * k, 0, 0.05 * k)
        expected = replace(renderer).render(vertex_positions={"stick": moved})
        assert np.allclose(image(frozen, moved).numpy(), expected.numpy(), atol=1e-4), k
    assert image.n_recordings <= 3
