"""``torch.func`` and ``torch.compile`` around the functions on PyTorch tensors."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from torch_scene import DIRECTION, FACES, SETTINGS, VERTICES, clip, light_of, lit, receivers, refused, smooth_weights  # noqa: E402

import shadowmap_dr.torch as sdr  # noqa: E402

SIZE = (40, 48)
SIDEWAYS = torch.tensor([1.0, 0.3, 0]).expand_as(VERTICES)
Function = Callable[[torch.Tensor], torch.Tensor]


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def renderer() -> sdr.Renderer:
    mi.set_variant("llvm_ad_rgb")
    ball = {"type": "sphere", "radius": 0.5, "to_world": mi.ScalarTransform4f().translate([0, 0, 0.9])}
    film = {"type": "hdrfilm", "width": 128, "height": 128, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    view = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    scene = {
        "type": "scene",
        "ball": ball,
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "camera": {"type": "perspective", "fov": 45, "to_world": view, "film": film},
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1]},
    }
    return sdr.Renderer.from_dict(scene, tessellation=24, shadow_map_resolution=128, shadow_filter_size=5, shadow_samples=1)


def image(vertices: torch.Tensor) -> torch.Tensor:
    """Colours and coverage of the box in an anti-aliased image: all raster functions."""
    positions = clip(vertices)
    found = sdr.rasterize(positions, FACES, (128, 128))
    topology = sdr.build_topology(FACES, vertices)
    colours = torch.cat([sdr.interpolate(VERTICES + 1, found, FACES), found.covered[..., None].float()], -1)
    return sdr.antialias(colours, found, positions, topology, continued=True)


def shadow(vertices: torch.Tensor) -> torch.Tensor:
    """All functions of shadow maps."""
    topology = sdr.build_topology(FACES, VERTICES)
    lights = [light_of("spot"), sdr.DirectionalLight(DIRECTION)]
    settings = replace(SETTINGS, filter_size=9, resolution=256)
    first = sdr.render_maps(VERTICES, topology, lights, settings, seen=receivers(20))
    maps = sdr.filter_maps(sdr.render_maps(vertices, topology, lights, settings, previous=first))
    return sdr.visibility(maps, receivers(200), 1)[None, ..., None]


def scalar(function: Function) -> Function:
    def weighted(vertices: torch.Tensor) -> torch.Tensor:
        value = function(vertices)
        return (smooth_weights(*value.shape) * value).sum()

    return weighted


def slope(function: Function, at: torch.Tensor, step: float = 0.01) -> torch.Tensor:
    with torch.no_grad():
        return (function(at + step * SIDEWAYS).double() - function(at - step * SIDEWAYS).double()) / (2 * step)


@pytest.mark.parametrize("function", [image, shadow])
def test_grad_and_vjp_are_those_of_backward_passes(function: Function) -> None:
    vertices = VERTICES.clone().requires_grad_()
    (expected,) = torch.autograd.grad(scalar(function)(vertices), vertices)
    found, value = torch.func.grad_and_value(scalar(function))(VERTICES)
    assert expected.abs().max() > 0.1
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))
    torch.testing.assert_close(value, scalar(function)(VERTICES))
    _, back = torch.func.vjp(function, VERTICES)
    torch.testing.assert_close(back(smooth_weights(*value_shape(function)))[0], found, rtol=1e-3, atol=1e-3)


def value_shape(function: Function) -> tuple[int, ...]:
    return tuple(function(VERTICES).shape)


@pytest.mark.parametrize("function", [image, shadow])
def test_jvp_agrees_with_differences(function: Function) -> None:
    value, rate = torch.func.jvp(function, (VERTICES,), (SIDEWAYS.contiguous(),))
    torch.testing.assert_close(value, function(VERTICES))
    expected = float((smooth_weights(*rate.shape) * slope(function, VERTICES)).sum())
    found = float((smooth_weights(*rate.shape) * rate).sum())
    assert abs(expected) > 0.1 and abs(found - expected) < 0.08 * abs(expected), (found, expected)
    gradient = torch.func.grad(scalar(function))(VERTICES)
    assert found == pytest.approx(float((gradient * SIDEWAYS).sum()), rel=1e-3)


def test_forward_mode_outside_of_torch_func_is_the_same() -> None:
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(VERTICES, SIDEWAYS.contiguous())
        rate = torch.autograd.forward_ad.unpack_dual(image(dual)).tangent
    torch.testing.assert_close(rate, torch.func.jvp(image, (VERTICES,), (SIDEWAYS.contiguous(),))[1], rtol=1e-3, atol=1e-3)


def test_jacobians_forward_and_in_reverse_are_equal() -> None:
    def means(offset: torch.Tensor) -> torch.Tensor:
        return image(VERTICES + offset).mean((0, 1, 2))

    offset = torch.tensor([0.02, 0.01, 0.03])
    forward, reverse = (jacobian(means)(offset) for jacobian in (torch.func.jacfwd, torch.func.jacrev))
    assert forward.shape == (4, 3) and forward.abs().max() > 0.05
    torch.testing.assert_close(forward, reverse, rtol=1e-3, atol=1e-4)
    for column, axis in enumerate(torch.eye(3)):
        expected = (means(offset + 0.02 * axis) - means(offset - 0.02 * axis)) / 0.04
        np.testing.assert_allclose(forward[:, column], expected, atol=0.01)


def test_second_derivatives_are_refused() -> None:
    """Not zero, though the loss is linear in the image."""
    total = scalar(lambda vertices: sdr.rasterize(clip(vertices), FACES, SIZE).depth[..., None])
    hint = "rasterize: it has first derivatives only"
    refused(hint, lambda: torch.func.hessian(total)(VERTICES))
    refused(hint, lambda: torch.func.jacrev(torch.func.jacrev(total))(VERTICES))
    refused(hint, lambda: torch.func.jvp(torch.func.grad(total), (VERTICES,), (VERTICES,)))


def test_vmap_is_a_loop_where_it_works(renderer: sdr.Renderer) -> None:
    points = torch.stack([receivers(20), receivers(20, z=-1.2)])
    together = torch.vmap(lambda p: lit(VERTICES, light_of("spot"), p))(points)
    torch.testing.assert_close(together, torch.stack([lit(VERTICES, light_of("spot"), p) for p in points]))
    found = sdr.rasterize(clip(VERTICES), FACES, SIZE)
    attributes = torch.rand(3, len(VERTICES), 2)
    several = torch.vmap(lambda a: sdr.interpolate(a, found, FACES))(attributes)
    for own, one in zip(attributes, several, strict=True):
        torch.testing.assert_close(one, sdr.interpolate(own, found, FACES))
    rest = renderer.vertices("ball")
    moved = torch.stack([rest, rest + 0.1])
    images = torch.vmap(lambda v: renderer.render({"ball": v}))(moved)
    for own, one in zip(moved, images, strict=True):
        torch.testing.assert_close(one, renderer.render({"ball": own}), rtol=1e-3, atol=1e-3)
    assert (images[0] - images[1]).abs().max() > 0.1


def test_gradients_within_vmap_are_those_of_a_loop(renderer: sdr.Renderer) -> None:
    rest = renderer.vertices("ball")

    def loss(offset: torch.Tensor) -> torch.Tensor:
        return renderer.render({"ball": rest + offset}).square().sum()

    offsets = torch.tensor([[0.0, 0, 0], [0.1, -0.05, 0.1]])
    found = torch.vmap(torch.func.grad(loss))(offsets)
    for offset, gradient in zip(offsets, found, strict=True):
        expected = torch.func.grad(loss)(offset)
        assert expected.abs().max() > 1
        torch.testing.assert_close(gradient, expected, rtol=0.01, atol=0.01 * float(expected.abs().max()))


def test_jacobians_within_vmap_are_those_of_a_loop(renderer: sdr.Renderer) -> None:
    rest = renderer.vertices("ball")

    def means(offset: torch.Tensor) -> torch.Tensor:
        return renderer.render({"ball": rest + offset}).reshape(4, -1).mean(1)

    offsets = torch.tensor([[0.0, 0, 0], [0.1, -0.05, 0.1]])
    for jacobian in (torch.func.jacrev, torch.func.jacfwd):
        found = torch.vmap(jacobian(means))(offsets)
        expected = torch.stack([jacobian(means)(offset) for offset in offsets])
        assert found.shape == (2, 4, 3) and found.abs().max() > 1e-3
        torch.testing.assert_close(found, expected, rtol=0.01, atol=0.01 * float(expected.abs().max()))


def test_derivatives_leave_no_graph_behind(renderer: sdr.Renderer, capfd: pytest.CaptureFixture[str]) -> None:
    """Dr.Jit never frees some of those that are dropped; when the process ends, it would crash on them."""

    def nodes() -> int:
        gc.collect()
        capfd.readouterr()
        dr.whos_ad()
        return len(capfd.readouterr().out.splitlines())

    rest, before = renderer.vertices("ball"), nodes()
    for function, at in ((image, VERTICES), (shadow, VERTICES), (lambda v: renderer.render({"ball": v}), rest)):
        torch.func.jvp(function, (at,), (torch.ones_like(at),))
        torch.func.grad(lambda v, own=function: own(v).sum())(at)
    assert nodes() == before


def test_vmap_is_refused_where_it_does_not_work() -> None:
    two = torch.stack([clip(VERTICES)] * 2)
    topology = sdr.build_topology(FACES, VERTICES)
    refused(
        "positions: torch.vmap cannot batch it; give positions (B, V, 4), one set for each image",
        lambda: torch.vmap(lambda p: sdr.rasterize(p, FACES, SIZE).depth)(two),
    )
    refused(
        "faces: torch.vmap cannot batch it; give indices",
        lambda: torch.vmap(lambda f: sdr.rasterize(clip(VERTICES), f, SIZE).depth)(torch.stack([FACES] * 2)),
    )
    refused(
        "render_maps: torch.vmap cannot batch it; make maps",
        lambda: torch.vmap(lambda v: sdr.render_maps(v, topology, light_of("spot"), SETTINGS).values)(
            torch.stack([VERTICES] * 2)
        ),
    )
    refused(
        "lights[0].direction: torch.vmap cannot batch it",
        lambda: torch.vmap(lambda d: lit(VERTICES, sdr.DirectionalLight(d), receivers(9)))(torch.stack([DIRECTION] * 2)),
    )


def test_renderer_in_torch_func(renderer: sdr.Renderer) -> None:
    rest = renderer.vertices("ball")

    def total(offset: torch.Tensor) -> torch.Tensor:
        value = renderer.render({"ball": rest + offset}, {"sun": {"direction": torch.tensor([0.4, 0.3, -1])}})
        return (smooth_weights(*value.shape) * value).sum()

    at, axis = torch.zeros(3), torch.tensor([1.0, 0.4, 0.2])
    total(at)
    expected = float(total(at + 0.01 * axis) - total(at - 0.01 * axis)) / 0.02
    gradient = torch.func.grad(total)(at)
    _, rate = torch.func.jvp(total, (at,), (axis,))
    assert abs(expected) > 1
    assert float(gradient @ axis) == pytest.approx(expected, rel=0.08) and float(rate) == pytest.approx(expected, rel=0.08)


@pytest.mark.parametrize(("backend", "names"), [("eager", ("image", "shadow", "rendered")), ("aot_eager", ("image",))])
def test_compiled_functions_are_the_same(renderer: sdr.Renderer, backend: str, names: tuple[str, ...]) -> None:
    def rendered(vertices: torch.Tensor) -> torch.Tensor:
        moved = renderer.vertices("ball") + vertices.mean(0)
        assert len(renderer.faces("ball"))
        return renderer.render({"ball": moved}, {"sun": {"direction": DIRECTION}})[None] * 2

    functions = {"image": image, "shadow": shadow, "rendered": rendered}
    for function in (functions[name] for name in names):
        torch.compiler.reset()
        compiled = torch.compile(scalar(function), backend=backend)
        expected, found = (VERTICES.clone().requires_grad_() for _ in range(2))
        value, other = scalar(function)(expected), compiled(found)
        value.backward()
        other.backward()
        torch.testing.assert_close(other, value, rtol=1e-4, atol=1e-4)
        scale = float(expected.grad.abs().max())
        assert scale > 0.05
        torch.testing.assert_close(found.grad, expected.grad, rtol=1e-3, atol=1e-3 * scale)


def test_renderer_itself_may_be_compiled(renderer: sdr.Renderer) -> None:
    vertices = renderer.vertices("ball")
    found = torch.compile(renderer.render, backend="eager")({"ball": vertices})
    torch.testing.assert_close(found, renderer.render({"ball": vertices}), rtol=1e-4, atol=1e-4)
