"""Derivatives of millions of samples: the sums of reverse mode against those of forward mode, in double precision on the host."""

from __future__ import annotations

import warnings

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.experiments.bench.sums import TOLERANCE, Sum, both
from shadowmap_dr.jit.arrays import backend
from shadowmap_dr.jit.broadcast import LANES, LIKE_LANES, broadcast_differentiable, copy_of_lane, in_copies
from shadowmap_dr.scene.sums import evaluate

FLOOR = "floor.bsdf.reflectance"
# (what, pixels along each side, samples a pixel). All kinds, and 16 million samples: `shadowmap-dr bench --only sums`.
CASES = [
    (Sum("sun", "diffuse", f"{FLOOR}.value"), 1024, 4),
    (Sum("sun", "texture", f"{FLOOR}.data"), 1024, 4),
    (Sum("sun", "diffuse", "light.irradiance.value"), 1024, 4),
    (Sum("sun", "diffuse", "floor.vertex_positions"), 1024, 4),
    (Sum("point", "diffuse", "light.position"), 1024, 4),
    (Sum("lamp", "diffuse", f"{FLOOR}.value"), 512, 4),
    (Sum("lamp", "texture", f"{FLOOR}.data"), 512, 4),
    (Sum("lamp", "plastic", "floor.bsdf.diffuse_reflectance.value"), 512, 2),
    (Sum("image", "diffuse", "light.data"), 512, 2),
]


@pytest.mark.parametrize(("case", "size", "spp"), CASES, ids=str)
def test_both_modes_agree(variant: str, case: Sum, size: int, spp: int) -> None:
    reverse, forward = both(case, size, spp)
    assert abs(forward) > 1e-3
    assert reverse == pytest.approx(forward, rel=TOLERANCE)


@pytest.mark.parametrize("mode", ["recorded", "renderer", "frozen"])
def test_recordings_and_renderers_agree(variant: str, mode: str) -> None:
    reverse, forward = both(Sum("sun", "diffuse", "light.irradiance.value"), 1024, 4, mode)
    assert reverse == pytest.approx(forward, rel=TOLERANCE)


@pytest.mark.parametrize(
    "case",
    [
        Sum("sun", "diffuse", f"{FLOOR}.value"),
        Sum("lamp", "plastic", "floor.bsdf.diffuse_reflectance.value"),
        Sum("lamp", "plastic", "floor.bsdf.alpha"),
        Sum("sky", "diffuse", "light.radiance.value"),
    ],
    ids=str,
)
def test_recordings_leave_single_numbers_attached(variant: str, case: Sum) -> None:
    """The image is recorded without gradients, before they are asked for: materials must not lose them there."""
    reverse, forward = both(case, 32, 1, "recorded")
    assert abs(forward) > 1e-3
    assert reverse == pytest.approx(forward, rel=TOLERANCE)


def test_pytorch(variant: str) -> None:
    torch = pytest.importorskip("torch")
    sdr = pytest.importorskip("shadowmap_dr.torch")
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}, "width": 1024, "height": 1024, "pixel_format": "rgb"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sun": {"type": "directional", "direction": [0.3, 0.2, -1]},
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(9),
                "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5] * 3}},
            },
            "sensor": {"type": "orthographic", "film": film},
        },
        optimize=False,
    )
    device = "cuda" if variant.startswith("cuda") else "cpu"
    strength = torch.tensor([1.0, 1.0, 1.0], device=device, requires_grad=True)
    reflectance = torch.tensor([0.5, 0.5, 0.5], device=device, requires_grad=True)
    renderer = sdr.Renderer.from_scene(scene)
    image = renderer.render(
        lights={"sun": {"irradiance": strength}}, parameters={"floor.bsdf.reflectance.value": reflectance}, spp=4
    )
    image.mean().backward()
    # Each channel's mean, over three, is proportional to both.
    for value in (strength, reflectance):
        expected = image.detach().double().mean((0, 1)) / 3 / value.detach().double()
        np.testing.assert_allclose(value.grad.cpu().numpy(), expected.cpu().numpy(), rtol=TOLERANCE)


@pytest.mark.parametrize("lanes", [LIKE_LANES + 1, 3 * LANES - 5])
def test_like_terms_are_not_rounded_away(variant: str, lanes: int) -> None:
    # A third has no short form: in a sum that grows, each term is rounded in the same direction as the one before.
    number = mi.Float(2)
    dr.enable_grad(number)
    dr.backward(broadcast_differentiable(number, lanes) * (1 / 3))
    assert dr.grad(number)[0] == pytest.approx(lanes / 3, rel=3e-4)


def test_copies_of_tables(variant: str) -> None:
    lanes, rows = 2 * LANES + 7, 5
    table, other = mi.Float([1, 2, 3, 4, 5]), mi.Float([7, 8, 9])
    dr.enable_grad(table)
    (copied, untouched), copies = in_copies([table, other], lanes)
    assert copies == 3
    block = copy_of_lane(backend(table), lanes, copies)
    index = dr.arange(mi.UInt32, lanes) % rows
    found = dr.gather(mi.Float, copied, block * rows + index)
    weights = mi.Float(np.random.default_rng(0).random(lanes, np.float32))
    np.testing.assert_array_equal(found.numpy(), np.arange(lanes) % rows + 1)
    dr.backward(found * weights)
    expected = np.bincount(np.arange(lanes) % rows, weights.numpy().astype(np.float64))
    np.testing.assert_allclose(dr.grad(table).numpy(), expected, rtol=1e-4)
    assert not dr.grad_enabled(other) and dr.width(untouched) == copies * 3


