"""The renderer on PyTorch tensors: vertices, lights, textures and cameras; frozen or not."""

from __future__ import annotations

import gc
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

import shadowmap_dr  # noqa: E402
import shadowmap_dr.torch as sdr  # noqa: E402
from shadowmap_dr import ShadowmapError  # noqa: E402
from shadowmap_dr.torch import render as torch_render  # noqa: E402

SIZE = 96
OPTIONS = {"shadow_map_resolution": 128, "shadow_filter_size": 5, "shadow_samples": 1}
TEXTURE = "floor.bsdf.reflectance.data"
DIRECTION = torch.tensor([0.4, 0.3, -1.0])
POSITION = torch.tensor([1.5, 0.0, 2.5])


def ball() -> Any:
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "roughplastic", "alpha": 0.3})  # one that Mitsuba itself evaluates for each pixel
    mesh = mi.Mesh("ball", len(sphere.vertices), len(sphere.faces), has_vertex_normals=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (np.asarray(sphere.vertices) + [0, 0, 0.9]).astype(np.float32).ravel()
    params["faces"] = np.asarray(sphere.faces).astype(np.uint32).ravel()
    params.update()
    return mesh


def build() -> Any:
    """A glossy ball over a textured floor in the light of the sun and a lamp."""
    texture = (0.3 + 0.5 * np.random.default_rng(1).random((4, 4, 3))).astype(np.float32)
    bitmap = {"type": "bitmap", "data": mi.TensorXf(texture), "raw": True, "filter_type": "bilinear"}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    return mi.load_dict(
        {
            "type": "scene",
            "ball": ball(),
            "floor": {
                "type": "rectangle",
                "to_world": mi.ScalarTransform4f().scale(3),
                "bsdf": {"type": "diffuse", "reflectance": bitmap},
            },
            "camera": {"type": "perspective", "fov": 45, "to_world": view, "film": film},
            "sun": {"type": "directional", "direction": DIRECTION.tolist(), "irradiance": {"type": "rgb", "value": 2.0}},
            "lamp": {"type": "point", "position": POSITION.tolist(), "intensity": {"type": "rgb", "value": [4.0, 3.0, 2.0]}},
        },
        optimize=False,
    )


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")
    torch.set_num_threads(1)


@pytest.fixture(params=[False, True], ids=["plain", "frozen"])
def renderer(request: pytest.FixtureRequest) -> sdr.Renderer:
    return sdr.Renderer.from_scene(build(), frozen=request.param, **OPTIONS)


def weights() -> torch.Tensor:
    y, x = torch.meshgrid(*(torch.linspace(0, 1, SIZE) for _ in range(2)), indexing="ij")
    return (0.5 + 0.3 * torch.sin(5 * x + 1) * torch.cos(4 * y) + 0.4 * x)[..., None] * torch.tensor([1.0, 0.8, 1.3])


def agrees(function: Callable[[torch.Tensor], torch.Tensor], at: torch.Tensor, direction: torch.Tensor, step: float) -> None:
    """The derivative along a direction against a central difference."""
    point = at.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((weights() * function(point)).sum(), point)
    with torch.no_grad():
        ends = [(weights() * function(at + sign * step * direction)).double().sum() for sign in (1, -1)]
    expected, found = float(ends[0] - ends[1]) / (2 * step), float((gradient * direction).sum())
    assert abs(expected) > 0.1 and abs(found - expected) < 0.08 * abs(expected), (found, expected)


def test_frozen_or_not_image_and_gradients_are_those_of_drjit(renderer: sdr.Renderer) -> None:
    plain = shadowmap_dr.Renderer.from_scene(build(), **OPTIONS)
    colour = torch.tensor([2.0, 1.5, 1.0])
    for k in range(4):  # recorded in the first calls, replayed in the last ones
        given = [t.clone().requires_grad_() for t in (renderer.vertices("ball") + 0.01 * k, DIRECTION, POSITION, colour)]
        vertices, direction, position, irradiance = given
        image = renderer.render(
            {"ball": vertices}, {"sun": {"direction": direction, "irradiance": irradiance}, "lamp": {"position": position}}
        )
        (weights() * image).sum().backward()

        arrays = [mi.TensorXf(t.detach().clone()) for t in given]
        dr.enable_grad(arrays)
        v, d, p, c = (a.array for a in arrays)
        lights = {
            "sun": replace(plain.light("sun"), direction=dr.unravel(mi.Vector3f, d), irradiance=dr.unravel(mi.Color3f, c)),
            "lamp": replace(plain.light("lamp"), position=dr.unravel(mi.Point3f, p)),
        }
        expected = plain.render({"ball": v}, lights)
        dr.backward(dr.sum(expected * mi.TensorXf(weights()), axis=None))
        assert image.shape == (SIZE, SIZE, 3) and image.dtype == torch.float32
        np.testing.assert_allclose(image.detach(), expected.numpy(), atol=1e-5)
        for tensor, array in zip(given, arrays, strict=True):
            gradient = dr.grad(array).numpy()
            scale = np.abs(gradient).max()
            assert scale > 0.1
            np.testing.assert_allclose(tensor.grad, gradient, rtol=1e-3, atol=1e-3 * scale)


def test_frozen_renderers_notice_other_samples() -> None:
    plain, frozen = (sdr.Renderer.from_scene(build(), frozen=f, **OPTIONS) for f in (False, True))
    name = frozen._renderer.data.geometry.shapes[0].name
    vertices = plain.vertices(name)
    for spp in (1, 4, 1):
        expected, image = (renderer.render({name: vertices}, spp=spp) for renderer in (plain, frozen))
        torch.testing.assert_close(image, expected, atol=1e-4, rtol=1e-4)
    assert frozen._frozen[0].n_recordings == 2


def test_frozen_or_not_gradients_agree_with_differences(renderer: sdr.Renderer) -> None:
    rest = renderer.vertices("ball")
    agrees(lambda v: renderer.render({"ball": v}), rest, torch.tensor([1.0, 0.3, 0.2]).expand_as(rest), 0.01)
    agrees(lambda d: renderer.render(lights={"sun": {"direction": d}}), DIRECTION, torch.tensor([1.0, -1, 0]), 0.01)
    agrees(lambda p: renderer.render(lights={"lamp": {"position": p}}), POSITION, torch.tensor([0.5, 1, 0]), 0.02)


def test_textures_and_cameras(renderer: sdr.Renderer) -> None:
    rest = torch.full((4, 4, 3), 0.5)
    agrees(lambda t: renderer.render(parameters={TEXTURE: t}), rest, torch.rand(4, 4, 3), 0.1)
    table = mi.traverse(renderer._renderer.data.scene)
    to_world = torch.tensor(np.array(table["camera.to_world"].matrix), dtype=torch.float32).reshape(4, 4)
    sideways = torch.zeros(4, 4)
    sideways[0, 3] = 1
    agrees(lambda m: renderer.render(parameters={"camera.to_world": m}), to_world, sideways, 0.02)


def test_textures_are_set_for_the_call_only(renderer: sdr.Renderer) -> None:
    scene = renderer._renderer.data.scene
    before, stored = renderer.render(), np.array(mi.traverse(scene)[TEXTURE])
    first = torch.full((4, 4, 3), 0.2).requires_grad_()
    second = torch.full((4, 4, 3), 0.9).requires_grad_()
    dark, bright = (renderer.render(parameters={TEXTURE: t}) for t in (first, second))
    assert dark.mean() < 0.7 * before.mean() < 0.7 * bright.mean()
    assert np.array_equal(mi.traverse(scene)[TEXTURE], stored)
    assert not dr.grad_enabled(mi.traverse(scene)[TEXTURE])
    # Each backward pass has its own texture, though the last forward pass had another one.
    dark.square().sum().backward()
    bright.square().sum().backward()
    assert first.grad.sum() < 0.4 * second.grad.sum() and torch.equal(renderer.render(), before)


def test_vertices_and_textures_together(renderer: sdr.Renderer) -> None:
    vertices, texture = renderer.vertices("ball").requires_grad_(), torch.full((4, 4, 3), 0.5).requires_grad_()
    image = renderer.render({"ball": vertices}, {"sun": {"direction": DIRECTION}}, {TEXTURE: texture})
    image.square().sum().backward()
    alone = renderer.vertices("ball").requires_grad_()
    renderer.render({"ball": alone}, parameters={TEXTURE: texture.detach()}).square().sum().backward()
    assert texture.grad.abs().min() > 0
    torch.testing.assert_close(vertices.grad, alone.grad, rtol=1e-3, atol=1e-3 * float(alone.grad.abs().max()))


def test_frozen_or_not_second_backward_pass_is_like_the_first(renderer: sdr.Renderer) -> None:
    vertices = renderer.vertices("ball").requires_grad_()
    loss = renderer.render({"ball": vertices}).square().sum()
    with torch.no_grad():
        vertices.data.mul_(3)  # optimisers move parameters in place
    first, second = (torch.autograd.grad(k * loss, vertices, retain_graph=True)[0] for k in (1, 3))
    assert first.abs().max() > 0.1
    torch.testing.assert_close(3 * first, second, rtol=1e-3, atol=1e-3 * float(first.abs().max()))


def test_gradients_are_those_of_their_own_call(renderer: sdr.Renderer) -> None:
    """Two images before the first backward pass."""
    near, far = renderer.vertices("ball").requires_grad_(), (renderer.vertices("ball") + 0.3).requires_grad_()
    images = [renderer.render({"ball": v}) for v in (near, far)]
    sum(image.square().sum() for image in images).backward()
    for vertices in (near, far):
        alone = vertices.detach().clone().requires_grad_()
        renderer.render({"ball": alone}).square().sum().backward()
        torch.testing.assert_close(vertices.grad, alone.grad, rtol=1e-3, atol=1e-3 * float(alone.grad.abs().max()))


def test_frozen_or_not_later_images_leave_gradients_alone(renderer: sdr.Renderer) -> None:
    """A backward pass sees the fit of its own image's shadow maps."""
    rest = renderer.vertices("ball")
    renderer.render({"ball": rest})
    gradients = []
    for later in (False, True):
        moved = (rest + torch.tensor([0.05, 0.05, 0.05])).requires_grad_()
        loss = (weights() * renderer.render({"ball": moved})).sum()
        if later:
            with torch.no_grad():
                renderer.render({"ball": rest + torch.tensor([0.1, 0.1, 0.1])})
        loss.backward()
        gradients.append(moved.grad)
        renderer.render({"ball": rest})
    torch.testing.assert_close(*gradients, rtol=1e-3, atol=1e-3 * float(gradients[0].abs().max()))


def test_frozen_or_not_no_graph_stays_behind(renderer: sdr.Renderer, capfd: pytest.CaptureFixture[str]) -> None:
    """Dr.Jit never frees some of those that are dropped; when the process ends, it would crash on them."""
    vertices = renderer.vertices("ball").requires_grad_()

    def nodes() -> int:
        gc.collect()
        capfd.readouterr()
        dr.whos_ad()
        return len(capfd.readouterr().out.splitlines())

    before = nodes()
    for _ in range(3):
        renderer.render({"ball": vertices})
        renderer.render({"ball": vertices}).square().sum().backward(retain_graph=True)
    assert nodes() == before


def test_frozen_or_not_backward_passes_begin_with_what_the_image_has_evaluated(
    renderer: sdr.Renderer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one of each image, where somebody wants gradients, and as far as memory allows."""
    made: list[Any] = []
    rendering = torch_render._Rendering.__init__
    monkeypatch.setattr(torch_render._Rendering, "__init__", lambda self, *given: (rendering(self, *given), made.append(self))[0])
    vertices = renderer.vertices("ball")
    moved = vertices.clone().requires_grad_()
    gc.collect()  # images of other tests
    loss = (renderer.render({"ball": moved}) * weights()).sum()
    assert len(made[0].results.unpacked()) > 5
    loss.backward(retain_graph=True)
    assert not made[0].results
    first, moved.grad = moved.grad, None
    loss.backward()
    torch.testing.assert_close(moved.grad, first, rtol=1e-4, atol=1e-4 * float(first.abs().max()))
    renderer.render({"ball": vertices})
    with torch.no_grad():
        renderer.render({"ball": moved})
    assert not made[1].results and not made[2].results
    monkeypatch.setattr(torch_render, "MOST_SAMPLES", 1)
    images = [renderer.render({"ball": moved}) for _ in range(2)]
    assert made[3].results and not made[4].results
    moved.grad = None
    sum((image * weights()).sum() for image in images).backward()
    torch.testing.assert_close(moved.grad, 2 * first, rtol=1e-4, atol=2e-4 * float(first.abs().max()))


def test_without_gradients(renderer: sdr.Renderer) -> None:
    vertices = renderer.vertices("ball")
    image = renderer.render({"ball": vertices})
    assert not image.requires_grad and not renderer.render().requires_grad
    with torch.no_grad():
        assert not renderer.render({"ball": vertices.requires_grad_()}).requires_grad
    torch.testing.assert_close(image, renderer.render(), atol=1e-5, rtol=0)


def test_frozen_or_not_two_steps_of_an_optimiser_lower_the_loss(renderer: sdr.Renderer) -> None:
    target = renderer.render()
    offset = torch.nn.Parameter(torch.tensor([0.1, -0.05, 0.0]))
    optimiser = torch.optim.Adam([offset], lr=0.02)
    losses = []
    for _ in range(3):
        optimiser.zero_grad()
        loss = (renderer.render({"ball": renderer.vertices("ball") + offset}) - target).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[0] > losses[1] > losses[2]


def test_faces_fit_the_vertices(renderer: sdr.Renderer) -> None:
    faces, vertices = renderer.faces("ball"), renderer.vertices("ball")
    assert faces.shape == (320, 3) and faces.dtype == torch.int32 and int(faces.max()) == len(vertices) - 1
    assert renderer.faces("floor").max() == 3 and renderer.vertices("floor").abs().max() == 3


def test_wrong_input_is_refused(renderer: sdr.Renderer) -> None:
    vertices = renderer.vertices("ball")

    def refused(message: str, **given: Any) -> None:
        with pytest.raises(ShadowmapError, match=re.escape(message)) as caught:
            renderer.render(**given)
        assert "\n" not in str(caught.value)

    refused("vertex_positions['ball']: shape (161, 3), but must be (162, 3)", vertex_positions={"ball": vertices[1:]})
    refused("vertex_positions['ball']: torch.float64", vertex_positions={"ball": vertices.double()})
    refused("There is no shape 'cube'", vertex_positions={"cube": vertices})
    refused("There is no light 'moon'", lights={"moon": {"direction": DIRECTION}})
    refused("Light 'sun' has no 'position' that a tensor could replace", lights={"sun": {"position": POSITION}})
    refused("lights['sun']['direction']: shape (4,)", lights={"sun": {"direction": torch.ones(4)}})
    refused("The scene has no parameter 'floor.colour'", parameters={"floor.colour": torch.ones(3)})
    refused(f"parameters['{TEXTURE}']: shape (2, 2, 3)", parameters={TEXTURE: torch.ones(2, 2, 3)})
    refused("parameters: 'camera.film.size' is a", parameters={"camera.film.size": torch.ones(2)})
    refused("sensor 3, spp 1: there are 1 sensors", sensor=3)
    refused("sensor 0, spp 0: there are 1 sensors", spp=0)
    refused("sensor 0, spp nan: there are 1 sensors", spp=float("nan"))
    refused("sensor 0, spp inf: there are 1 sensors", spp=float("inf"))
    refused("lights['sun']['direction']: [0.0, 0.0, 0.0]; give", lights={"sun": {"direction": torch.zeros(3)}})
    refused("lights['sun']['direction']: [nan, nan, nan]; give", lights={"sun": {"direction": torch.full((3,), torch.nan)}})
    refused("Mitsuba refuses new values of camera.to_world", parameters={"camera.to_world": torch.zeros(4, 4)})
    refused("vertex_positions: Tensor, but must be Mapping", vertex_positions=vertices)
    refused("lights['sun']: Tensor, but must be Mapping", lights={"sun": DIRECTION})
    refused("parameters: list, but must be Mapping", parameters=[])
    refused("sensor: float, but must be int", sensor=0.5)
    assert renderer.render(sensor=np.int64(0), spp=np.float32(1)).shape == (SIZE, SIZE, 3)
    with pytest.raises(ShadowmapError, match="renderer: Scene, but must be Renderer"):
        sdr.Renderer(build())
    refused("vertex_positions['ball']: on meta", vertex_positions={"ball": vertices.to("meta")})


def sky(column: int) -> torch.Tensor:
    """An environment with a sun at a column."""
    pixels = torch.full((16, 32, 3), 0.05)
    pixels[4:6, column : column + 2] = 50
    return pixels


def test_skies_may_change(renderer: sdr.Renderer) -> None:
    """A sun elsewhere lights from there, from the first call on; gradients are those of that call's image."""
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    up = mi.ScalarTransform4f().rotate([1, 0, 0], 90)

    def with_sky(pixels: torch.Tensor) -> Any:
        return mi.load_dict({
            "type": "scene",
            "ball": ball(),
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
            "camera": {"type": "perspective", "fov": 45, "to_world": view, "film": film},
            "sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels.numpy()), "to_world": up},
        })  # fmt: skip

    options = {"environment_light_samples": 32, "shadow_map_resolution": 64, "soft_map_resolution": 64}
    used = sdr.Renderer.from_scene(with_sky(sky(2)), frozen=renderer._frozen is not None, **options)
    data = torch.from_numpy(np.array(mi.traverse(with_sky(sky(20)))["sky.data"])).requires_grad_()
    first = used.render()
    found = used.render(parameters={"sky.data": data})
    expected = shadowmap_dr.Renderer.from_scene(with_sky(sky(20)), **options).render()
    assert (found - first).abs().max() > 0.1
    np.testing.assert_allclose(found.detach().numpy(), np.array(expected), atol=2e-3 * float(np.array(expected).max()))
    # In between, an image in the old light: the backward pass is still that of the other one.
    np.testing.assert_allclose(used.render().numpy(), first.numpy(), atol=1e-4)
    found.sum().backward()
    # The image is linear in the sky.
    assert float((data.grad * data.detach()).sum()) == pytest.approx(float(found.detach().sum()), rel=2e-3)


def test_lights_may_become_wider_than_their_map(renderer: sdr.Renderer) -> None:
    """The shadows of a spot light stay, whatever its angle becomes."""
    spot = {
        "type": "spot",
        "to_world": mi.ScalarTransform4f().look_at([0.5, 0.3, 3], [0, 0, 0], [0, 1, 0]),
        "cutoff_angle": 30.0,
        "intensity": 20.0,
    }
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    camera = {"type": "perspective", "fov": 45, "to_world": view, "film": film}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)}

    def scene(angle: float) -> Any:
        parts = {"ball": ball(), "floor": floor, "camera": camera, "spot": {**spot, "cutoff_angle": angle}}
        return mi.load_dict({"type": "scene", **parts})

    used = sdr.Renderer.from_scene(scene(30.0), shadow_map_resolution=256)
    given = {"cutoff_angle": torch.tensor([120.0]), "beam_width": torch.tensor([90.0])}
    found = used.render(lights={"spot": given}).numpy()
    expected = np.array(shadowmap_dr.Renderer.from_scene(scene(120.0), shadow_map_resolution=256).render())
    assert np.abs(found - expected).mean() < 0.02 * expected.mean()


