"""Anti-aliasing on PyTorch tensors where surfaces intersect, bend or change their colour."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from torch_scene import BOX, FACES, VERTICES, clip, refused, smooth_weights  # noqa: E402

import shadowmap_dr.torch as sdr  # noqa: E402
from shadowmap_dr import raster  # noqa: E402

SIZE = (64, 64)
QUADS = torch.tensor([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
COLOURS = torch.tensor([0.0] * 4 + [1.0] * 4)[:, None]
X, Y, ONE = torch.tensor([-1.0, 1, 1, -1]), torch.tensor([-1.0, -1, 1, 1]), torch.ones(4)


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")
    torch.set_num_threads(1)


def sheet_through_floor(height: torch.Tensor, **options: Any) -> torch.Tensor:
    """A black floor and a white sheet that passes through it at x = height: white is what lies left of there."""
    floor, sheet = torch.stack([X, Y, 0 * X, ONE], 1), torch.stack([X, Y, 0.4 * (X - height), ONE], 1)
    positions = torch.cat([floor, sheet])
    found = sdr.rasterize(positions, QUADS, SIZE)
    topology = sdr.build_topology(QUADS, positions[:, :3])
    return sdr.antialias(sdr.interpolate(COLOURS, found, QUADS), found, positions, topology, **options)


@pytest.mark.parametrize("at", [0.1137, -0.4023, 0.5])
def test_intersections_have_the_area_and_the_derivative_of_the_formula(at: float) -> None:
    height = torch.tensor(at, requires_grad=True)
    share = sheet_through_floor(height).mean()
    share.backward()
    assert float(share.detach()) == pytest.approx((1 + at) / 2, abs=1e-4) and float(height.grad) == pytest.approx(0.5, abs=1e-3)
    _, rate = torch.func.jvp(lambda h: sheet_through_floor(h).mean(), (torch.tensor(at),), (torch.tensor(1.0),))
    assert float(rate) == pytest.approx(0.5, abs=1e-3)


def test_intersections_may_be_left_out() -> None:
    height = torch.tensor(0.1137, requires_grad=True)
    image = sheet_through_floor(height, intersections=False)
    image.mean().backward()
    assert set(image.detach().unique().tolist()) == {0.0, 1.0} and height.grad == 0


def face_colours(vertices: torch.Tensor, **options: Any) -> torch.Tensor:
    """A box each of whose sides has a colour of its own."""
    positions = clip(vertices)
    found = sdr.rasterize(positions, FACES, (128, 128))
    own = torch.arange(3 * len(FACES)).reshape(-1, 3)
    sides = torch.unique(normals().round(decimals=3), dim=0, return_inverse=True)[1]
    colours = (1 + sides).float().repeat_interleave(3)[:, None]
    topology = sdr.build_topology(FACES, VERTICES)
    return sdr.antialias(sdr.interpolate(colours, found, own), found, positions, topology, **options)


def normals() -> torch.Tensor:
    corners = VERTICES[FACES]
    return torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def test_creases_agree_with_differences() -> None:
    """Turning the box moves edges between its faces."""
    turned, creases = torch.tensor([[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]]), torch.ones_like(FACES, dtype=torch.bool)
    direction = VERTICES @ turned

    def total(vertices: torch.Tensor, **options: Any) -> torch.Tensor:
        image = face_colours(vertices, **options)
        return (smooth_weights(*image.shape) * image).double().sum()

    rates = {}
    for name, options in {
        "none": {},
        "all": {"creases": creases},
        "bent": {"creases": creases, "face_normals": normals()},
    }.items():
        vertices = VERTICES.clone().requires_grad_()
        total(vertices, **options).backward()
        found = float((vertices.grad * direction).sum())
        ends = [float(total(VERTICES + sign * 0.05 * direction, **options)) for sign in (1, -1)]
        rates[name] = found, (ends[0] - ends[1]) / 0.1
    for name in ("all", "bent"):
        assert rates[name][0] == pytest.approx(rates[name][1], rel=0.03), name
    assert abs(rates["none"][0] - rates["none"][1]) > 0.2 * abs(rates["none"][1])


@pytest.mark.parametrize("options", ["creases", "weights", "folds", "continued", "gap"])
def test_image_and_gradients_are_those_of_drjit(options: str) -> None:
    flags, generator = torch.zeros_like(FACES, dtype=torch.bool), torch.Generator().manual_seed(1)
    flags[::2] = True
    weights = torch.rand(1, *SIZE, generator=generator)
    image = torch.rand(1, *SIZE, 2, generator=generator)
    given: dict[str, Any] = {"creases": flags, "crease_weights": weights, "face_normals": normals()}
    edges, padded = mi.UInt32(flags.int().ravel()) != 0, torch.nn.functional.pad(normals(), (0, 1)).ravel().contiguous()
    core: dict[str, Any] = {
        "creases": edges,
        "crease_weights": mi.Float(weights.ravel()),
        "folds": raster.CoplanarCreases(edges, mi.Float(padded)),
    }
    count = {"creases": 1, "weights": 2, "folds": 3, "continued": 2}.get(options, 0)
    given, core = dict(list(given.items())[:count]), dict(list(core.items())[:count])
    if options == "continued":
        given["continued"] = core["continued"] = True
    if options == "gap":
        given["gap"] = core["gap"] = 0.05
    positions = clip(VERTICES).requires_grad_()
    found = sdr.rasterize(positions, FACES, SIZE)
    result = sdr.antialias(image, found, positions, sdr.build_topology(FACES, VERTICES), **given)
    (smooth_weights(*result.shape) * result).sum().backward()

    array = mi.TensorXf(clip(VERTICES))
    dr.enable_grad(array)
    seen = raster.rasterize(array, mi.TensorXu(FACES.int()), SIZE)
    topology = raster.build_topology(BOX.faces, BOX.vertices, mi.UInt32)
    expected = raster.antialias(mi.TensorXf(image[0].contiguous()), seen, array, topology, meetings=True, **core)
    dr.backward(dr.sum(expected * mi.TensorXf(smooth_weights(*result.shape)[0].contiguous()), axis=None))
    np.testing.assert_allclose(result[0].detach(), expected.numpy(), atol=1e-6)
    gradient = dr.grad(array).numpy()
    assert np.abs(gradient).max() > 1
    np.testing.assert_allclose(positions.grad, gradient, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())


def test_continued_colours_give_the_derivative_of_a_ramp() -> None:
    """The edge of a sheet of the colour x: its integral changes by its colour at the edge."""

    def total(edge: torch.Tensor, continued: bool) -> torch.Tensor:
        x = torch.stack([-ONE[0], edge, edge, -ONE[0]])
        positions, faces = torch.stack([x, 0.75 * Y, 0 * X, ONE], 1), QUADS[:2]
        found = sdr.rasterize(positions, faces, SIZE)
        image = ramp * found.covered[..., None]
        topology = sdr.build_topology(faces, positions[:, :3])
        return sdr.antialias(image, found, positions, topology, continued=continued).sum() * (2 / 64) ** 2

    ramp = ((2 * torch.arange(64) + 1) / 64 - 1).expand(1, 64, 64)[..., None] + 1
    at, found = 0.3, {}
    for continued in (False, True):
        edge = torch.tensor(at, requires_grad=True)
        total(edge, continued).backward()
        found[continued] = float(edge.grad)
    exact = 2 * 0.75 * (1 + at)
    assert found[True] == pytest.approx(exact, rel=2e-3)
    assert abs(found[True] - exact) < abs(found[False] - exact)


def test_wrong_options_are_refused() -> None:
    positions, flags = clip(VERTICES), torch.ones_like(FACES, dtype=torch.bool)
    found, topology = sdr.rasterize(positions, FACES, SIZE), sdr.build_topology(FACES, VERTICES)

    def call(**options: Any) -> torch.Tensor:
        return sdr.antialias(torch.zeros(1, *SIZE, 1), found, positions, topology, **options)

    refused("creases: torch.int64, but must be torch.bool; convert with .bool().", lambda: call(creases=FACES))
    refused("creases: shape (11, 3), but must be (12, 3).", lambda: call(creases=flags[1:]))
    refused("creases: list, but must be a torch.Tensor.", lambda: call(creases=[True]))
    refused("crease_weights: given without creases; give these, too.", lambda: call(crease_weights=torch.ones(1, *SIZE)))
    refused("face_normals: given without creases", lambda: call(face_normals=normals()))
    refused("crease_weights: shape (1, 64, 63)", lambda: call(creases=flags, crease_weights=torch.ones(1, 64, 63)))
    refused("face_normals: shape (12, 4), but must be (12, 3)", lambda: call(creases=flags, face_normals=torch.ones(12, 4)))
    refused("gap: -1.0; give a finite depth of at least 0.", lambda: call(gap=-1))
    refused("intersections: int, but must be bool.", lambda: call(intersections=1))
