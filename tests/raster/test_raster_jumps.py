"""Derivatives by the places of edges: colours count as they are there, not as they are at the pixels' centres."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from raster_scenes import topology_of

from shadowmap_dr.raster import antialias, rasterize

SIZE = 64
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32)
#: Colours of a square, which fall towards its edges, and of what is behind it, and rises: in the middle, and by the pixel.
NEAR, FAR = (2.0, -0.06, -0.04), (0.0, 0.01, 0.01)


def ramp(colour: tuple[float, float, float], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return colour[0] + colour[1] * np.abs(x) + colour[2] * np.abs(y)


def corners(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) @ np.array([[c, s], [-s, c]]) + [0.013, -0.021]


def grown(angle: float, values: list[np.ndarray], continued: bool, sharpness: object = None) -> tuple:
    """(blended image, growth) of the square before a larger one. ``values``: of pixels that see either."""
    world = np.c_[np.r_[corners(angle), [[-1.5, -1.5], [1.5, -1.5], [1.5, 1.5], [-1.5, 1.5]]], np.repeat([0, 0.5], 4)]
    world = world.astype(np.float32)
    growth = mi.Float(0)
    dr.enable_grad(growth)
    x, y, z = (mi.Float(world[:, k].copy()) for k in range(3))
    x, y = (v * (1 + growth * mi.Float(np.repeat(np.float32([1, 0]), 4))) for v in (x, y))
    clip = mi.TensorXf(dr.ravel(mi.Point4f(x, y, z, 1)), shape=(8, 4))
    out = rasterize(clip, mi.TensorXu(FACES), (SIZE, SIZE))
    first, second = (mi.Float(v.astype(np.float32).ravel()) for v in values)
    value = dr.select(out.triangle < 2, first, second)
    flags = {"creases": mi.Bool([True] * 12), "crease_weights": sharpness} if sharpness is not None else {}
    return antialias([value], out, clip, topology_of(FACES, world), continued=continued, **flags), growth


def expected(angle: float) -> float:
    """The boundary integral of the difference of both colours."""
    total = 0.0
    points = corners(angle)
    for p, q in zip(points, np.roll(points, -1, 0), strict=True):
        t = (np.arange(1000) + 0.5) / 1000
        x, y = (SIZE / 2 * (p[k] + (q[k] - p[k]) * t) for k in range(2))
        total += (ramp(NEAR, x, y) - ramp(FAR, x, y)).mean() * (p[0] * q[1] - p[1] * q[0]) * (SIZE / 2) ** 2
    return total


@pytest.mark.parametrize("degrees", [0, 29, 45, 61])
def test_colours_are_those_at_the_edge(variant: str, degrees: float) -> None:
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    angle, values = np.radians(degrees), [ramp(NEAR, x, y), ramp(FAR, x, y)]
    want, found = expected(angle), []
    for continued in (True, False):
        image, growth = grown(angle, values, continued)
        dr.backward(dr.sum(image))
        found.append(dr.grad(growth)[0])
    assert found[0] == pytest.approx(want, rel=0.005)
    assert found[1] > 1.02 * want
    image, growth = grown(angle, values, True)
    dr.forward(growth)
    assert dr.sum(dr.grad(image))[0] == pytest.approx(found[0], rel=1e-4)
    # The image itself is the same.
    assert (image.numpy() == grown(angle, values, False)[0].numpy()).all()


def test_noise_is_not_continued_far(variant: str) -> None:
    """Colours beyond the pixels change no sign, and at most double a derivative; between facets of middle size
    nothing.

    Small ones (0) are shaded as a smooth surface, large ones (1) as they are.
    """
    random = np.random.default_rng(0)
    values = [random.uniform(size=(SIZE, SIZE)) for _ in range(2)]

    def change(continued: bool, sharpness: object = None) -> np.ndarray:
        image, growth = grown(0.0, values, continued, sharpness)
        dr.forward(growth)
        return dr.grad(image).numpy()

    plain, continued = change(False), change(True)
    assert (plain * continued >= 0).all() and (np.abs(continued) <= 2.0001 * np.abs(plain)).all()
    assert (continued != plain).sum() > 20
    pixels = SIZE * SIZE
    assert (change(True, dr.full(mi.Float, 0.99, pixels)) == change(False, dr.full(mi.Float, 0.99, pixels))).all()
    for sharpness in (0, 1):
        alike = dr.full(mi.Float, sharpness, pixels)
        assert (change(True, alike) != change(False, alike)).sum() > 20
