"""Batches of light estimation: images and derivatives of many runs at once are those of the renderer."""

from __future__ import annotations

import dataclasses
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.lights.scene import make_scene, target_and_starts
from shadowmap_dr.inverse import LightBatch, Stage, StillScene
from shadowmap_dr.rendering import shadow_pass
from shadowmap_dr.rendering.renderer import Renderer


def renderer(lights: int, resolution: int = 40, **settings: Any) -> Renderer:
    settings = {"shadow_map_resolution": 64, "shadow_method": "vsm", **settings}
    return Renderer.from_scene(make_scene("teapot", lights, resolution), **settings)


def directions(runs: int, lights: int) -> tuple[np.ndarray, np.ndarray]:
    """Targets and starts, far enough apart for all kinds of shadows."""
    pairs = [target_and_starts(5, run, lights, cone_deg=110) for run in range(runs)]
    return np.stack([target for target, _ in pairs]), np.stack([starts[0] for _, starts in pairs])


def reference(plain: Renderer, to_light: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Image, loss and derivatives (n, 3) of one run by the renderer itself."""
    plain.frusta = None  # as a batch, which fits its maps anew
    vectors = [mi.Vector3f(*(float(c) for c in direction)) for direction in to_light]
    dr.enable_grad(vectors)
    lights = {
        f"light_{k}": dataclasses.replace(plain.light(f"light_{k}"), direction=-dr.normalize(vector))
        for k, vector in enumerate(vectors)
    }
    image = plain.render(lights=lights)
    loss = dr.mean(dr.square(image.array - mi.Float(target.ravel())))
    dr.backward(loss)
    return np.array(dr.detach(image)), float(loss[0]), np.array([np.array(dr.grad(vector)).ravel() for vector in vectors])


@pytest.mark.parametrize(
    ("lights", "settings"),
    [
        (2, {}),
        (1, {"shadow_method": "evsm4", "shadow_filter": "box", "shadow_filter_size": 5}),
        (1, {"shadow_method": "esm", "shadow_supersampling": 2, "shadow_map_resolution": 32}),
        (1, {"shadow_method": "msm", "shadow_filter": "none", "shadow_antialias": False, "antialias": False}),
        (3, {"shadow_method": "none"}),
    ],
    ids=["vsm", "evsm4", "esm", "msm", "none"],
)
def test_images_and_derivatives_are_the_renderers(
    lights: int, settings: dict[str, Any], variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A batch turns its lights about the world's origin. The renderer's axes would leave surfaces in place: another sum of errors.
    monkeypatch.setattr(shadow_pass, "steady_axes", lambda views, *_: views)
    plain = renderer(lights, **settings)
    batch = LightBatch(StillScene.of(plain))
    targets, starts = directions(3, lights)
    wanted, images = batch.render(targets), batch.render(starts)
    losses, gradients = batch.loss_and_gradient(starts, wanted)
    for run in range(3):
        image, loss, gradient = reference(plain, starts[run], wanted[run])
        # A pixel's centre on an edge may fall to either side.
        assert np.quantile(np.abs(images[run] - image), 0.999) < 2e-4
        assert losses[run] == pytest.approx(loss, rel=1e-3)
        # Unnormalised exponentials differ in their last digits.
        assert np.abs(gradients[run] - gradient).max() < 5e-3 * np.abs(gradient).max()


def test_derivatives_are_central_differences() -> None:
    mi.set_variant("llvm_ad_rgb")
    batch = LightBatch(StillScene.of(renderer(2, 48, shadow_map_resolution=128, shadow_filter_size=9)))
    targets, starts = directions(4, 2)
    wanted = batch.render(targets)
    _, gradients = batch.loss_and_gradient(starts, wanted)
    step, differences = 0.02, np.zeros_like(gradients)
    for light in range(2):
        for axis in range(3):
            offset = np.zeros((2, 3))
            offset[light, axis] = step
            ahead, behind = (batch.loss_and_gradient(starts + sign * offset, wanted)[0] for sign in (1, -1))
            differences[:, light, axis] = (ahead - behind) / (2 * step)
    cosine = (gradients * differences).sum() / np.linalg.norm(gradients) / np.linalg.norm(differences)
    assert cosine > 0.99
    assert np.linalg.norm(gradients) == pytest.approx(np.linalg.norm(differences), rel=0.1)


def test_runs_do_not_depend_on_their_batch_recorded() -> None:
    mi.set_variant("llvm_ad_rgb")
    batch = LightBatch(StillScene.of(renderer(1)))
    targets, starts = directions(6, 1)
    wanted = batch.render(targets)
    together = batch.run(starts, wanted, (Stage(40, None, 0.03),))
    apart = [batch.run(starts[a:b], wanted[a:b], (Stage(40, None, 0.03),)) for a, b in ((0, 1), (1, 6))]
    final = np.concatenate([history.directions[-1] for history in apart])
    dots = (final * together.directions[-1]).sum(-1)
    assert (1 - dots < 1e-3).mean() >= 0.99
    assert np.allclose(together.losses[0], np.concatenate([history.losses[0] for history in apart]), rtol=1e-4)


def test_a_step_is_recorded_once_for_a_filter_and_runs_find_their_targets() -> None:
    mi.set_variant("llvm_ad_rgb")
    batch = LightBatch(StillScene.of(renderer(1)))
    pairs = [target_and_starts(3, run, 1) for run in range(4)]
    targets, starts = np.stack([t for t, _ in pairs]), np.stack([s[0] for _, s in pairs])
    seen: list[int] = []
    history = batch.run(starts, batch.render(targets), (Stage(30, 9, 0.05), Stage(40, 3, 0.01)), seen.append)
    assert seen == list(range(1, 71)) and history.losses.shape == (70, 4)
    assert ((history.directions[-1] * targets).sum(-1) > 0.999).all()
    assert np.allclose(np.linalg.norm(history.directions, axis=-1), 1, atol=1e-5)
    # First calls differ in how the arrays that they are given came to be; soon nothing new is recorded.
    recordings = []
    for _ in range(4):
        batch.run(starts, batch.render(targets), (Stage(4, 9, 0.05), Stage(4, 3, 0.01)))
        recordings.append(batch.recordings())
    assert recordings[-1] == recordings[-2] == recordings[-3] <= 6


def test_what_batches_do_not_know_is_named() -> None:
    mi.set_variant("llvm_ad_rgb")
    scene = {
        "type": "scene",
        "camera": {"type": "perspective", "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}},
        "ball": {"type": "sphere", "bsdf": {"type": "roughplastic"}},
        "sun": {"type": "directional", "direction": [0, 0, -1]},
    }

    def build(**changes: Any) -> StillScene:
        return StillScene.of(Renderer.from_scene(mi.load_dict({**scene, **changes}, optimize=False)))

    with pytest.raises(ShadowmapError, match="gloss"):
        build()
    matte = {"type": "sphere", "bsdf": {"type": "diffuse"}}
    with pytest.raises(ShadowmapError, match="'lamp' is a PointLight"):
        build(ball=matte, lamp={"type": "point", "position": [0, 3, 0], "id": "lamp"})
    with pytest.raises(ShadowmapError, match="box filter"):
        film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "gaussian"}}
        build(ball=matte, camera={"type": "perspective", "film": film})
    with pytest.raises(ShadowmapError, match="pcf"):
        StillScene.of(renderer(1, 8, shadow_method="pcf"))
    batch = LightBatch(StillScene.of(renderer(2, 8)))
    with pytest.raises(ShadowmapError, match=r"\(R, 2, 3\)"):
        batch.render(np.ones((4, 3)))
    with pytest.raises(ShadowmapError, match="no length"):
        batch.render(np.zeros((1, 2, 3)))
    with pytest.raises(ShadowmapError, match=r"\(1, 8, 8, 3\)"):
        batch.run(np.ones((1, 2, 3)), np.zeros((1, 4, 4, 3)))
