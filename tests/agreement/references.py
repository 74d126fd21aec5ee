"""Reference images and derivatives of the cases: rendered by Mitsuba, stored beside this file, and loaded."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from .cases import Case, Changing

FOLDER = Path(__file__).parent / "references"
#: Samples per pixel of each of the renderings with seeds of their own that are averaged.
SAMPLES = 4096


@dataclass(frozen=True)
class Reference:
    """Image and derivative of a case by Mitsuba's ``direct``.

    Attributes:
        image: (H, W, 3), at rest.
        derivative: (H, W, 3), central difference by the case's number.
        slope: derivative of the weighted mean of the image (:func:`weights`), worked out before anything is rounded.
        noise: standard error of ``slope``, estimated from the seeds.
    """

    image: np.ndarray
    derivative: np.ndarray
    slope: float
    noise: float

    def save(self, path: Path) -> None:
        """Write a NumPy archive with half-precision images, of one channel if all are equal."""
        path.parent.mkdir(exist_ok=True)
        images = {"image": _packed(self.image), "derivative": _packed(self.derivative)}
        np.savez_compressed(path, **images, slope=self.slope, noise=self.noise)


def path_of(case: Case) -> Path:
    """Path of the stored reference of a case."""
    return FOLDER / f"{case.name}.npz"


def load(case: Case) -> Reference:
    """Stored reference of a case."""
    with np.load(path_of(case)) as data:
        images = [np.repeat(x, 3 // x.shape[2], axis=2).astype(np.float64) for x in (data["image"], data["derivative"])]
        return Reference(*images, float(data["slope"]), float(data["noise"]))


def traced(case: Case, samples: int = SAMPLES, seeds: int | None = None) -> Reference:
    """Render a reference with Mitsuba, of ``case.seeds`` renderings if ``seeds`` is not given.

    Both ends of a difference take the same random numbers.
    """
    seeds = seeds or case.seeds
    integrator, changing = mi.load_dict({"type": "direct"}), Changing(case)

    def image(t: float, seed: int) -> np.ndarray:
        changing.set(mi.Float(t))
        return np.array(integrator.render(changing.scene, seed=seed, spp=samples), np.float64)

    images = [image(0, seed) for seed in range(seeds)]
    half = 0.5 * case.step
    derivatives = [(image(half, seed) - image(-half, seed)) / case.step for seed in range(seeds)]
    slopes = [float((weights(d.shape) * d).sum()) for d in derivatives]
    noise = float(np.std(slopes, ddof=1) / np.sqrt(seeds)) if seeds > 1 else float("nan")
    return Reference(sum(images) / seeds, sum(derivatives) / seeds, float(np.mean(slopes)), noise)


def weights(shape: tuple[int, ...]) -> np.ndarray:
    """Weights of pixels that sum to 1 and grow from the left to the right, threefold.

    With equal weights what moves inside an image changes nothing: the sum would be all noise.
    """
    height, width, channels = shape
    across = 0.5 + (np.arange(width) + 0.5) / width
    return np.broadcast_to(across[None, :, None] / (height * width * channels), shape)


def _packed(image: np.ndarray) -> np.ndarray:
    rounded = image.astype(np.float16)
    return rounded[:, :, :1] if np.array_equal(rounded, np.repeat(rounded[:, :, :1], rounded.shape[2], axis=2)) else rounded
