"""The raster functions on PyTorch tensors: values and gradients, memory, graphs, errors."""

from __future__ import annotations

import threading
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from torch_scene import (  # noqa: E402
    BOX,
    FACES,
    VERTICES,
    assert_agrees_with_differences,
    clip,
    light_of,
    lit,
    receivers,
    refused,
    smooth_weights,
)

import shadowmap_dr.torch as sdr  # noqa: E402
from shadowmap_dr import raster  # noqa: E402
from shadowmap_dr.torch.bridge import drjit_turn  # noqa: E402

SIZE = (40, 48)


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")  # what the Dr.Jit side of comparisons is made of
    torch.set_num_threads(1)


def two_views() -> torch.Tensor:
    """Clip-space vertices of two images (2, V, 4)."""
    return torch.stack([clip(VERTICES), clip(VERTICES @ torch.tensor([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]))])


def drawn(positions: torch.Tensor, attributes: torch.Tensor) -> torch.Tensor:
    """Attributes of the box in anti-aliased images."""
    found = sdr.rasterize(positions, FACES, SIZE)
    return sdr.antialias(sdr.interpolate(attributes, found, FACES), found, positions, sdr.build_topology(FACES, VERTICES))


def drawn_by_drjit(positions: Any, attributes: Any) -> Any:
    faces, topology = mi.TensorXu(FACES.int()), raster.build_topology(BOX.faces, BOX.vertices, mi.UInt32)
    found = raster.rasterize(positions, faces, SIZE)
    image = raster.interpolate(attributes, found, faces)
    return raster.antialias(image, found, positions, topology)


def test_raster_is_that_of_drjit() -> None:
    positions = two_views()
    found = sdr.rasterize(positions, FACES, SIZE)
    expected = raster.rasterize(mi.TensorXf(positions), mi.TensorXu(FACES.int()), SIZE)
    triangle = expected.triangle.numpy().astype(np.int32).reshape(2, *SIZE)
    assert found.triangle.dtype == torch.int32 and np.array_equal(found.triangle, triangle)
    assert np.array_equal(found.covered, triangle >= 0) and 300 < found.covered.sum() < found.covered.numel() - 300
    for name in ("u", "v", "depth"):
        assert np.array_equal(getattr(found, name), getattr(expected, name).numpy().reshape(2, *SIZE)), name


def test_image_and_gradients_are_those_of_drjit() -> None:
    positions, attributes = two_views().requires_grad_(), torch.rand(len(VERTICES), 3).requires_grad_()
    image = drawn(positions, attributes)
    weights = smooth_weights(*image.shape)
    (weights * image).sum().backward()
    arrays = [mi.TensorXf(value.detach()) for value in (positions, attributes)]
    dr.enable_grad(arrays)
    expected = drawn_by_drjit(*arrays)
    dr.backward(dr.sum(expected * mi.TensorXf(weights.contiguous()), axis=None))
    assert image.shape == (2, *SIZE, 3) and np.array_equal(image.detach(), expected.numpy())
    for tensor, array in zip((positions, attributes), arrays, strict=True):
        gradient = dr.grad(array).numpy()
        assert np.abs(gradient).max() > 1
        np.testing.assert_allclose(tensor.grad, gradient, rtol=1e-4, atol=1e-4)


def test_positions_without_batch_are_one_image() -> None:
    one, two = (drawn(p, VERTICES) for p in (clip(VERTICES), two_views()))
    assert one.shape == (1, *SIZE, 3) and torch.equal(one[0], two[0])


def test_attributes_may_differ_between_images() -> None:
    attributes = torch.rand(2, len(VERTICES), 2)
    together = drawn(two_views(), attributes)
    for k in range(2):
        assert torch.equal(together[k], drawn(two_views()[k], attributes[k])[0])


def test_attributes_may_have_faces_of_their_own() -> None:
    found = sdr.rasterize(clip(VERTICES), FACES, SIZE)
    corners = VERTICES[FACES].reshape(-1, 3)  # one row for each corner
    own = torch.arange(len(corners)).reshape(-1, 3)
    assert torch.equal(sdr.interpolate(corners, found, own), sdr.interpolate(VERTICES, found, FACES))


@pytest.mark.parametrize("name", ["u", "v", "depth"])
def test_raster_gradients_agree_with_differences(name: str) -> None:
    """A triangle that covers the whole image: what is seen stays the same."""
    positions = torch.tensor([[-5.0, -4, 0.1, 1.2], [6, -4.5, 0.3, 1], [0.2, 7, 0.2, 1.5]])
    direction = torch.tensor([[0.3, -0.2, 0.5, 0.1], [-0.4, 0.3, 0.2, -0.2], [0.1, 0.5, -0.3, 0.3]])
    faces = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    assert_agrees_with_differences(
        lambda p: getattr(sdr.rasterize(p, faces, (16, 16)), name)[..., None], positions, direction, 1e-2, 1e-3
    )


