"""References for derivative images: path-traced central differences, and Mitsuba's projective integrator."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ...errors import ShadowmapError
from ..common.meshes import Mesh
from . import scenes as gradients_scenes
from .images import Image
from .scenes import MOTIONS, Motion

#: Pixels along each side of Mitsuba's image, and width of the penumbra of its area light in these pixels. Hardly any sample of
#: the integrator would meet a light that is small enough for a penumbra of half a pixel.
MITSUBA_RESOLUTION, MITSUBA_PENUMBRA, _MITSUBA_SPPI = 128, 16.0, 256


@dataclass(frozen=True)
class Sampling:
    """Sample counts and step sizes of references.

    Attributes:
        resolution: pixels along each side of path-traced images.
        spp: their samples per pixel.
        folder: folder of stored references.
        reuse: use stored references of the same occluder and as many samples.
    """

    resolution: int
    spp: int
    folder: Path
    reuse: bool


def path_traced_derivative(mesh: Mesh, name: str, sampling: Sampling) -> tuple[Image, dict[str, Any]]:
    """Central difference (H, W, 1) of path-traced images by one of `MOTIONS`, and its settings.

    `halves_cosine` is the agreement of two independent halves of the samples (missing where the shadow does not move), `norm` the
    image's norm.
    """
    from mitsuba_baselines.derivatives import agreement, central_difference

    motion, half = MOTIONS[name], max(1, sampling.spp // 2)

    def make() -> tuple[Image, dict[str, Any]]:
        build = _builder(mesh, motion, sampling.resolution, "orthographic")
        step = motion.step(mesh, sampling.resolution)
        first, second = (central_difference(build, step, spp=half, seed=seed) for seed in (0, 1))
        image = 0.5 * (first.image + second.image)
        settings = first.settings | {"spp": 2 * half, "norm": float(np.linalg.norm(image))}
        if np.any(second.image):
            settings["halves_cosine"] = agreement(first.image, second.image).cosine
        return image, settings

    identity = {"mesh": _digest(mesh), "resolution": sampling.resolution, "spp": sampling.spp}
    return _kept(sampling.folder / f"{name}.exr", identity, sampling.reuse, make)


def projective_image(mesh: Mesh, name: str, sampling: Sampling, passes: int) -> tuple[Image, dict[str, Any]]:
    """Mitsuba's derivative image (h, w, 1) with an area light, and its settings.

    The settings hold its agreement with path-traced differences under parallel light (`agreement_directional`) and under the same
    area light (`agreement_area`).
    """
    from mitsuba_baselines.derivatives import agreement, central_difference
    from mitsuba_baselines.projective import projective_derivative
    from mitsuba_baselines.proxy import calibrate, with_proxy

    motion, size = MOTIONS[name], MITSUBA_RESOLUTION

    def make() -> tuple[Image, dict[str, Any]]:
        scene = gradients_scenes.build(mesh, size, "pinhole")
        proxy = calibrate(scene, receiver="receiver", casters=("occluder",), max_penumbra_px=MITSUBA_PENUMBRA)
        derivative = projective_derivative(
            with_proxy(scene, proxy), "occluder", motion.rate(mesh), sppi=_MITSUBA_SPPI, passes=passes
        )
        build = _builder(mesh, motion, size, "pinhole")
        results = {}
        for kind, maker in (("directional", build), ("area", lambda t: with_proxy(build(t), proxy))):
            reference = central_difference(maker, motion.step(mesh, size), spp=sampling.spp)
            results[f"agreement_{kind}"] = asdict(agreement(derivative.image, reference.image, MITSUBA_PENUMBRA))
        return derivative.image, derivative.settings | results | {"penumbra_px": proxy.penumbra_px, "resolution": size}

    identity = {"mesh": _digest(mesh), "passes": passes, "spp": sampling.spp}
    return _kept(sampling.folder / f"{name}-mitsuba.exr", identity, sampling.reuse, make)


def _builder(mesh: Mesh, motion: Motion, resolution: int, camera: str) -> Callable[[float], mi.Scene]:
    return lambda t: gradients_scenes.build(motion.moved(mesh, t), resolution, camera)


def _digest(mesh: Mesh) -> str:
    return hashlib.sha256(mesh.vertices.tobytes()).hexdigest()[:12]


def _kept(
    path: Path, identity: dict[str, Any], reuse: bool, make: Callable[[], tuple[Image, dict[str, Any]]]
) -> tuple[Image, dict[str, Any]]:
    """The result of ``make``, read from the file of an earlier run with the same identity if there is one."""
    from mitsuba_baselines import reference

    if reuse and path.exists():
        with suppress(ShadowmapError):  # a file that cannot be read is made again
            stored = reference.load(path)
            if stored.settings.get("identity") == identity:
                return np.atleast_3d(stored.image), stored.settings
    image, settings = make()
    settings = settings | {"identity": identity}
    reference.save(path, reference.Reference(image, settings))
    return image, settings
