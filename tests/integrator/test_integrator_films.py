"""The plug-in: channels, films and sensors."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import SIZE, SOFT, camera, full_scene, render, shadowmap, small_scene

from shadowmap_dr import ShadowmapError


def test_aovs(variant: str) -> None:
    scene = full_scene()
    names = "depth,position,normal,shape_index,prim_index,visibility"
    integrator = shadowmap(aovs=names)
    image = render(scene, integrator)
    channels = dict(zip(integrator.aov_names(), np.moveaxis(image[..., 3:], -1, 0), strict=True))
    assert list(channels) == [
        *("depth", "position.X", "position.Y", "position.Z", "normal.X", "normal.Y", "normal.Z"),
        *("shape_index", "prim_index", "visibility.sun", "visibility.lamp", "visibility.spot"),
    ]
    assert np.array_equal(image[..., :3], render(scene))
    types = "d:depth,p:position,n:sh_normal,s:shape_index,i:prim_index"
    traced = render(scene, mi.load_dict({"type": "aov", "aovs": types, "sub": {"type": "direct"}}), spp=1)[..., -9:]
    # Mitsuba numbers shapes as they were created, and its sample lies anywhere in the pixel instead of its middle.
    numbers = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in scene.shapes()]
    inside = np.choose(channels["shape_index"].astype(int) + 1, [0, *numbers]) == traced[..., 7]
    assert inside.mean() > 0.95
    assert np.median(np.abs(channels["depth"] - traced[..., 0])[inside]) < 0.05
    assert np.median(np.abs(channels["position.X"] - traced[..., 1])[inside]) < 0.05
    assert np.median(np.abs(channels["normal.Z"] - traced[..., 6])[inside]) < 0.01
    assert set(np.unique(channels["shape_index"])) <= {-1.0, 0.0, 1.0}
    for light in ("sun", "lamp", "spot"):
        values = channels[f"visibility.{light}"]
        assert values.min() < 0.1 and values.max() == pytest.approx(1) and values.min() >= 0


def test_aov_labels(variant: str) -> None:
    integrator = shadowmap(aovs="d:depth, nn:sh_normal,lit:visibility")
    image = render(small_scene(), integrator)
    assert integrator.aov_names() == ["d", "nn.X", "nn.Y", "nn.Z", "lit.sun"]
    assert image.shape[2] == 3 + 5
    assert shadowmap().aov_names() == []


def test_derivatives_with_aovs(variant: str) -> None:
    """Channels beside the colours have derivatives too."""
    scene, integrator = small_scene(camera=camera(16)), shadowmap(aovs="depth", **SOFT)
    params = mi.traverse(scene)
    key = "camera.to_world"
    base, t = mi.Transform4f(params[key]), mi.Float(0)
    dr.enable_grad(t)
    params[key] = base @ mi.Transform4f().translate(mi.Vector3f(0, 0, t))
    params.update()
    image = mi.render(scene, params, integrator=integrator)
    dr.backward(dr.sum(image[..., 3]))
    assert -1.01 * 256 < dr.grad(t)[0] < -0.7 * 256  # every pixel's distance shrinks by up to 1


def test_crop_window(variant: str) -> None:
    crop = {"crop_offset_x": 8, "crop_offset_y": 20, "crop_width": 40, "crop_height": 30}
    whole, part = (render(small_scene(camera=camera(**film))) for film in ({}, crop))
    assert part.shape == (30, 40, 3)
    # The outermost pixels have one neighbour less to be anti-aliased with.
    assert np.allclose(part[1:-1, 1:-1], whole[21:49, 9:47], atol=1e-4)


@pytest.mark.parametrize("pixel_format, channels", [("rgb", 3), ("rgba", 4), ("luminance", 1), ("luminance_alpha", 2)])
def test_pixel_formats(variant: str, pixel_format: str, channels: int) -> None:
    scene = small_scene(camera=camera(32, pixel_format=pixel_format), floor=None)
    image = render(scene)
    traced = render(scene, mi.load_dict({"type": "direct"}), spp=64)
    assert image.shape == traced.shape == (32, 32, channels)
    assert np.abs(image - traced).mean() < 0.02


def test_batch_sensor(variant: str) -> None:
    other = mi.ScalarTransform4f().look_at([-2, -3, 4], [0, 0, 0], [0, 0, 1])
    cameras = [camera(32), {**camera(32), "to_world": other}]
    film = {"type": "hdrfilm", "width": 64, "height": 32, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    batch = {"type": "batch", "film": film, "a": cameras[0], "b": cameras[1]}
    image = render(small_scene(camera=batch))
    assert image.shape == (32, 64, 3)
    for k, single in enumerate(cameras):
        assert np.allclose(image[:, 32 * k : 32 * k + 32], render(small_scene(camera=single)), atol=1e-5)


def test_scene_without_sensors(variant: str) -> None:
    scene = small_scene(camera=None)
    assert np.array_equal(render(scene, sensor=mi.load_dict(camera())), render(small_scene()))


def test_sensor_by_number_and_by_object(variant: str) -> None:
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    second = {**camera(24), "type": "orthographic", "to_world": to_world}
    del second["fov"]
    scene, integrator = small_scene(second=second), shadowmap()
    assert render(scene, integrator).shape == (SIZE, SIZE, 3)
    expected = render(scene, integrator, sensor=1)
    assert expected.shape == (24, 24, 3)
    stranger = mi.load_dict(second)
    assert np.array_equal(expected, render(scene, integrator, sensor=stranger))
    assert np.array_equal(expected, integrator.render(scene, sensor=1).numpy())
    with pytest.raises(ShadowmapError, match="no sensor 5: the scene has 2"):
        integrator.render(scene, sensor=5)


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba", "luminance_alpha"])
def test_film_holds_the_image(variant: str, pixel_format: str) -> None:
    """As Mitsuba's command line does it: render without developing, then write the film."""
    crop = {"crop_offset_x": 4, "crop_offset_y": 2, "crop_width": 16, "crop_height": 12, "pixel_format": pixel_format}
    scene = small_scene(camera=camera(24, **crop), integrator={"type": "shadowmap", "aovs": "depth,visibility"})
    assert scene.integrator().render(scene, develop=False).shape == (0,)
    film = scene.sensors()[0].film()
    assert np.allclose(film.develop().numpy(), mi.render(scene).numpy(), atol=1e-6)
    assert "depth" in str(film.bitmap(raw=False).struct_())


@pytest.mark.parametrize("recorded", [False, True])
def test_film_holds_the_image_of_mi_render(variant: str, recorded: bool) -> None:
    scene = small_scene(camera=camera(24))
    params, film = mi.traverse(scene), scene.sensors()[0].film()
    integrator = shadowmap(recorded=recorded)
    mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=4)
    for irradiance in (1.0, 0.5):
        params["sun.irradiance.value"] = mi.Color3f(irradiance)
        params.update()
        image = mi.render(scene, params, integrator=integrator).numpy()
        assert np.allclose(film.develop().numpy(), image, atol=1e-6)