def test_gradients_to_attributes_agree_with_differences() -> None:
    direction = torch.sin(torch.arange(VERTICES.numel())).reshape(VERTICES.shape)
    # Linear: any step will do.
    assert_agrees_with_differences(lambda attributes: drawn(clip(VERTICES), attributes), VERTICES, direction, 1.0, 1e-4)


def test_gradients_of_outlines_agree_with_differences() -> None:
    """A white box on black: all that changes is which pixels are covered, and by how much."""
    topology = sdr.build_topology(FACES, VERTICES)

    def coverage(vertices: torch.Tensor) -> torch.Tensor:
        positions = clip(vertices)
        found = sdr.rasterize(positions, FACES, (128, 128))
        return sdr.antialias(found.covered.float()[..., None], found, positions, topology)

    turned = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])
    for direction in (torch.tensor([1.0, 0.3, 0]).expand_as(VERTICES), VERTICES @ turned + VERTICES):
        assert_agrees_with_differences(coverage, VERTICES, direction, 0.01, 0.05)


def test_tensors_without_gradients_leave_no_graph() -> None:
    image = drawn(clip(VERTICES), VERTICES)
    assert not image.requires_grad and image.grad_fn is None
    with torch.no_grad():
        assert not drawn(clip(VERTICES).requires_grad_(), VERTICES).requires_grad


def test_only_what_wants_gradients_gets_them() -> None:
    attributes = VERTICES.clone().requires_grad_()
    positions = clip(VERTICES)
    drawn(positions, attributes).sum().backward()
    assert positions.grad is None and attributes.grad is not None


def test_second_backward_pass_is_like_the_first() -> None:
    positions, vertices = two_views().requires_grad_(), VERTICES.clone().requires_grad_()
    loss = drawn(positions, vertices).square().sum() + lit(vertices, light_of("spot"), receivers(20)).sum()
    first = torch.autograd.grad(loss, (positions, vertices), retain_graph=True)
    second = torch.autograd.grad(3 * loss, (positions, vertices))
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(3 * a, b, rtol=1e-3, atol=1e-4 * float(b.abs().max()))


def test_derivatives_of_derivatives_are_refused() -> None:
    positions = clip(VERTICES).requires_grad_()
    (gradient,) = torch.autograd.grad(drawn(positions, VERTICES).square().sum(), positions, create_graph=True)
    refused("rasterize: it has first derivatives only", lambda: gradient.sum().backward())


def test_a_tensor_may_be_given_twice() -> None:
    shared = VERTICES.clone().requires_grad_()
    drawn(clip(shared), shared).square().sum().backward()
    first, second = (VERTICES.clone().requires_grad_() for _ in range(2))
    drawn(clip(first), second).square().sum().backward()
    torch.testing.assert_close(shared.grad, first.grad + second.grad, rtol=1e-4, atol=1e-4)