def test_wrong_variant_is_refused(renderer: sdr.Renderer) -> None:
    mi.set_variant("llvm_ad_mono")
    with pytest.raises(ShadowmapError, match="The variant is llvm_ad_mono, but this renderer was made for llvm_ad_rgb"):
        renderer.render()
    mi.set_variant("llvm_ad_rgb")
    renderer._variant = "cuda_ad_rgb"  # as if there were a GPU
    with pytest.raises(ShadowmapError, match="The variant is llvm_ad_rgb, but this renderer was made for cuda_ad_rgb"):
        renderer.render({"ball": renderer.vertices("ball")})


def test_records_of_cameras(renderer: sdr.Renderer) -> None:
    """Images and gradients are those of Dr.Jit through the same record, whose pixels are not square."""
    from shadowmap_dr import cameras

    views = [
        replace(cameras.look_at((2, -3, 4), (0.1 * k, 0, 0), (0, 0, 1), fov=45, width=SIZE, height=72), fx=110.0, fy=90.0)
        for k in range(3)
    ]
    plain = shadowmap_dr.Renderer.from_scene(build(), **OPTIONS)
    weight = torch.rand((72, SIZE, 3), generator=torch.Generator().manual_seed(0))
    for view in views:
        vertices = renderer.vertices("ball").clone().requires_grad_()
        image = renderer.render({"ball": vertices}, sensor=view.record())
        (weight * image).sum().backward()
        positions = mi.TensorXf(vertices.detach().clone())
        dr.enable_grad(positions)
        expected = plain.render({"ball": positions.array}, sensor=view.record())
        dr.backward(dr.sum(expected * mi.TensorXf(weight), axis=None))
        np.testing.assert_allclose(image.detach(), expected, atol=1e-5)
        gradient = np.array(dr.grad(positions))
        np.testing.assert_allclose(vertices.grad, gradient, atol=1e-4 * np.abs(gradient).max())
    with pytest.raises(ShadowmapError, match=r"the sensor is a Camera: give camera.record\(\)"):
        renderer.render(sensor=views[0])
