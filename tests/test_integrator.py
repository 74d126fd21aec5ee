"""The plug-in: ``mi.render`` in all modes and variants, against Mitsuba's own images. Its derivatives: test_gradients.py."""

from __future__ import annotations

import gc
import subprocess
import sys
import textwrap
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

import shadowmap_dr
from shadowmap_dr import ShadowmapError
from shadowmap_dr import scene_renderer as plugin

SIZE = 64
# Shadows a little softer than a pixel: images of this size would alias a sharper map, and so would their differences.
SOFT = {"shadow_map_resolution": 64, "shadow_filter_size": 5}


def ball(subdivisions: int = 2) -> Any:
    """A smooth ``mi.Mesh`` of a sphere, radius 0.5 about (0, 0, 0.9)."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    mesh = mi.Mesh("ball", len(sphere.vertices), len(sphere.faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (np.asarray(sphere.vertices) + [0, 0, 0.9]).astype(np.float32).ravel()
    params["faces"] = np.asarray(sphere.faces).astype(np.uint32).ravel()
    params.update()
    return mesh


def camera(size: int = SIZE, fov: float = 45, **film: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb", **film}
    to_world = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    # The sampler's count must not matter: a plug-in that heeded it would take 64 samples.
    sampler = {"type": "independent", "sample_count": 64}
    return {"type": "perspective", "fov": fov, "to_world": to_world, "film": film, "sampler": sampler}


def floor(**changes: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), **changes}


def sun(**changes: Any) -> dict[str, Any]:
    return {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": {"type": "rgb", "value": 2.0}, **changes}


def small_scene(**changes: Any) -> Any:
    """A ball over a floor in the sun, seen by one camera."""
    parts = {"type": "scene", "ball": ball(), "floor": floor(), "camera": camera(), "sun": sun(), **changes}
    return mi.load_dict({k: v for k, v in parts.items() if v is not None}, optimize=False)


def full_scene() -> Any:
    """The small scene with a textured floor and all kinds of lights."""
    texture = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32))
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "raw": True}}
    look_at = mi.ScalarTransform4f().look_at([-1.5, -1, 3], [0, 0, 0.2], [0, 0, 1])
    return small_scene(
        floor=floor(bsdf=bsdf),
        sun=sun(irradiance={"type": "rgb", "value": 1.0}),
        lamp={"type": "point", "position": [1.5, 0, 2.5], "intensity": {"type": "rgb", "value": 4.0}},
        spot={"type": "spot", "cutoff_angle": 35.0, "to_world": look_at, "intensity": {"type": "rgb", "value": [8.0, 7.0, 6.0]}},
    )


def shadowmap(**options: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", **options})


def render(scene: Any, integrator: Any = None, **arguments: Any) -> np.ndarray:
    return mi.render(scene, integrator=integrator or shadowmap(), **arguments).numpy()


def relative_error(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.abs(image - reference).mean() / reference.mean())


# ---------------------------------------------------------------------------------------------------------------- images


def test_image_agrees_with_path_tracing(variant: str) -> None:
    scene = full_scene()
    image = render(scene, shadowmap(shadow_map_resolution=512), spp=16)
    assert image.shape == (SIZE, SIZE, 3)
    assert relative_error(image, render(scene, mi.load_dict({"type": "direct"}), spp=2048)) < 0.02


def test_result_is_a_detached_tensor(variant: str) -> None:
    scene = small_scene()
    params = mi.traverse(scene)
    dr.enable_grad(params["sun.irradiance.value"])
    params.update()
    integrator = shadowmap()
    image = integrator.render(scene)
    assert isinstance(image, mi.TensorXf) and not dr.grad_enabled(image)
    assert dr.grad_enabled(mi.render(scene, params, integrator=integrator))


def test_spp(variant: str) -> None:
    scene = small_scene()
    integrator = shadowmap()
    default = render(scene, integrator)
    assert np.array_equal(default, render(scene, integrator, spp=1))
    four = render(scene, integrator, spp=4)
    assert not np.array_equal(default, four)
    assert np.array_equal(four, render(scene, integrator, spp=3))  # ceil(sqrt(3)) = 2
    assert not np.array_equal(four, render(scene, integrator, spp=5))
    tiny = small_scene(camera=camera(8))
    assert np.array_equal(render(tiny, integrator, spp=256), render(tiny, integrator, spp=5000))
    assert np.array_equal(default, render(scene, integrator, seed=7))


def test_hide_emitters_and_ambient(variant: str) -> None:
    scene = small_scene(floor=None, sky={"type": "constant", "radiance": {"type": "rgb", "value": [0.1, 0.2, 0.3]}})
    assert np.allclose(render(scene)[0, 0], [0.1, 0.2, 0.3])
    assert np.allclose(render(scene, shadowmap(hide_emitters=True))[0, 0], 0)
    dark, lit = (render(small_scene(), shadowmap(ambient=value)) for value in (0.0, 0.5))
    assert np.allclose(lit[60, 10] - dark[60, 10], 0.25, atol=1e-3)  # 0.5 * the floor's reflectance of 0.5


# ------------------------------------------------------------------------------------------------------------ derivatives


def _translated(base: Any, t: Any) -> Any:
    return base + t * mi.Float(np.tile(np.float32([1.0, 0.5, 0.2]), dr.width(base) // 3))


def _scaled(base: Any, t: Any) -> Any:
    return mi.TensorXf(base.array * (1 + t), base.shape) if dr.is_tensor_v(base) else base * (1 + t)


def weights(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1, 1, shape).astype(np.float32)


def test_texture_gradient_is_an_image(variant: str) -> None:
    scene = full_scene()
    params = mi.traverse(scene)
    key = "floor.bsdf.reflectance.data"
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=shadowmap(**SOFT))))
    gradient = dr.grad(params[key]).numpy()
    assert gradient.shape == (4, 4, 3)
    assert np.isfinite(gradient).all() and (gradient[1:3, 1:3] > 0).all()


def test_optimiser_moves_the_ball_back(variant: str) -> None:
    """The usual loop of Mitsuba's tutorials, with the shadow as the only thing in view."""
    shadow_only = camera(32, crop_offset_x=20, crop_offset_y=0, crop_width=12, crop_height=24)
    scene = small_scene(camera=shadow_only)
    integrator = shadowmap(**SOFT)
    reference = mi.render(scene, integrator=integrator)
    assert reference.numpy().min() < 0.2 * reference.numpy().max()
    params = mi.traverse(scene)
    key = "ball.vertex_positions"
    rest = mi.Float(params[key])
    adam = mi.ad.Adam(lr=0.02, params={"shift": mi.Float(0.2)})
    for _ in range(25):
        params[key] = rest + adam["shift"] * mi.Float(np.tile(np.float32([1, 0, 0]), dr.width(rest) // 3))
        params.update()
        loss = dr.mean(dr.square(mi.render(scene, params, integrator=integrator) - reference))
        dr.backward(loss)
        adam.step()
    assert abs(adam["shift"][0]) < 0.05


def test_instances(variant: str) -> None:
    """Their places may be attached even before the first image, and the mesh that they show."""
    cube = {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.3)}
    place = mi.ScalarTransform4f().translate([0.5, 0, 0.5]).rotate([0, 0, 1], 30)
    instance = {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}
    scene = small_scene(ball=None, group={"type": "shapegroup", "cube": cube}, one=instance)
    integrator, weight = shadowmap(**SOFT), mi.TensorXf(weights((SIZE, SIZE, 3)))
    params = mi.traverse(scene)
    shift = mi.Float(0)
    dr.enable_grad(shift)
    params["one.to_world"] = mi.Transform4f().translate(mi.Vector3f(shift, 0, 0)) @ mi.Transform4f(place)
    params.update()
    dr.backward(dr.sum(mi.render(scene, params, integrator=integrator) * weight))
    params["one.to_world"] = mi.Transform4f(place)
    dr.enable_grad(params["group.cube.vertex_positions"])
    params.update()
    image = mi.render(scene, params, integrator=integrator)
    assert relative_error(image.numpy(), render(scene, mi.load_dict({"type": "direct"}), spp=256)) < 0.03
    dr.backward(dr.sum(image * weight))
    # Moving the instance along x is moving its vertices along x in the world.
    gradient = dr.unravel(mi.Vector3f, dr.grad(params["group.cube.vertex_positions"]))
    along_x = mi.Transform4f(place).inverse() @ mi.Vector3f(1, 0, 0)
    assert dr.grad(shift)[0] == pytest.approx(dr.sum(dr.dot(along_x, gradient))[0], rel=1e-3)


def test_modes_without_attached_parameters(variant: str) -> None:
    scene, integrator = small_scene(), shadowmap()
    params = mi.traverse(scene)
    assert not integrator.render_forward(scene, params).numpy().any()
    integrator.render_backward(scene, params, dr.ones(mi.TensorXf, (SIZE, SIZE, 3)))


# ------------------------------------------------------------------------------------------------------- what is remembered


def _all_messages(error: BaseException | None) -> str:
    """Dr.Jit wraps what an integrator raises."""
    return "" if error is None else f"{error} | {_all_messages(error.__cause__ or error.__context__)}"


@pytest.fixture
def loads(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Scenes that were read from scratch."""
    seen: list[Any] = []
    original = plugin.load

    def load(scene: Any, **options: Any) -> Any:
        seen.append(scene)
        return original(scene, **options)

    monkeypatch.setattr(plugin, "load", load)
    yield seen


def test_scene_is_read_once(variant: str, loads: list[Any]) -> None:
    scene, integrator = small_scene(), shadowmap()
    params = mi.traverse(scene)
    first = render(scene, integrator)
    for key, value in (("ball.vertex_positions", _translated), ("sun.irradiance.value", _scaled)):
        params[key] = value(params[key], 0.1)
        dr.enable_grad(params[key])
    params.update()
    image = mi.render(scene, params, integrator=integrator)
    dr.backward(dr.sum(image))
    assert not np.array_equal(first, image.numpy())
    assert len(loads) == 1
    other = small_scene(sun=sun(direction=[0, 0, -1]))
    assert np.array_equal(render(other, integrator), render(other))
    assert np.array_equal(render(scene, integrator), image.numpy())
    assert len(loads) == 3  # the two integrators read `other`, none read `scene` again


def test_new_topology_is_noticed(variant: str, loads: list[Any]) -> None:
    scene, integrator = small_scene(), shadowmap()
    render(scene, integrator)
    params = mi.traverse(scene)
    faces = params["ball.faces"].numpy().copy()
    params["ball.faces"] = mi.UInt32(faces)
    params.update()
    render(scene, integrator)
    assert len(loads) == 1
    params["ball.faces"] = mi.UInt32(np.roll(faces, 3))
    params.update()
    assert np.array_equal(render(scene, integrator), render(scene))
    mesh = ball(3)
    finer = mi.traverse(mesh)
    for key in ("faces", "vertex_positions", "vertex_normals"):
        params[f"ball.{key}"] = finer[key]
    params.update()
    assert np.array_equal(render(scene, integrator), render(scene))
    assert loads == [scene] * 5


def test_wider_spot_light_is_noticed(variant: str) -> None:
    """Beyond 60 degrees a spot light has six maps instead of one."""
    spot = {"type": "spot", "cutoff_angle": 40.0, "to_world": mi.ScalarTransform4f().look_at([0, 0, 2], [0, 0, 0], [0, 1, 0])}
    scene, integrator = small_scene(sun=spot), shadowmap()
    render(scene, integrator)
    params = mi.traverse(scene)
    params["sun.cutoff_angle"] = 75.0
    params.update()
    assert np.array_equal(render(scene, integrator), render(scene))


def test_derivatives_see_the_frusta_of_the_image(variant: str) -> None:
    """Although images of another sensor, which sees less and has other frusta, come in between."""
    sideways = mi.ScalarTransform4f().look_at([0.3, -3, 1.2], [0.3, 0, 1.2], [0, 0, 1])
    scene, integrator = small_scene(close={**camera(fov=1), "to_world": sideways}), shadowmap()
    params = mi.traverse(scene)
    key = "ball.vertex_positions"
    for shift in (0.0, 0.02, 0.7):  # kept, kept, fitted anew
        params[key] = _translated(dr.detach(params[key]), shift)
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(scene, params, integrator=integrator)
        before = _frusta(integrator)
        mi.render(scene, params, integrator=integrator, sensor=1)
        assert not np.array_equal(before, _frusta(integrator))
        loss, gradients = dr.sum(image), []
        for _ in range(2):  # with what the image has left behind, and without
            dr.set_grad(params[key], 0.0)
            dr.backward(loss, flags=dr.ADFlag.ClearInterior)
            gradients.append(dr.grad(params[key]).numpy())
        assert np.array_equal(before, _frusta(integrator))
        np.testing.assert_allclose(gradients[0], gradients[1], atol=1e-5 * np.abs(gradients[1]).max())
        mi.render(scene, params, integrator=integrator, sensor=1)
        dr.set_grad(params[key], 1.0)
        integrator.render_forward(scene, params)
        assert np.array_equal(before, _frusta(integrator))


def _frusta(integrator: Any) -> np.ndarray:
    """Numbers of the frusta of the latest image."""
    _, frusta, _ = integrator.shell.scenes[0].fits[0]
    return np.array([value.numpy() for value in vars(frusta).values()])


def test_scenes_are_not_kept_alive(variant: str) -> None:
    scene = small_scene(integrator={"type": "shadowmap"})
    mi.render(scene).numpy()
    params = mi.traverse(scene)
    dr.enable_grad(params["ball.vertex_positions"])
    params.update()
    mi.render(scene, params).numpy()  # no one asks for its derivatives
    alive = weakref.ref(scene.integrator())
    del scene, params
    gc.collect()
    assert alive() is None
    integrator = shadowmap()
    for _ in range(6):
        render(small_scene(camera=camera(4)), integrator)
    assert len(integrator.shell.scenes) <= 4
    scene = small_scene()
    for _ in range(70):
        render(scene, integrator, sensor=mi.load_dict(camera(1)))
    assert len(integrator.shell.scenes[0].fits) <= 64


def test_frozen_loop(variant: str) -> None:
    """``mi.render`` and its backward pass inside ``dr.freeze``."""
    scene, integrator = small_scene(camera=camera(16)), shadowmap(**SOFT)
    params = mi.traverse(scene)
    key = "sun.irradiance.value"

    @dr.freeze
    def step(scene: Any, params: Any, integrator: Any, x: Any) -> Any:
        dr.enable_grad(x)
        params[key] = mi.Color3f(x, x, x)
        params.update()
        loss = dr.sum(mi.render(scene, params, integrator=integrator))
        dr.backward(loss)
        gradient = dr.grad(x)
        dr.disable_grad(x)
        params[key] = dr.detach(params[key])
        params.update()
        return dr.detach(loss), gradient

    mi.render(scene, integrator=integrator)
    results = [step(scene, params, integrator, mi.Float(1.0 + i)) for i in range(5)]
    assert step.n_recordings <= 3
    for i, (loss, gradient) in enumerate(results):
        assert loss.array[0] == pytest.approx((1 + i) * results[0][0].array[0], rel=1e-5)
        assert gradient[0] == pytest.approx(results[0][0].array[0], rel=1e-5)


def test_scene_cannot_be_read_while_recording(variant: str) -> None:
    @dr.freeze
    def image(scene: Any, integrator: Any) -> Any:
        return mi.render(scene, integrator=integrator)

    with pytest.raises(RuntimeError) as error:
        image(small_scene(), shadowmap())
    assert "render it once with this integrator before" in _all_messages(error.value)


# ---------------------------------------------------------------------------------------------------------------- channels


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


# ------------------------------------------------------------------------------------------------------- films and sensors


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


# ----------------------------------------------------------------------------------------------- loading, variants, errors

XML = """
<scene version="3.0.0">
  <integrator type="shadowmap">
    <integer name="shadow_map_resolution" value="128"/>
    <string name="shadow_method" value="evsm4"/>
    <string name="shadow_filter" value="box"/>
    <integer name="shadow_filter_size" value="5"/>
    <boolean name="shadow_antialias" value="true"/>
    <integer name="shadow_samples" value="1"/>
    <boolean name="antialias" value="true"/>
    <float name="ambient" value="0.125"/>
    <boolean name="hide_emitters" value="true"/>
    <string name="aovs" value="depth, visibility"/>
    <integer name="tessellation" value="32"/>
    <boolean name="compat" value="false"/>
  </integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="2, -3, 4" target="0, 0, 0" up="0, 0, 1"/></transform>
    <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="16"/></film>
  </sensor>
  <shape type="sphere"><point name="center" x="0" y="0" z="0.9"/><float name="radius" value="0.5"/></shape>
  <shape type="rectangle"><transform name="to_world"><scale value="3"/></transform></shape>
  <emitter type="directional" id="sun"><vector name="direction" x="0.4" y="0.3" z="-1"/></emitter>
</scene>
"""


def test_xml(variant: str, tmp_path: Path) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(XML)
    scene = mi.load_file(str(path))
    image = mi.render(scene).numpy()
    assert image.shape == (16, 24, 3 + 2) and scene.integrator().aov_names() == ["depth", "visibility.sun"]
    options = dict(shadow_map_resolution=128, shadow_filter="box", shadow_filter_size=5, shadow_samples=1, ambient=0.125)
    assert np.array_equal(image[..., :3], render(scene, shadowmap(tessellation=32, **options)))
    assert "shadow_filter='box'" in str(scene.integrator())
    mi.util.write_bitmap(str(tmp_path / "image.exr"), image[..., :3], write_async=False)
    assert (tmp_path / "image.exr").stat().st_size > 0


def test_defaults_are_those_of_the_renderer(variant: str) -> None:
    assert shadowmap().shell.settings == shadowmap_dr.RenderSettings()


@pytest.mark.parametrize(
    "options, message",
    [
        ({"shadow_resolution": 64}, "has no parameter 'shadow_resolution': it has ambient, antialias"),
        ({"shadow_map_resolution": 64.5}, "'shadow_map_resolution' of 'shadowmap' is 64.5, but must be an integer"),
        ({"shadow_map_resolution": 0}, "shadow map resolution is 0"),
        ({"shadow_map_resolution": True}, "is True, but must be an integer"),
        ({"shadow_method": "magic"}, "shadow method 'magic' is unknown; choose one of auto, vsm, esm"),
        ({"shadow_filter": "median"}, "shadow filter 'median' is unknown"),
        ({"shadow_filter_size": 4}, "4"),
        ({"shadow_samples": 100}, "shadow_samples is 100"),
        ({"antialias": 1}, "'antialias' of 'shadowmap' is 1, but must be a boolean"),
        ({"ambient": -1.0}, "ambient is -1.0"),
        ({"ambient": {"type": "rgb", "value": 1.0}}, "but must be a number"),
        ({"aovs": "depth,albedo"}, "no AOV 'albedo': choose from depth, position"),
        ({"aovs": "depth,depth"}, "'depth' is there twice"),
        ({"tessellation": 2}, "tessellation is 2"),
    ],
)
def test_bad_parameters(variant: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(RuntimeError) as error:
        shadowmap(**options)
    last = str(error.value).strip().splitlines()[-1]
    assert last.startswith("ShadowmapError: ") and message in last


def test_numbers_may_be_integers(variant: str) -> None:
    assert shadowmap(ambient=1).shell.settings.ambient == 1.0


def test_scene_with_nothing_to_render(variant: str) -> None:
    grid = mi.TensorXf(np.linspace(-1, 1, 27, dtype=np.float32).reshape(3, 3, 3, 1))
    scene = small_scene(ball=None, floor=None, blob={"type": "sdfgrid", "grid": grid})
    with pytest.raises(RuntimeError) as error:
        render(scene)
    assert isinstance(error.value.__cause__, ShadowmapError)
    assert "blob" in str(error.value.__cause__) and "SDFGrid" in str(error.value.__cause__)
    with pytest.raises(ShadowmapError, match="blob"):
        shadowmap().render(scene)


def test_negative_spp(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="spp is -1"):
        shadowmap().render(small_scene(), spp=-1)


def _mono_or_skip(variant: str) -> str:
    mono = variant.replace("_rgb", "_mono")
    if mono not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {mono}")
    return mono


def test_mono_variant(variant: str) -> None:
    colour = render(small_scene(camera=camera(32)))
    mi.set_variant(_mono_or_skip(variant))
    scene = small_scene(camera=camera(32, pixel_format="luminance"))
    params = mi.traverse(scene)
    dr.enable_grad(params["sun.irradiance.value"])
    params.update()
    image = mi.render(scene, params, integrator=shadowmap())
    assert image.shape == (32, 32, 1)
    # White light on grey surfaces.
    assert np.allclose(image.numpy(), colour[..., :1], atol=1e-4)
    dr.backward(dr.sum(image))
    assert dr.grad(params["sun.irradiance.value"])[0] == pytest.approx(image.numpy().sum() / 2, rel=1e-3)


@pytest.mark.parametrize("other", ["scalar_rgb", "llvm_ad_spectral"])
def test_other_variants(variant: str, other: str) -> None:
    if other not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {other}")
    mi.set_variant(other)
    try:
        for load in (lambda: shadowmap(), lambda: mi.load_string(XML)):
            with pytest.raises(RuntimeError) as error:
                load()
            last = str(error.value).strip().splitlines()[-1]
            assert last.startswith("ShadowmapError: ") and other in last and "llvm_ad_rgb" in last
    finally:
        mi.set_variant(variant)
    assert shadowmap().shell.settings == shadowmap_dr.RenderSettings()


@pytest.mark.parametrize("late", [False, True])
def test_order_of_imports(late: bool) -> None:
    """The plug-in is there whether the variant is set before or after the import."""
    lines = ["import shadowmap_dr", "import mitsuba as mi; mi.set_variant('llvm_ad_rgb')"]
    script = textwrap.dedent(
        """
        assert type(mi.load_dict({'type': 'shadowmap'})).__name__ == 'ShadowMapIntegrator'
        mi.set_variant('llvm_ad_mono')
        integrator = mi.load_dict({'type': 'shadowmap'})
        assert isinstance(integrator, mi.Integrator)
        """
    )
    script = "\n".join(["import os", *(reversed(lines) if late else lines), script])
    subprocess.run([sys.executable, "-c", script], check=True, timeout=120)