def test_results_that_nobody_uses_have_no_gradient() -> None:
    positions = clip(VERTICES).requires_grad_()
    found = sdr.rasterize(positions, FACES, SIZE)
    found.u.sum().backward(retain_graph=True)
    alone, positions.grad = positions.grad, None
    (found.u.sum() + 0 * found.v.sum() + 0 * found.depth.sum()).backward()
    torch.testing.assert_close(alone, positions.grad, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("function", ["draw", "light"])
def test_tensors_may_change_in_place_between_the_passes(function: str) -> None:
    """An optimiser moves parameters whenever it likes; and images are often clamped in place."""

    def call(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        if function == "draw":
            return drawn(a, b)
        return lit(b, light_of("directional"), a)

    start = (two_views() if function == "draw" else receivers(20), VERTICES)
    undisturbed = [t.clone().requires_grad_() for t in start]
    call(*undisturbed).square().sum().backward()
    disturbed = [t.clone().requires_grad_() for t in start]
    result = call(*disturbed)
    loss = result.square().sum()
    with torch.no_grad():
        for tensor in disturbed:
            tensor.data.mul_(7)
        result.data.fill_(0)  # its square's gradient is 0 now: give the other one
    result.backward(2 * call(*start))
    assert loss > 1
    for a, b in zip(undisturbed, disturbed, strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-3, atol=1e-4 * float(a.grad.abs().max()))


def test_gradients_and_given_tensors_stay_as_they_are() -> None:
    positions, attributes = two_views(), VERTICES.clone()
    before = positions.clone(), attributes.clone()
    image = drawn(positions.requires_grad_(), attributes.requires_grad_())
    adjoint = torch.ones_like(image)
    image.backward(adjoint)
    assert torch.equal(adjoint, torch.ones_like(image))
    assert torch.equal(positions, before[0]) and torch.equal(attributes, before[1])


def test_any_strides_and_integers_will_do() -> None:
    expected = drawn(two_views(), VERTICES)
    strided = two_views().permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert not strided.is_contiguous() and torch.equal(drawn(strided, VERTICES.T.contiguous().T), expected)
    seen = sdr.rasterize(two_views(), FACES, SIZE).triangle
    for dtype in (torch.uint8, torch.int16, torch.int32):
        assert torch.equal(sdr.rasterize(two_views(), FACES.to(dtype), SIZE).triangle, seen)


def test_results_are_complete_when_they_are_returned() -> None:
    """Dr.Jit computes in the background: what PyTorch reads at once must be what it reads later."""
    positions = clip(VERTICES)
    found = sdr.rasterize(positions, FACES, (2048, 2048))
    at_once = (found.triangle.clone(), found.u.clone(), found.depth.clone())
    dr.sync_thread()
    assert all(torch.equal(a, b) for a, b in zip(at_once, (found.triangle, found.u, found.depth), strict=True))


def test_two_steps_of_an_optimiser_lower_the_loss() -> None:
    target = drawn(clip(VERTICES), VERTICES + 1)
    shadow_target = lit(VERTICES, light_of("spot"), receivers(40))
    vertices = torch.nn.Parameter(VERTICES * 1.1 + 0.05)
    optimiser = torch.optim.Adam([vertices], lr=0.01)
    losses = []
    for _ in range(3):
        optimiser.zero_grad()
        image, visible = drawn(clip(vertices), VERTICES + 1), lit(vertices, light_of("spot"), receivers(40))
        loss = (image - target).square().mean() + (visible - shadow_target).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[0] > losses[1] > losses[2]


def test_wrong_tensors_are_refused() -> None:
    p, faces = clip(VERTICES), FACES
    found, topology = sdr.rasterize(p, faces, SIZE), sdr.build_topology(faces, VERTICES)
    refused("positions: torch.float64, but must be torch.float32", lambda: sdr.rasterize(p.double(), faces, SIZE))
    refused("positions: ndarray, but must be a torch.Tensor", lambda: sdr.rasterize(p.numpy(), faces, SIZE))
    refused("positions: shape (8, 3), but must be (V, 4) or (B, V, 4)", lambda: sdr.rasterize(VERTICES, faces, SIZE))
    refused("positions: shape (0, 4) holds no numbers", lambda: sdr.rasterize(p[:0], faces, SIZE))
    refused("positions: torch.sparse_coo, but must be a dense tensor", lambda: sdr.rasterize(p.to_sparse(), faces, SIZE))
    refused("positions: on meta, but Dr.Jit computes on cpu and cuda only", lambda: sdr.rasterize(p.to("meta"), faces, SIZE))
    refused("faces: torch.float32, but must be integers", lambda: sdr.rasterize(p, faces.float(), SIZE))
    refused("faces: shape (12, 2), but must be (F, 3)", lambda: sdr.rasterize(p, faces[:, :2], SIZE))
    refused("resolution is 0 x 48", lambda: sdr.rasterize(p, faces, (0, 48)))
    refused("attributes: shape (3, 8, 3), but must be", lambda: sdr.interpolate(VERTICES.expand(3, 8, 3), found, faces))
    refused("faces: 11 instead of 12", lambda: sdr.interpolate(VERTICES, found, faces[1:]))
    image = torch.zeros(1, *SIZE, 3)
    refused("image: shape (1, 40, 47, 3), but must be (1, 40, 48, C)", lambda: sdr.antialias(image[:, :, 1:], found, p, topology))
    refused("positions: shape (7, 4), but must be", lambda: sdr.antialias(image, found, p[1:], topology))
    other = sdr.build_topology(faces[1:], VERTICES)
    refused("faces of topology: 11 instead of 12", lambda: sdr.antialias(image, found, p, other))


@pytest.mark.parametrize("bad", [-1, 8, 2**31 + 5, -(2**32)])
def test_indices_out_of_range_are_refused(bad: int) -> None:
    """Dr.Jit would read any memory with them."""
    faces = FACES.clone()
    faces[3, 1] = bad
    found = sdr.rasterize(clip(VERTICES), FACES, SIZE)
    refused("but there are 8 vertices", lambda: sdr.rasterize(clip(VERTICES), faces, SIZE))
    refused("but there are 8 vertices", lambda: sdr.build_topology(faces, VERTICES))
    refused("but there are 8 rows of attributes", lambda: sdr.interpolate(VERTICES, found, faces))
    refused("but there are 7 rows of attributes", lambda: sdr.interpolate(VERTICES[1:], found, FACES))


def test_threads_take_turns() -> None:
    """Dr.Jit's scopes count up across threads: two at once would get each other's."""
    inside = threading.Event()

    def other() -> None:
        with drjit_turn(torch.device("cpu")):
            inside.set()

    thread = threading.Thread(target=other)
    with drjit_turn(torch.device("cpu")), drjit_turn(torch.device("cpu")):  # one thread may enter twice
        thread.start()
        assert not inside.wait(0.3)
    assert inside.wait(30)
    thread.join()
