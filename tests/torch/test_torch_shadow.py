"""Shadow maps on PyTorch tensors."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

import shadow_scene  # noqa: E402
from torch_scene import (  # noqa: E402
    BOX,
    DIRECTION,
    FACES,
    POSITION,
    SETTINGS,
    VERTICES,
    assert_agrees_with_differences,
    light_of,
    lit,
    made,
    receivers,
    refused,
    smooth_weights,
)

import shadowmap_dr.torch as sdr  # noqa: E402
from shadowmap_dr import ShadowSettings, shadow  # noqa: E402


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")  # what the Dr.Jit side of comparisons is made of
    torch.set_num_threads(1)


@pytest.mark.parametrize("method", ["vsm", "evsm4", "msm", "csm", "standard", "pcf"])
def test_visibility_is_that_of_drjit(method: str) -> None:
    settings = replace(SETTINGS, method=method)
    vertices, direction, points = (t.clone().requires_grad_() for t in (VERTICES, DIRECTION, receivers(30)))
    visible = sdr.visibility(made(vertices, sdr.DirectionalLight(direction), settings), points)
    weights = smooth_weights(30, 30, 1)[..., 0]
    if method != "standard":
        (weights * visible).sum().backward()

    p = [mi.TensorXf(t.detach()) for t in (VERTICES, DIRECTION, receivers(30))]
    dr.enable_grad(p)
    world, towards, at = (dr.unravel(mi.Point3f, t.array) for t in p)
    maps = shadow_scene.make_maps([shadow.directional_view(mi.Vector3f(towards))], world, BOX.vertices, BOX.faces, settings)
    expected = shadow.visibility(maps, 0, at)
    np.testing.assert_allclose(visible.detach().ravel(), expected.numpy(), atol=1e-5)
    assert 30 < (visible < 0.5).sum() < 850
    if method != "standard":
        dr.backward(dr.sum(expected * mi.Float(weights.contiguous().ravel())))
        for tensor, array in zip((vertices, direction, points), p, strict=True):
            gradient = dr.grad(array).numpy()
            np.testing.assert_allclose(tensor.grad, gradient, rtol=1e-3, atol=2e-3 * np.abs(gradient).max())


def moving(kind: str, **given: torch.Tensor) -> torch.Tensor:
    """Visibility on a wall, with a fit of the maps that stays."""
    # Penumbrae wider than the distance between receivers, which sample them.
    size, taps = {"directional": (256, 9), "point": (512, 31)}.get(kind, (512, 9))
    settings = replace(SETTINGS, filter_size=taps, resolution=size)
    vertices = given.pop("vertices", VERTICES)
    maps = made(vertices, light_of(kind, **given), settings, made(VERTICES, light_of(kind), settings))
    return sdr.visibility(maps, receivers(200))[..., None]


@pytest.mark.parametrize("kind", ["directional", "spot", "wide spot", "point"])
def test_gradients_to_casters_agree_with_differences(kind: str) -> None:
    direction = torch.tensor([1.0, 0.4, 0.2]).expand_as(VERTICES)
    assert_agrees_with_differences(lambda v: moving(kind, vertices=v), VERTICES, direction, 0.02, 0.05)


@pytest.mark.parametrize("kind", ["directional", "spot", "point"])
def test_gradients_to_lights_agree_with_differences(kind: str) -> None:
    sideways = torch.tensor([1.0, 0.5, 0])
    if kind == "directional":
        assert_agrees_with_differences(lambda d: moving(kind, direction=d), DIRECTION, sideways, 0.01, 0.08)
    else:
        assert_agrees_with_differences(lambda p: moving(kind, position=p), POSITION, sideways, 0.02, 0.08)


def test_gradients_through_maps_and_axes_add_up() -> None:
    """Many times: what Dr.Jit does wrong without our help comes and goes."""
    weights, points = smooth_weights(200, 200, 1)[..., 0], receivers(200)

    def gradient(maps: sdr.ShadowMaps, position: torch.Tensor) -> torch.Tensor:
        visible = sdr.visibility(maps, points)
        return torch.autograd.grad((weights * visible).sum(), position, retain_graph=True)[0]

    for _ in range(12):
        position = POSITION.clone().requires_grad_()
        maps = made(VERTICES, light_of("spot", position))
        both = gradient(maps, position)
        first = gradient(replace(maps, axes=maps.axes.detach()), position)
        second = gradient(replace(maps, values=maps.values.detach()), position)
        assert first.abs().min() > 1 and second.abs().min() > 1
        torch.testing.assert_close(both, first + second, rtol=1e-3, atol=1e-3 * float(first.abs().max()))


def test_gradients_to_receivers_agree_with_differences() -> None:
    points = receivers(200)
    direction = torch.tensor([1.0, 0.7, 0]).expand_as(points)
    assert_agrees_with_differences(lambda p: lit(VERTICES, light_of("spot"), p)[..., None], points, direction, 0.01, 0.03)


def test_lights_of_one_batch_are_those_by_themselves() -> None:
    topology, points = sdr.build_topology(FACES, VERTICES), receivers(20)
    kinds = ["point", "directional", "wide spot", "spot"]
    maps = sdr.filter_maps(sdr.render_maps(VERTICES, topology, [light_of(kind) for kind in kinds], SETTINGS))
    assert maps.first == (0, 6, 7, 13) and maps.values.shape == (14, 64, 64, 4) and maps.axes.shape == (4, 14, 3)
    for k, kind in enumerate(kinds):
        torch.testing.assert_close(sdr.visibility(maps, points, k), lit(VERTICES, light_of(kind), points))


def test_fit_of_the_step_before_is_kept() -> None:
    topology = sdr.build_topology(FACES, VERTICES)
    first = sdr.render_maps(VERTICES, topology, light_of("directional"), SETTINGS)
    moved = VERTICES + 0.002
    kept = sdr.render_maps(moved, topology, light_of("directional"), SETTINGS, previous=first)
    anew = sdr.render_maps(moved, topology, light_of("directional"), SETTINGS)
    assert dr.all(kept._frusta.center_x == first._frusta.center_x) and not dr.all(anew._frusta.center_x == first._frusta.center_x)


def test_maps_leave_out_what_casts_its_shadow_elsewhere() -> None:
    topology, seen = sdr.build_topology(FACES, VERTICES), receivers(20, half=0.1)
    whole, part = (sdr.render_maps(VERTICES, topology, light_of("directional"), SETTINGS, seen=s) for s in (None, seen))
    assert part._frusta.half_x[0] < 0.7 * whole._frusta.half_x[0]


def test_wrong_shadows_are_refused() -> None:
    topology = sdr.build_topology(FACES, VERTICES)
    maps = sdr.render_maps(VERTICES, topology, light_of("spot"), SETTINGS)
    refused("light: 1, but there are 1 lights", lambda: sdr.visibility(maps, receivers(3), 1))
    refused("light: -1, but there are 1 lights", lambda: sdr.visibility(maps, receivers(3), -1))
    refused("points: shape (3, 2), but must be (..., 3)", lambda: sdr.visibility(maps, torch.zeros(3, 2)))
    refused("maps.values: shape", lambda: sdr.visibility(replace(maps, values=maps.values[:, 1:]), receivers(3)))
    refused("vertices: shape (7, 3), but must be (8, 3)", lambda: sdr.render_maps(VERTICES[1:], topology, light_of("spot")))
    refused("lights: an empty list", lambda: sdr.render_maps(VERTICES, topology, []))
    refused("lights[0]: Tensor, but must be a light", lambda: sdr.render_maps(VERTICES, topology, DIRECTION))
    zero = sdr.DirectionalLight(torch.zeros(3))
    refused("lights[0].direction: [0.0, 0.0, 0.0]; give", lambda: sdr.render_maps(VERTICES, topology, zero))
    wide = sdr.SpotLight(POSITION, DIRECTION, 200.0)
    refused("lights[0].cutoff_angle: 200.0", lambda: sdr.render_maps(VERTICES, topology, wide))
    learned = sdr.SpotLight(POSITION, DIRECTION, torch.tensor(40.0, requires_grad=True))
    refused("lights[0].cutoff_angle: Tensor, but must be float", lambda: sdr.render_maps(VERTICES, topology, learned))
    refused("topology: Tensor, but must be Topology", lambda: sdr.render_maps(VERTICES, FACES, light_of("spot")))
    refused("settings: dict, but must be ShadowSettings", lambda: sdr.render_maps(VERTICES, topology, light_of("spot"), {}))
    refused("light: float, but must be int", lambda: sdr.visibility(maps, receivers(3), 0.5))
    refused("maps: Tensor, but must be ShadowMaps", lambda: sdr.visibility(maps.values, receivers(3)))
    none = ShadowSettings(method="none")
    refused("the method 'none'", lambda: sdr.render_maps(VERTICES, topology, light_of("spot"), none))
    two = [light_of("spot"), light_of("point")]
    refused("maps of previous: 1 instead of 7", lambda: sdr.render_maps(VERTICES, topology, two, SETTINGS, previous=maps))
