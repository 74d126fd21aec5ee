"""Parameters of fits in PyTorch: images are those of the fit, gradients those of differences."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="pip install '.[torch]'")

import shadowmap_dr.torch as sdr  # noqa: E402
from shadowmap_dr import ShadowmapError  # noqa: E402
from shadowmap_dr.fitting import Own, SceneChange  # noqa: E402

GREY = "floor.bsdf.reflectance.value"


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def description(**parts: Any) -> dict[str, Any]:
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 64, "height": 48, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    return {
        "type": "scene",
        "camera": {
            "type": "perspective",
            "fov": 45,
            "to_world": T().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1]),
            "film": film,
        },
        "ball": {
            "type": "sphere",
            "center": [0, 0, 0.7],
            "radius": 0.5,
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.7, 0.5, 0.3)},
        },
        "floor": {"type": "rectangle", "to_world": T().scale(4), "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}},
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": rgb(2, 1.5, 1)},
        "lamp": {"type": "point", "position": [1.5, 0, 2.5], "intensity": rgb(4, 3, 2)},
        **parts,
    }


@pytest.fixture(scope="module")
def renderer() -> sdr.Renderer:
    mi.set_variant("llvm_ad_rgb")
    return sdr.Renderer.from_dict(description(), shadow_map_resolution=128, shadow_filter_size=5, shadow_samples=1)


def image(renderer: sdr.Renderer, parameters: sdr.Parameters, x: Any) -> Any:
    return renderer.render(**parameters(x), spp=16)


def slide(numbers: list[Any], change: SceneChange) -> None:
    """The ball on a rail; the sun as bright as it is far."""
    (way,) = numbers
    change.move(["ball"], mi.Matrix4f([1, 0, 0, way], [0, 1, 0, 0.5 * way], [0, 0, 1, 0], [0, 0, 0, 1]))
    light = change.light("sun")
    change.lights["sun"] = type(light)(**{**vars(light), "irradiance": light.irradiance * dr.exp(way)})


RAIL = Own("rail", slide, start=[0.0], spread=0.4)


@pytest.mark.parametrize(
    "entry",
    [
        *("ball:translation:xy", "ball:scale", "sun:direction", "sun:brightness", "lamp:position:x", "camera:rotation:y"),
        *("camera:fov", "floor.bsdf.reflectance", RAIL),
    ],
    ids=lambda entry: getattr(entry, "name", entry),
)
def test_gradients_are_those_of_differences(renderer: sdr.Renderer, entry: Any) -> None:
    """Of losses whose gradient by the image is a difference of images along each number: in size, and against each other."""
    parameters = sdr.Parameters(renderer, entry)
    x = torch.full((parameters.count,), 0.05)
    differences = []
    for step in 0.02 * torch.eye(parameters.count):
        above, below = (image(renderer, parameters, x + sign * step) for sign in (1, -1))
        blocks = ((above - below) / 0.04).reshape(12, 4, 16, 4, 3).mean((1, 3))
        differences.append(blocks.repeat_interleave(4, 0).repeat_interleave(4, 1))
    found, expected = [], []
    for weights in differences:
        at = x.clone().requires_grad_()
        (weights * image(renderer, parameters, at)).sum().backward()
        found.append(at.grad.numpy())
        expected.append([float((weights * one).sum()) for one in differences])
    np.testing.assert_allclose(found, expected, atol=0.1 * np.abs(expected).max())
    assert np.diag(expected).min() > 0.01


def test_several_entries_and_a_recording(renderer: sdr.Renderer) -> None:
    """All kinds of arguments at once; a recorded renderer gives the same image and gradients."""
    frozen = sdr.Renderer.from_dict(description(), frozen=True, shadow_map_resolution=128, shadow_filter_size=5, shadow_samples=1)
    entries = ["ball:pose", "sun:direction", "camera:fov"]
    results = []
    for own in (renderer, frozen):
        parameters = sdr.Parameters(own, entries)
        assert parameters.units == ("deg",) * 3 + ("units",) * 3 + ("deg",) * 3
        assert parameters.labels[0] == "ball:pose rotation x" and parameters.labels[-1] == "camera:fov angle of view"
        for value in (0.02, 0.05):  # the second call is replayed
            x = torch.full((9,), value, requires_grad=True)
            seen = image(own, parameters, x)
            seen.square().sum().backward()
        results.append((seen.detach().numpy(), x.grad.numpy()))
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-3 * np.abs(ours).max())


def test_images_are_those_of_the_changed_scene(renderer: sdr.Renderer) -> None:
    parameters = sdr.Parameters(renderer, ["ball:translation", "sun:brightness", "camera:fov", "floor.bsdf.reflectance"])
    values = np.array([0.2, -0.1, 0.1, 0.8, 40, 0.3, 0.4, 0.5])
    x = parameters.numbers(values)
    np.testing.assert_allclose(parameters.values(x), values, rtol=1e-5)
    np.testing.assert_allclose(parameters.values(parameters.start), [0, 0, 0, 1, 45, 0.5, 0.5, 0.5], rtol=1e-6)
    changed = description()
    changed["ball"]["center"] = [0.2, -0.1, 0.8]
    changed["sun"]["irradiance"] = rgb(1.6, 1.2, 0.8)
    changed["camera"]["fov"] = 40
    changed["floor"]["bsdf"]["reflectance"] = rgb(0.3, 0.4, 0.5)
    other = sdr.Renderer.from_dict(changed, shadow_map_resolution=128, shadow_filter_size=5, shadow_samples=1)
    difference = (image(renderer, parameters, x) - other.render(spp=16)).abs()
    assert float(difference.mean()) < 0.003
    np.testing.assert_allclose(np.array(mi.traverse(renderer._renderer.data.scene)[GREY]).ravel(), 0.5)


def test_a_loop_of_pytorch_finds_a_pose(renderer: sdr.Renderer) -> None:
    parameters = sdr.Parameters(renderer, ["ball:translation:xy", "sun:brightness"])
    true = np.array([0.25, -0.15, 1.3])
    target = image(renderer, parameters, parameters.numbers(true)).detach()
    x = parameters.start
    adam = torch.optim.Adam([x], lr=0.03)
    for _ in range(60):
        adam.zero_grad()
        (image(renderer, parameters, x) - target).square().mean().backward()
        adam.step()
    np.testing.assert_allclose(parameters.values(x), true, atol=0.02)


def test_what_is_refused(renderer: sdr.Renderer) -> None:
    for entries, words in (
        (["bal:pose"], "no object or value 'bal'"),
        (["floor:vertices"], "textures and vertices are tensors already"),
        ([], "nothing varies"),
    ):
        with pytest.raises(ShadowmapError, match=words):
            sdr.Parameters(renderer, entries)
    parameters = sdr.Parameters(renderer, "ball:translation:xy")
    with pytest.raises(ShadowmapError, match="x: shape"):
        parameters(torch.zeros(3))
    with pytest.raises(ShadowmapError, match="torch.float64"):
        parameters(torch.zeros(2, dtype=torch.float64))
    with pytest.raises(ShadowmapError, match="values: shape"):
        parameters.numbers([1.0])
    with pytest.raises(ShadowmapError, match="there is no 'fov'"):
        renderer.render(camera={"fov": torch.ones(1)})
    with pytest.raises(ShadowmapError, match="transforms\\['ball'\\]: shape"):
        renderer.render(transforms={"ball": torch.eye(3)})
