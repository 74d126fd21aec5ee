"""Meshes, views and targets for the optimisers of shadow art."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from shadowmap_dr.inverse import Collection, Sculptor, shadow_view

from .outcome import check
from .random_meshes import random_mesh
from .values import OTHERS, chance, number, pick

_SIDE = 24


def run(rng: np.random.Generator, folder: Path) -> str:
    """Take two steps."""
    mesh = random_mesh(rng)
    view = _view(rng)
    shape = view.shape
    vertices: Any = mesh.vertices
    faces: Any = mesh.faces
    if chance(rng, 0.1):
        vertices = pick(rng, (vertices.T, vertices[:0], vertices.astype(str), vertices.astype(complex), *OTHERS))
    if chance(rng, 0.1):
        faces = pick(rng, (faces.T, faces[:0], faces.astype(float), faces.ravel(), *OTHERS))
    options: dict[str, Any] = {"map_resolution": 24, "filter_size": 3}
    if chance(rng, 0.2):
        options[pick(rng, ("step_size", "map_resolution", "filter_size", "method"))] = pick(
            rng, (0, -1, 1e30, float("nan"), "x", None, 5)
        )
    target = _target(rng, shape)
    maker: Any
    if chance(rng, 0.5):
        maker = Sculptor(vertices, faces, [view], [target], **options)
    else:
        maker = Collection(vertices, faces, [view], [target], most=4, interval=2, **options)
    losses = [float(np.asarray(maker.step()).reshape(-1)[0]) for _ in range(2)]
    (image,) = maker.visibility()
    check(image.shape == shape, f"an image of shape {image.shape}")
    if mesh.sound and not options.get("step_size"):
        check(np.isfinite([*losses]).all() and np.isfinite(maker.vertices()).all(), "losses or vertices are not finite")
        check(np.isfinite(image).all() and image.min() >= -1e-4 and image.max() <= 1 + 1e-4, "visibilities out of range")
    return f"losses {losses}"


def _view(rng: np.random.Generator) -> Any:
    if chance(rng, 0.85):
        return shadow_view(size=_SIDE)
    direction = pick(rng, ((0, 0, 0), (1, 2, 3), (number(rng), 0, -1), (1, 2), None, "x", (0, -1, 0)))
    return shadow_view(direction, size=pick(rng, (_SIDE, 1, 0, -3)), half=pick(rng, (2.0, 0.0, 1e-30, 1e30, float("nan"))))


def _target(rng: np.random.Generator, shape: tuple[int, ...]) -> Any:
    kinds = (np.ones(shape), np.zeros(shape), rng.random(shape))
    if chance(rng, 0.85):
        return pick(rng, kinds)
    return pick(
        rng,
        (np.full(shape, np.nan), np.full(shape, 2.0), np.ones((3, 4)), np.ones((*shape, 3)), np.ones(shape, complex), *OTHERS),
    )