def test_tables_that_few_lanes_read_are_not_copied(variant: str) -> None:
    table = mi.Float([1, 2])
    dr.enable_grad(table)
    (same,), copies = in_copies([table], LANES)
    assert copies == 1 and same is table
    (same,), copies = in_copies([dr.detach(table)], 9 * LANES)
    assert copies == 1


def test_slices_of_lanes_add_up(variant: str) -> None:
    """Own arrays (wide, and of width 1), and parameters of an object of Mitsuba's, over slices of which the last is shorter."""
    lanes = 2 * LIKE_LANES + 11
    texture = mi.load_dict({"type": "rgb", "value": [0.2, 0.4, 0.6]})
    params = mi.traverse(texture)
    dr.enable_grad(params["value"])
    wide = mi.Float(np.random.default_rng(1).random(lanes, np.float32))
    single = mi.Float(3)
    dr.enable_grad(wide, single)

    def term(own: tuple) -> mi.Float:
        wide, single = own
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wide))
        return mi.UnpolarizedSpectrum(texture.eval(si)).x * wide * single

    result = evaluate(term, (wide, single), [texture], lanes)
    np.testing.assert_allclose(dr.detach(result).numpy(), 0.6 * wide.numpy(), rtol=1e-5)
    slopes = mi.Float(np.random.default_rng(2).random(lanes, np.float32))
    dr.backward(result * slopes)
    products = wide.numpy().astype(np.float64) * slopes.numpy()
    np.testing.assert_allclose(dr.grad(wide).numpy(), 0.6 * slopes.numpy(), rtol=1e-5)
    np.testing.assert_allclose(dr.grad(single).numpy(), [0.2 * products.sum()], rtol=1e-5)
    np.testing.assert_allclose(dr.ravel(dr.grad(params["value"])).numpy(), [3 * products.sum(), 0, 0], rtol=1e-5)


def test_value_that_all_lanes_share(variant: str) -> None:
    """The radiance of a constant sky is one number, whatever the direction. Its gradient is no lane's own."""
    lanes = LIKE_LANES + 1
    texture = mi.load_dict({"type": "rgb", "value": [0.2, 0.4, 0.6]})
    value = mi.traverse(texture)["value"]
    dr.enable_grad(value)

    def term(own: mi.Float) -> mi.UnpolarizedSpectrum:
        return texture.eval(dr.zeros(mi.SurfaceInteraction3f))

    result = evaluate(term, dr.arange(mi.Float, lanes), [texture], lanes)
    dr.backward(result.x * dr.full(mi.Float, 0.5, lanes))
    assert dr.ravel(dr.grad(value))[0] == pytest.approx(0.5 * lanes, rel=1e-4)


def test_gradients_that_a_parameter_has_already_stay(variant: str) -> None:
    lanes = LIKE_LANES + 1
    texture = mi.load_dict({"type": "rgb", "value": [0.2, 0.4, 0.6]})
    value, ones = mi.traverse(texture)["value"], dr.full(mi.Float, 1, lanes)
    dr.enable_grad(value)

    def term(own: mi.Float) -> mi.Float:
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(own))
        return mi.UnpolarizedSpectrum(texture.eval(si)).x * own

    dr.backward(evaluate(term, ones, [texture], lanes) + 2 * evaluate(term, ones, [texture], lanes) + value.x)
    assert dr.ravel(dr.grad(value))[0] == pytest.approx(4 * lanes, rel=1e-4)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_what_parameters_hang_on_is_passed_on_to_all_terms(variant: str, mode: str) -> None:
    """A sky's pixels and a reflectance, themselves computed, are read by the light, the background and two materials."""
    pixels = np.random.default_rng(0).uniform(0, 1, (4, 8, 3)).astype(np.float32)
    paint = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}, "width": 256, "height": 256, "pixel_format": "rgb"}
    place = mi.ScalarTransform4f().look_at([0, -5, 4], [0, 0, 0], [0, 0, 1])
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)},
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2), "bsdf": paint},
            "sensor": {"type": "perspective", "to_world": place, "film": film},
        }
    )
    integrator = mi.load_dict({"type": "shadowmap", "shadow_method": "none", "environment_light_samples": 8})
    params = mi.traverse(scene)
    rest = {key: mi.TensorXf(params[key]) for key in ("sky.data", "floor.bsdf.reflectance.data")}

    def image_at(x: mi.Float) -> mi.TensorXf:
        for key, value in rest.items():
            params[key] = value * (1 + x)
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=4)

    up, down = (float(image_at(dr.opaque(mi.Float, step)).numpy().mean(dtype=np.float64)) for step in (0.1, -0.1))
    x = dr.opaque(mi.Float, 0)
    dr.enable_grad(x)
    image = image_at(x)
    if mode == "forward":
        dr.forward(x)
        found = dr.grad(image).numpy().mean(dtype=np.float64)
    else:
        dr.backward(dr.mean(image, axis=None))
        found = dr.grad(x)[0]
    assert found == pytest.approx((up - down) / 0.2, rel=TOLERANCE)


def test_fewer_samples_than_asked_for_are_named(variant: str) -> None:
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}, "width": 1500, "height": 4, "sample_border": False}
    floor, sun = {"type": "rectangle"}, {"type": "directional", "direction": [0, 0, -1]}
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "orthographic", "film": film}, "floor": floor, "sun": sun})
    renderer = Renderer.from_scene(scene, shadow_map_resolution=16)
    with pytest.warns(UserWarning, match="Of 16 samples per pixel 4 are taken: 1500 x 4 pixels"):
        renderer.render(spp=16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        renderer.render(spp=4)
