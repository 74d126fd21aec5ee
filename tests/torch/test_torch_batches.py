"""Images of different meshes, and alpha tests, on PyTorch tensors."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from torch_scene import FACES, VERTICES, clip, light_of, refused, smooth_weights  # noqa: E402

import shadowmap_dr.torch as sdr  # noqa: E402
from shadowmap_dr import raster  # noqa: E402

SIZE = (40, 48)
# Seven of the box's faces, and seven others.
SETS = torch.stack([FACES[:7], FACES[5:]])
RANGES = ((0, 7), (5, 7))


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")
    torch.set_num_threads(1)


def drawn(
    positions: torch.Tensor, attributes: torch.Tensor, faces: torch.Tensor, **ranges: Any
) -> tuple[torch.Tensor, sdr.Raster]:
    found = sdr.rasterize(positions, faces, SIZE, **ranges)
    topology = sdr.build_topology(faces, VERTICES, **ranges)
    return sdr.antialias(sdr.interpolate(attributes, found, faces), found, positions, topology), found


def inputs(batched: bool) -> tuple[torch.Tensor, torch.Tensor]:
    positions = clip(torch.stack([VERTICES, VERTICES + 0.1]) if batched else VERTICES)
    attributes = torch.rand(*positions.shape[:-1], 3, generator=torch.Generator().manual_seed(0))
    return positions.requires_grad_(), attributes.requires_grad_()


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("how", ["sets", "ranges", "tensor"])
def test_images_of_different_meshes_are_those_by_themselves(how: str, batched: bool) -> None:
    given = {"sets": {}, "ranges": {"ranges": RANGES}, "tensor": {"ranges": torch.tensor(RANGES)}}[how]
    tensors = inputs(batched)
    image, found = drawn(*tensors, SETS if how == "sets" else FACES, **given)
    weights = smooth_weights(*image.shape)
    (weights * image).sum().backward()
    alone = inputs(batched)
    assert image.shape == (2, *SIZE, 3) and not torch.equal(image[0], image[1])
    for k, (start, own) in enumerate(zip((0, 5), SETS, strict=True)):
        one, seen = drawn(*(t[k] if batched else t for t in alone), own)
        assert torch.equal(one[0], image[k])
        triangle = torch.where(seen.covered, seen.triangle + (0 if how == "sets" else start), -1)
        assert torch.equal(found.triangle[k], triangle[0]) and torch.equal(found.depth[k], seen.depth[0])
        (weights[k] * one[0]).sum().backward()
    for a, b in zip(tensors, alone, strict=True):
        assert a.grad.abs().max() > 1
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-3, atol=1e-3 * float(b.grad.abs().max()))


def test_creases_of_different_meshes() -> None:
    positions, attributes = inputs(True)
    flags, weights = torch.rand(2, 7, 3) < 0.5, torch.rand(2, *SIZE)
    found, topology = sdr.rasterize(positions, SETS, SIZE), sdr.build_topology(SETS, torch.stack([VERTICES] * 2))
    image = sdr.interpolate(attributes, found, SETS)
    result = sdr.antialias(image, found, positions, topology, creases=flags, crease_weights=weights)
    for k, faces in enumerate(SETS):
        one = sdr.rasterize(positions[k], faces, SIZE)
        options = {"creases": flags[k], "crease_weights": weights[k : k + 1]}
        expected = sdr.antialias(image[k : k + 1], one, positions[k], sdr.build_topology(faces, VERTICES), **options)
        assert torch.equal(result[k], expected[0])


def layers_of(depths: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Sheets over the whole image, one behind the other."""
    corners = torch.tensor([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    sheets = [torch.cat([corners, torch.full((4, 1), z), torch.ones(4, 1)], 1) for z in depths]
    quad = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return torch.cat(sheets), torch.cat([quad + 4 * k for k in range(len(depths))])


@pytest.mark.parametrize("layers", [1, 2, 3, 4])
def test_layers_are_looked_through_front_to_back(layers: int) -> None:
    """All but the last sheet are transparent at some pixels: NumPy finds the first opaque one."""
    depths = [0.1, 0.3, 0.5, 0.7]
    positions, faces = layers_of(depths)
    holes = torch.rand(4, *SIZE, generator=torch.Generator().manual_seed(2)) < 0.6
    calls = []

    def transparent(found: sdr.Raster) -> torch.Tensor:
        calls.append(found)
        assert not found.u.requires_grad and found.covered.all()
        sheet = torch.div(found.triangle, 2, rounding_mode="floor")
        return holes.gather(0, sheet.long())

    positions.requires_grad_()
    found = sdr.rasterize(positions, faces, SIZE, transparent=transparent, layers=layers)
    open_ = holes.numpy().copy()
    open_[layers - 1 :] = False
    expected = np.argmin(open_, 0)
    assert np.array_equal(found.triangle[0].numpy() // 2, expected) and len(calls) == layers - 1
    np.testing.assert_allclose(found.depth[0].detach(), np.array(depths)[expected], atol=1e-6)
    found.depth.sum().backward()
    counts = np.bincount(expected.ravel(), minlength=4)
    np.testing.assert_allclose(positions.grad[:, 2].reshape(4, 4).sum(1), counts, rtol=1e-4, atol=1e-3)


def test_alpha_tests_may_interpolate_and_are_those_of_drjit() -> None:
    positions = torch.stack([clip(VERTICES), clip(VERTICES + 0.1)])

    def transparent(found: sdr.Raster) -> torch.Tensor:
        return sdr.interpolate(VERTICES, found, FACES)[..., 0] > 0.1

    found = sdr.rasterize(positions, FACES, SIZE, transparent=transparent)
    array, faces, x = mi.TensorXf(positions), mi.TensorXu(FACES.int()), mi.TensorXf(VERTICES[:, :1].contiguous())
    expected = raster.rasterize(
        array, faces, SIZE, transparent=lambda seen: raster.interpolate(x, seen, faces, check_indices=False).array > 0.1
    )
    assert np.array_equal(found.triangle.numpy().ravel(), expected.triangle.numpy().astype(np.int32))
    assert not torch.equal(found.triangle, sdr.rasterize(positions, FACES, SIZE).triangle)
    inside = torch.func.grad(lambda p: sdr.rasterize(p, FACES, SIZE, transparent=transparent).depth.sum())(positions)
    positions.requires_grad_()
    sdr.rasterize(positions, FACES, SIZE, transparent=transparent).depth.sum().backward()
    torch.testing.assert_close(inside, positions.grad, rtol=1e-3, atol=1e-3)


def test_wrong_sets_are_refused() -> None:
    p = clip(VERTICES)
    found, whole = sdr.rasterize(p, SETS, SIZE), sdr.build_topology(FACES, VERTICES)

    def ranged(ranges: object) -> object:
        return lambda: sdr.rasterize(p, FACES, SIZE, ranges=ranges)

    refused("faces: shape (1, 2, 7, 3), but must be (F, 3) or (B, F, 3)", lambda: sdr.rasterize(p, SETS[None], SIZE))
    refused("positions: of 3 images, but faces (2, 7, 3) are for 2", lambda: sdr.rasterize(torch.stack([p] * 3), SETS, SIZE))
    refused("ranges: given beside faces (2, 7, 3); give faces (F, 3)", lambda: sdr.rasterize(p, SETS, SIZE, ranges=RANGES))
    refused("ranges[1]: (5, 8); there are 12 faces", ranged([(0, 7), (5, 8)]))
    refused("ranges[0]: (0, 0); there are 12 faces", ranged([(0, 0)]))
    refused("ranges[0]: 3, but must be (first face, number of faces)", ranged([3]))
    refused("ranges[0]: float, but must be int", ranged([(0.5, 2)]))
    refused("ranges: empty", ranged([]))
    refused("ranges: dict, but must be list or tuple", ranged({}))
    refused("shape of faces: (12, 3) instead of (2, 7, 3)", lambda: sdr.interpolate(VERTICES, found, FACES))
    image = torch.zeros(2, *SIZE, 1)
    refused("faces of topology: (12, 3) instead of (2, 7, 3)", lambda: sdr.antialias(image, found, p, whole))
    refused(
        "topology: of faces (2, 7, 3); give that of one mesh",
        lambda: sdr.render_maps(VERTICES, sdr.build_topology(SETS, VERTICES), light_of("spot")),
    )
    refused("positions: shape (2, 8, 3), but must be (V, 3)", lambda: sdr.build_topology(FACES, torch.stack([VERTICES] * 2)))
    refused(
        "transparent: given beside faces (2, 7, 3)", lambda: sdr.rasterize(p, SETS, SIZE, transparent=lambda found: found.covered)
    )
    refused("transparent: Tensor, but must be a function", lambda: sdr.rasterize(p, FACES, SIZE, transparent=p))
    refused("layers: 0; give 1 or more", lambda: sdr.rasterize(p, FACES, SIZE, layers=0))
    refused("layers: float, but must be int", lambda: sdr.rasterize(p, FACES, SIZE, layers=1.5))
    refused(
        "result of transparent: torch.float32, but must be torch.bool",
        lambda: sdr.rasterize(p, FACES, SIZE, transparent=lambda found: found.u),
    )
    refused(
        "result of transparent: shape (40, 48)", lambda: sdr.rasterize(p, FACES, SIZE, transparent=lambda found: found.covered[0])
    )
