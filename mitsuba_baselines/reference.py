"""Path-traced references: one bounce with shadow rays, as the mean over passes with different seeds."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io import images

SETTINGS_KEY = "shadowmap_settings"
SAMPLES_PER_LAUNCH = 1 << 24
"""Upper bound for pixels x samples of one pass, which bounds its memory."""


@dataclass(frozen=True)
class Reference:
    """An image and its settings.

    Attributes:
        image: (H, W, C) float32, linear radiance; row 0 is the top.
        settings: Settings of the rendering, as plain JSON values. `relative_standard_error` is the root mean square over pixels
            and channels of the mean's standard error, divided by the image's mean (only for two or more passes).
    """

    image: np.ndarray
    settings: dict[str, Any] = field(default_factory=dict)


def path_traced(
    scene: mi.Scene,
    *,
    spp: int = 512,
    seed: int = 0,
    sensor: int = 0,
    integrator: str | None = None,
    hide_emitters: bool = False,
    passes: int | None = None,
) -> Reference:
    """Render a scene's direct light with shadows.

    If all emitters are delta lights (directional, spot, point), each light is rendered alone and the images are added up: the
    integrator is the same, but without the noise of choosing a light at random. `spp` counts per light.

    Args:
        scene: Scene whose film has a box filter.
        spp: Samples per pixel (and light), at least 1, rounded up to squares per pass; protocol: 512 or more.
        seed: Same seed, same image. Images with the same seed share the noise of paths that they have in common.
        sensor: Index of the sensor.
        integrator: `"direct"`, or `"volpath"` (depth 2): the same transport, but shadow rays pass through `mask` BSDFs, which are
            opaque to `direct`. Default: `volpath` if a shape has such a BSDF, else `direct`.
        hide_emitters: Show black instead of visible emitters.
        passes: Number of passes; default: 8, or more to stay below `SAMPLES_PER_LAUNCH`.

    Returns:
        The reference. No gradients.

    Raises:
        ShadowmapError: The film's filter is not a box, or spp < 1.
    """
    name = integrator or ("volpath" if has_masks(scene) else "direct")
    if name not in ("direct", "volpath"):
        raise ShadowmapError(f"integrator {name!r} is no reference for direct light: use 'direct' or 'volpath'.")
    description: dict[str, Any] = {"type": name, "hide_emitters": hide_emitters}
    if name == "volpath":
        description["max_depth"] = 2
    plugin = mi.load_dict(description)
    weights = _selection_weights(scene)

    def render(samples: int, pass_seed: int) -> np.ndarray:
        return np.array(mi.render(scene, sensor=sensor, integrator=plugin, spp=samples, seed=pass_seed))

    def render_all(samples: int, pass_seed: int) -> np.ndarray:
        if weights is None or len(weights) < 2:
            return render(samples, pass_seed)
        total: np.ndarray = np.zeros((), np.float32)
        for index, key in enumerate(weights):
            with _only(scene, weights, key):
                total = total + render(samples, _mix(pass_seed, index))
        return total

    settings = {
        "kind": "path_traced",
        "integrator": name,
        "hide_emitters": hide_emitters,
        "sensor": sensor,
        "lights": "summed" if weights is not None and len(weights) > 1 else "sampled",
    }
    return accumulate(scene, render_all, settings, spp=spp, seed=seed, sensor=sensor, passes=passes)


def accumulate(
    scene: mi.Scene,
    render: Callable[[int, int], np.ndarray],
    settings: dict[str, Any],
    *,
    spp: int,
    seed: int,
    sensor: int,
    passes: int | None = None,
) -> Reference:
    """Mean of `render(samples, seed)` over passes with different seeds, with its standard error.

    Args:
        render: Makes an (H, W, C) image with the given samples per pixel and seed.
        settings: Copied into the result, beside the settings of the sampling.

    Raises:
        ShadowmapError: The film's filter is not a box, or spp < 1.
    """
    film = scene.sensors()[sensor].film()
    if type(film.rfilter()).__name__ != "BoxFilter" and "box" not in str(film.rfilter()).lower():
        raise ShadowmapError(f'the film\'s filter is {film.rfilter()}: references need <rfilter type="box"/>.')
    if spp < 1:
        raise ShadowmapError(f"spp is {spp}: give at least 1.")
    width, height = film.crop_size()
    count = passes or max(min(8, math.ceil(spp / 16)), math.ceil(spp * int(width) * int(height) / SAMPLES_PER_LAUNCH))
    per_pass = math.ceil(math.sqrt(spp / count)) ** 2  # stratified samplers need a square
    mean: np.ndarray = np.zeros(())
    square: np.ndarray = np.zeros(())
    for index in range(count):  # Welford's update avoids the cancellation of sums of squares
        image = render(per_pass, _mix(seed, 1000 + index)).astype(np.float64)
        step = image - mean
        mean = mean + step / (index + 1)
        square = square + step * (image - mean)
    record = dict(settings)
    record.update(
        spp=per_pass * count,
        passes=count,
        seed=seed,
        variant=mi.variant(),
        mitsuba=mi.__version__,
        filter="box",
        size=[int(width), int(height)],
    )
    if count > 1:
        error = np.sqrt(np.mean(square) / (count - 1) / count)
        record["relative_standard_error"] = float(error / max(float(np.mean(mean)), 1e-12))
    return Reference(np.asarray(mean, dtype=np.float32), record)


def has_masks(scene: mi.Scene) -> bool:
    """True if a shape (outside of shape groups) has a BSDF with straight transmission, such as `mask`."""
    bsdfs = (shape.bsdf() for shape in scene.shapes())
    return any(bsdf is not None and mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs)


def save(path: str | Path, reference: Reference, *, half: bool = False) -> None:
    """Write an EXR file with the settings in its header (JSON under `shadowmap_settings`). The write is atomic.

    Args:
        half: Store 16-bit floats: half the size, relative error up to 5e-4 per value.

    Raises:
        OutputError: The file cannot be written.
    """
    # Not with mi.Bitmap, which waits forever where Dr.Jit has a single thread.
    pixels = reference.image.astype(np.float16 if half else np.float32)
    names = images.colour_channels(pixels.shape[2])
    images.write_exr(path, {name: pixels[..., i] for i, name in enumerate(names)}, {SETTINGS_KEY: json.dumps(reference.settings)})


def load(path: str | Path) -> Reference:
    """Read a file that `save` has written; other EXR files have empty settings.

    Raises:
        ShadowmapError: The file does not exist, or is damaged.
    """
    if not Path(path).is_file():
        raise ShadowmapError(f"no file {str(path)!r}: make references with tests/support/references/make.py.")
    channels, metadata = images.read_exr(path)
    try:
        settings = json.loads(metadata.get(SETTINGS_KEY, "{}"))
        image = np.stack([channels[name] for name in images.colour_channels(len(channels))], -1).astype(np.float32)
    except (KeyError, ValueError) as error:
        raise ShadowmapError(f"cannot read {path}: its channels or settings are not those of a reference.") from error
    return Reference(image, settings)


def _mix(*numbers: int) -> int:
    """A 32-bit seed from several numbers: neighbouring Mitsuba seeds are correlated in some samplers."""
    return int(np.random.SeedSequence(numbers).generate_state(1)[0])


def _selection_weights(scene: mi.Scene) -> dict[str, float] | None:
    """Sampling weights of the lights by the names of their parameters, or None if not all lights are delta lights."""
    if not all(
        mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaPosition)
        or mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
        for emitter in scene.emitters()
    ):
        return None  # BSDF samples hit an extended emitter even in passes that do not sample it
    params = mi.traverse(scene)
    keys = [key for key in params.keys() if key.rpartition(".")[2] == "sampling_weight"]
    return {key: float(params[key]) for key in keys} if len(keys) == len(scene.emitters()) else None


@contextmanager
def _only(scene: mi.Scene, weights: dict[str, float], chosen: str) -> Iterator[None]:
    """Restrict emitter sampling to one light."""
    params = mi.traverse(scene)

    def assign(values: dict[str, float]) -> None:
        for key, value in values.items():
            params[key] = value
        params.update()

    assign({key: float(key == chosen) for key in weights})
    try:
        yield
    finally:
        assign(weights)
