"""Direct light without shadows: reference images for shading.

Importing this module registers the integrator `direct_unshadowed` in the current variant and in all variants that are set later.

Conventions for cases that a shadow ray would decide:

- A light in front of the shading normal but behind the geometric normal (or the other way round) contributes nothing: on a
  closed surface its shadow ray would hit the surface itself. Viewer and light must be on the same side of the geometric normal
  if and only if they are on the same side of the shading normal; this covers transmission and two-sided materials, too.
  `geometric_gate = False` disables this test.
- Camera rays pass through masks, weighted by their transparency.
- Environments (`constant`, `envmap`) neither light the scene nor appear in the background.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from shadowmap_dr.errors import ShadowmapError

from .reference import Reference, accumulate, has_masks

NAME = "direct_unshadowed"
MAX_LAYERS = 8
"""Transparent surfaces that one camera ray may pass."""


def unshadowed(
    scene: mi.Scene,
    *,
    spp: int = 64,
    seed: int = 0,
    sensor: int = 0,
    geometric_gate: bool = True,
    hide_emitters: bool = False,
) -> Reference:
    """Render a scene's direct light without shadow rays.

    Every light is evaluated at every sample (none is chosen at random), with the same `sample_direction` and `bsdf.eval` as
    `direct`. With delta lights, the positions within the pixel are the only source of noise; area lights are sampled.

    Args:
        scene: Scene whose film has a box filter.
        spp: Samples per pixel; protocol: 64 or more.
        seed, sensor: As in `reference.path_traced`.
        geometric_gate: See the module's description.
        hide_emitters: Show black instead of visible area lights.

    Returns:
        The reference, (H, W, C) float32. No gradients.

    Raises:
        ShadowmapError: The film's filter is not a box, or spp < 1.
    """
    register()
    integrator = mi.load_dict({"type": NAME, "geometric_gate": geometric_gate, "hide_emitters": hide_emitters})

    def render(samples: int, pass_seed: int) -> np.ndarray:
        return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=samples, seed=pass_seed))

    settings: dict[str, Any] = {
        "kind": "unshadowed",
        "integrator": NAME,
        "geometric_gate": geometric_gate,
        "hide_emitters": hide_emitters,
        "sensor": sensor,
    }
    return accumulate(scene, render, settings, spp=spp, seed=seed, sensor=sensor)


def register() -> None:
    """Register `direct_unshadowed` in the current variant, unless it is registered."""
    variant = mi.variant()
    if variant is None or not variant.startswith(("llvm", "cuda")) or variant.endswith("polarized"):
        return
    try:
        mi.load_dict({"type": NAME})
    except RuntimeError:
        mi.register_integrator(NAME, _integrator_class())


def _integrator_class() -> type:
    """Make the integrator's class. Its base class depends on the variant, and exists only once a variant is set."""

    class DirectUnshadowed(mi.SamplingIntegrator):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.gate = props.get("geometric_gate", True)
            self.show_emitters = not props.get("hide_emitters", False)

        def sample(self, scene, sampler, ray, medium=None, active=True):  # noqa: ANN001, ANN202 (Mitsuba's interface)
            radiance, throughput = mi.Spectrum(0), mi.Spectrum(1)
            ray, active = mi.RayDifferential3f(ray), mi.Bool(active)
            hit = mi.Bool(False)
            lights = [
                emitter
                for emitter in scene.emitters()
                if not mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite)
                or mi.has_flag(emitter.flags(), mi.EmitterFlags.DeltaDirection)
            ]
            layers = MAX_LAYERS if has_masks(scene) else 1
            for layer in range(layers):
                si = scene.ray_intersect(ray, active)
                active &= si.is_valid()
                hit |= active
                if self.show_emitters:
                    radiance += dr.select(active, throughput * si.emitter(scene).eval(si, active), 0)
                bsdf = si.bsdf(ray)
                for light in lights:
                    radiance += throughput * self.reflected(si, bsdf, light, sampler, active)
                if layer + 1 < layers:
                    throughput *= dr.select(active, bsdf.eval_null_transmission(si, active), 0)
                    active &= dr.any(throughput > 0)
                    ray = mi.RayDifferential3f(si.spawn_ray(ray.d))
            return radiance, hit, []

        def reflected(self, si, bsdf, light, sampler, active):  # noqa: ANN001, ANN202
            """Light of one emitter that the surface reflects towards the viewer."""
            ds, weight = light.sample_direction(si, sampler.next_2d(active), active)
            active = active & (ds.pdf > 0)
            wo = si.to_local(ds.d)
            value = bsdf.eval(mi.BSDFContext(), si, wo, active) * weight
            if self.gate:
                same_side_shading = mi.Frame3f.cos_theta(wo) * mi.Frame3f.cos_theta(si.wi) > 0
                same_side_geometry = dr.dot(si.n, ds.d) * dr.dot(si.n, si.to_world(si.wi)) > 0
                active &= same_side_shading == same_side_geometry
            return dr.select(active, value, 0)

        def to_string(self) -> str:
            return f"{NAME}[geometric_gate={self.gate}]"

    return DirectUnshadowed


def _on_variant(old: str | None, new: str | None) -> None:
    del old
    if new is not None:
        register()


try:
    mi.detail.add_variant_callback(_on_variant)
except AttributeError as error:
    raise ShadowmapError("this Mitsuba has no mi.detail.add_variant_callback: install mitsuba 3.9 or later.") from error
register()
