"""Images under extended lights: against what is known in closed form, and against Mitsuba's `direct`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from gradients.scenes import shaded_lamp
from lit_scenes import ALBEDO, SIZE, area, box, camera, panel, scene_of, view

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.rendering.extended_lights import area_samples as emitters


def render(scene: Any, spp: int = 0, **options: Any) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "shadowmap", **options}), spp=spp))


def traced(scene: Any, spp: int = 1024, **options: Any) -> np.ndarray:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct", **options}), spp=spp))


# ------------------------------------------------------------------------------------------------------------ closed forms


@pytest.mark.parametrize("height", [0.5, 1.0, 3.0])
def test_disk_above_a_floor(variant: str, height: float) -> None:
    """Irradiance below the centre of a disk: pi L r^2 / (r^2 + h^2)."""
    image = render(scene_of(lamp=panel(height, 0.4, "disk")), area_light_samples=64)
    expected = ALBEDO * 2.0 * 0.4**2 / (0.4**2 + height**2)
    assert image.mean() == pytest.approx(expected, rel=0.015)


@pytest.mark.parametrize("height", [0.6, 1.0, 3.0])
def test_sphere_above_a_floor(variant: str, height: float) -> None:
    """Irradiance below a sphere: pi L r^2 / h^2. It does not shadow itself, though half of it lies behind the other."""
    ball = {"type": "sphere", "center": [0, height, 0], "radius": 0.15, "emitter": area(2.0)}
    image = render(scene_of(camera=camera(height=0.3), lamp=ball), area_light_samples=64)
    assert image.mean() == pytest.approx(ALBEDO * 2.0 * 0.15**2 / height**2, rel=0.02)


def test_constant_sky_over_a_floor(variant: str) -> None:
    """Radiance: albedo times that of the sky."""
    image = render(scene_of(sky={"type": "constant", "radiance": 0.8}), environment_light_samples=128)
    assert image.mean() == pytest.approx(ALBEDO * 0.8, rel=0.015)


@pytest.mark.parametrize(("count", "worst"), [(16, 0.025), (64, 0.005)])
def test_constant_sky_is_as_bright_on_all_sides(variant: str, count: int, worst: float) -> None:
    """A ball shows all normals. Parts of the sky lie across each one's horizon, and are wide."""
    ball = {"type": "sphere", "center": [0, 0.4, 0], "radius": 0.8}
    parts = {"camera": view(rfilter={"type": "box"}), "floor": None, "ball": ball, "sky": {"type": "constant", "radiance": 0.8}}
    image = render(scene_of(**parts), environment_light_samples=count, antialias=False)
    on_ball = image[image < 0.79]
    assert on_ball.size > 300
    np.testing.assert_allclose(on_ball, ALBEDO * 0.8, rtol=worst)


@pytest.mark.parametrize("turn", [0.0, 20.0, 45.0])
def test_turned_floor_receives_all_of_a_constant_sky(variant: str, turn: float) -> None:
    T = mi.ScalarTransform4f
    floor = {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90 + turn) @ T().scale(3)}
    image = render(scene_of(floor=floor, sky={"type": "constant", "radiance": 0.8}))
    np.testing.assert_allclose(image, ALBEDO * 0.8, rtol=5e-3)


def test_one_sided(variant: str) -> None:
    assert np.all(render(scene_of(lamp=panel(down=False))) == 0)
    assert np.all(render(scene_of(lamp=panel())) > 0.1)


@pytest.mark.parametrize("kind", ["rectangle", "cube"])
def test_mirrored_meshes_shine_where_their_normals_point(variant: str, kind: str) -> None:
    """Their triangles wind the other way, which Mitsuba does not ask about."""
    T = mi.ScalarTransform4f
    thin = T().scale([1, 1, 0.1]) if kind == "cube" else T()
    lamp = panel(kind=kind)
    images = {}
    for name, mirror in (("as it is", [1, 1, 1]), ("sideways", [-1, 1, 1]), ("upside down", [1, 1, -1])):
        place = lamp["to_world"] @ thin @ T().scale(mirror)
        images[name] = render(scene_of(lamp={**lamp, "to_world": place}))
    assert images["as it is"].min() > 0.1
    np.testing.assert_allclose(images["sideways"], images["as it is"], rtol=0.02)
    if kind == "rectangle":
        assert np.all(images["upside down"] == 0)
    else:
        np.testing.assert_allclose(images["upside down"], images["as it is"], rtol=0.02)


@pytest.mark.parametrize("where", ["floor", "lamp"])
def test_textures_written_in_python_may_vary(variant: str, where: str) -> None:
    """Mitsuba's base class says that they do not, if they say nothing."""

    class Stripes(mi.Texture):
        def __init__(self, props: Any) -> None:
            mi.Texture.__init__(self, props)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(dr.select(dr.sin(20 * si.uv.x) > 0, 0.1, 0.9))

        def mean(self) -> Any:
            return mi.Float(0.5)

        def to_string(self) -> str:
            return "Stripes"

    class HonestStripes(Stripes):
        def is_spatially_varying(self) -> bool:
            return True

    images = []
    for kind in (Stripes, HonestStripes):
        name = f"{kind.__name__}_{variant}".lower()
        mi.register_texture(name, kind)
        floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90)}
        lamp = panel(down=where == "floor")
        if where == "floor":
            floor["bsdf"] = {"type": "diffuse", "reflectance": {"type": name}}
        else:
            lamp["emitter"] = {"type": "area", "radiance": {"type": name}}
        images.append(render(scene_of(camera=view(), floor=floor, lamp=lamp)))
    assert images[1].std() > 0.1 * images[1].mean()
    np.testing.assert_allclose(images[0], images[1], atol=1e-5)


def test_emitter_is_seen_from_its_front_only(variant: str) -> None:
    front, back = (
        render(scene_of(camera=view(), floor=None, lamp=panel(0.4, down=down, emitter=area(3, 2, 1)))) for down in (False, True)
    )
    middle = SIZE // 2
    np.testing.assert_allclose(front[middle, middle], [3, 2, 1], rtol=1e-5)
    assert np.all(back == 0)


def test_opaque_lid_makes_it_dark(variant: str) -> None:
    """A plate between lamp and floor, larger than the lamp: no light comes through, from any of the samples."""
    T = mi.ScalarTransform4f
    lid = {"type": "cube", "to_world": T().translate([0, 0.7, 0]) @ T().scale([1.5, 0.02, 1.5])}
    lit, dark = (render(scene_of(lamp=panel(), **parts)) for parts in ({}, {"lid": lid}))
    assert dark.max() < 0.01 * lit.mean()
    lit, dark = (
        render(scene_of(sky={"type": "constant"}, **parts), environment_light_samples=32) for parts in ({}, {"lid": lid})
    )
    assert dark.max() < 0.6 * lit.mean()


# ---------------------------------------------------------------------------------------------------------- against direct


def difference(image: np.ndarray, reference: np.ndarray) -> float:
    """Relative, of means over blocks of 3 x 3 pixels: outlines and noise count little."""
    blocks = [a.reshape(SIZE // 3, 3, SIZE // 3, 3, -1).mean((1, 3)) for a in (image, reference)]
    return float(np.sqrt(np.square(blocks[0] - blocks[1]).mean()) / reference.mean())


def around(lamp: Any) -> dict[str, Any]:
    """Boxes on all sides of a lamp."""
    places = ((0.8, 0.3), (-0.8, 0.3))
    posts = {f"post_{k}": box(x, y, 0.25) for k, (x, y) in enumerate(places)}
    return {"camera": view(), "lamp": lamp, **posts}


def test_lamp_in_the_middle_looks_around_itself(variant: str) -> None:
    lamp = {"type": "sphere", "center": [0, 0.6, 0], "radius": 0.12, "emitter": area(6.0)}
    scene = scene_of(**around(lamp))
    (plan,) = Renderer.from_scene(scene, area_light_samples=4, soft_map_resolution=16).soft
    assert plan.kind == "cube" and plan.maps == 24
    # The lamp itself is so bright that it would hide all else.
    options = {"area_light_samples": 32, "hide_emitters": True}
    image, reference = render(scene, spp=4, **options), traced(scene, hide_emitters=True)
    assert difference(image, reference) < 0.05
    unshadowed = render(scene, spp=4, shadow_method="none", **options)
    assert difference(unshadowed, reference) > 0.1


@pytest.mark.parametrize("veil", [False, True])
def test_emitter_that_is_not_convex_shadows_itself(variant: str, monkeypatch: pytest.MonkeyPatch, veil: bool) -> None:
    """Also where the maps of a scene look through holes."""
    T = mi.ScalarTransform4f
    holes = {"type": "mask", "opacity": {"type": "checkerboard", "color0": 0.0, "color1": 1.0}, "b": {"type": "diffuse"}}
    above = {"type": "rectangle", "to_world": T().translate([0, 2, 0]) @ T().rotate([1, 0, 0], -90), "bsdf": holes}
    scene = scene_of(camera=camera(height=0.4, half=1.2), lamp=shaded_lamp((0, 0.8, 0)), veil=above if veil else None)
    options = {"spp": 4, "area_light_samples": 256, "soft_map_resolution": 64}
    image, reference = render(scene, **options), traced(scene, 4096)
    assert difference(image, reference) < 0.02
    monkeypatch.setattr(emitters, "_dented", lambda *arguments: False)
    assert difference(render(scene, **options), reference) > 0.04


def test_emitters_of_all_kinds_at_once(variant: str) -> None:
    """The sum of what each gives alone."""
    slanted = mi.ScalarTransform4f().look_at([-1, 1.5, 0], [0, 0, 0], [0, 0, 1])
    lights = {
        "lamp": panel(1.6, 0.3),
        "sky": {"type": "constant", "radiance": 0.2},
        "sun": {"type": "directional", "direction": [0.3, -1, 0.2], "irradiance": 0.8},
        "bulb": {"type": "point", "position": [0.5, 1.2, 0.5], "intensity": 0.3},
        "torch": {"type": "spot", "to_world": slanted, "intensity": 1.0},
    }
    common = {"camera": view(), "box": box()}
    together = render(scene_of(**common, **lights), hide_emitters=True)
    # A lamp that does not shine is still there and casts shadows; it lies above the picture.
    dark = {**lights["lamp"], "emitter": area(0.0)}
    total = sum(render(scene_of(**common, **{"lamp": dark, name: light}), hide_emitters=True) for name, light in lights.items())
    np.testing.assert_allclose(together, total, rtol=0.05, atol=0.01 * together.max())
    assert difference(together, total) < 0.01


@pytest.mark.parametrize("emitter", ["lamp", "sky"])
def test_hidden_emitters_are_as_in_direct(variant: str, emitter: str) -> None:
    """One looks through lamps, from either side, and a sky leaves black and no alpha. Light and shadows stay."""
    bsdf = {"type": "diffuse", "reflectance": 0.8}
    parts = {
        "lamp": {"camera": view(pixel_format="rgba"), "lamp": panel(0.3, down=False, bsdf=bsdf), "fill": panel(1.6, 0.4)},
        "sky": {"camera": view(pixel_format="rgba"), "floor": None, "box": box(0), "sky": {"type": "constant", "radiance": 0.5}},
    }[emitter]
    scene = scene_of(**parts)
    hidden, reference = render(scene, spp=4, hide_emitters=True), traced(scene, hide_emitters=True)
    np.testing.assert_allclose(hidden[..., 3], reference[..., 3], atol=0.05)
    assert difference(hidden[..., :3], reference[..., :3]) < 0.05
    seen = render(scene, spp=4)
    assert difference(seen[..., :3], traced(scene)[..., :3]) < 0.05
    assert seen[..., :3].mean() > 1.2 * hidden[..., :3].mean()


def test_more_samples_per_pixel(variant: str) -> None:
    scene = scene_of(camera=view(), lamp=panel(1.2, 0.3), box=box())
    one, four, sixteen = (render(scene, spp=spp) for spp in (1, 4, 16))
    # Samples on the lamp are sums of atomic additions, whose order, and so whose rounding, differs from run to run.
    same = lambda a, b: np.allclose(a, b, rtol=1e-5, atol=1e-6 * sixteen.max())  # noqa: E731
    assert same(one, render(scene)) and not same(one, four)
    far, near = (float(np.sqrt(np.square(image - sixteen).mean())) for image in (one, four))
    assert near < far < 0.2 * sixteen.mean()


def test_mono_variant(variant: str) -> None:
    mono = variant.replace("_rgb", "_mono")
    if mono not in mi.variants():
        pytest.skip(f"this Mitsuba has no variant {mono}")
    parts = lambda: {"camera": view(), "lamp": panel(1.2, 0.3), "box": box(), "sky": {"type": "constant", "radiance": 0.1}}  # noqa: E731
    colour = render(scene_of(**parts()))
    mi.set_variant(mono)
    grey = render(scene_of(**parts()))
    assert grey.shape == (SIZE, SIZE, 1) and np.allclose(grey, colour[..., :1], rtol=1e-3, atol=1e-3)


# ------------------------------------------------------------------------------------------------------- functional path


def scenery(**changes: Any) -> Any:
    parts = {"camera": view(), "lamp": panel(1.2, 0.3), "box": box(), "sky": {"type": "constant", "radiance": 0.1}}
    return scene_of(**{**parts, **changes})


OPTIONS = {"area_light_samples": 8, "environment_light_samples": 8, "soft_map_resolution": 32}


def test_frozen_step_equals_unfrozen(variant: str) -> None:
    """Loss and gradient of a step that moves a box, in a frozen function, for several places of the box."""
    renderer = Renderer.from_scene(scenery(), **OPTIONS)
    target, rest = renderer.render(), renderer.data.geometry.shape_positions("box")

    def step(t: Any, target: Any, rest: Any, renderer: Renderer) -> tuple[Any, Any]:
        dr.enable_grad(t)
        image = renderer.render({"box": rest + mi.Vector3f(t, 0.3 * t, 0)})
        loss = dr.mean(dr.square(image - target), axis=None)
        dr.backward(loss)
        return loss, dr.grad(t)

    frozen = dr.freeze(step)
    plain, recorded = replace(renderer), replace(renderer)
    for x in (0.05, 0.1, -0.08, 0.03, 0.15):
        expected, found = (f(mi.Float(x), target, rest, r) for f, r in ((step, plain), (frozen, recorded)))
        for a, b in zip(expected, found, strict=True):
            assert float(a.array[0]) == pytest.approx(float(b.array[0]), rel=1e-3)
        assert abs(float(expected[1].array[0])) > 1e-4
    assert frozen.n_recordings <= 3


def test_lights_are_replaced_by_name(variant: str) -> None:
    renderer = Renderer.from_scene(scenery(sky=None), **OPTIONS)
    before = renderer.render().numpy()
    for factor in (0.0, 2.0):
        after = renderer.render(lights={"lamp": replace(renderer.light("lamp"), scale=factor)}).numpy()
        np.testing.assert_allclose(after, factor * before, rtol=1e-4, atol=1e-6)
    with pytest.raises(ShadowmapError, match="There is no light 'moon'"):
        renderer.light("moon")
    scale = mi.Float(1)
    dr.enable_grad(scale)
    image = renderer.render(lights={"lamp": replace(renderer.light("lamp"), scale=scale)})
    dr.backward(dr.sum(image, axis=None))
    assert float(dr.grad(scale)[0]) == pytest.approx(before.sum(), rel=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"area_light_samples": 0}, "area_light_samples is 0"),
        ({"environment_light_samples": -3}, "environment_light_samples is -3"),
        ({"area_light_samples": 100_000}, "choose 1 to"),
        ({"soft_map_resolution": 0}, "soft_map_resolution"),
    ],
)
def test_bad_settings_are_named(variant: str, options: dict[str, int], message: str) -> None:
    with pytest.raises(ShadowmapError, match=message):
        Renderer.from_scene(scenery(), **options)
    with pytest.raises(RuntimeError, match=message):  # Mitsuba's parser wraps it
        mi.load_dict({"type": "shadowmap", **options})


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_radiance_that_is_not_finite_is_named(variant: str, value: float) -> None:
    with pytest.raises(ShadowmapError, match="radiance of light 'lamp' is not finite"):
        Renderer.from_scene(scenery(lamp=panel(1.2, 0.3, emitter=area(value))), **OPTIONS)
    with pytest.raises(ShadowmapError, match="radiance of light 'sky' is not finite"):
        sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, value, 1.0]}}
        Renderer.from_scene(scenery(sky=sky), **OPTIONS)


def test_dark_emitter_has_no_light(variant: str) -> None:
    image = render(scenery(lamp=panel(1.2, 0.3, emitter=area(0.0)), sky=None), **OPTIONS)
    assert np.all(image == 0)


@pytest.mark.parametrize("light", ["lamp", "textured lamp", "sky", "sky image"])
def test_light_that_is_off_has_a_derivative(variant: str, light: str) -> None:
    """Images are linear in radiance: the derivative is the same whatever it is, so that an optimiser can turn a light on."""
    white = mi.Bitmap(np.ones((4, 4, 3), np.float32))
    bitmap = {"type": "area", "radiance": {"type": "bitmap", "bitmap": white, "raw": True}}
    parts, key = {
        "lamp": ({"lamp": panel(1.2, 0.3, emitter=area(1.0))}, "lamp.emitter.radiance.value"),
        "textured lamp": ({"lamp": panel(1.2, 0.3, emitter=bitmap)}, "lamp.emitter.radiance.data"),
        "sky": ({"sky": {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}}, "sky.radiance.value"),
        "sky image": ({"sky": {"type": "envmap", "bitmap": mi.Bitmap(np.ones((8, 16, 3), np.float32))}}, "sky.data"),
    }[light]
    found = []
    for value in (1.0, 0.0, -0.5):
        scene = scene_of(box=box(), **parts)
        params = mi.traverse(scene)
        radiance = params[key] * 0 + value
        dr.enable_grad(radiance)
        params[key] = radiance
        params.update()
        integrator = mi.load_dict({"type": "shadowmap", "area_light_samples": 4, "environment_light_samples": 16})
        dr.backward(dr.sum(mi.render(scene, params, integrator=integrator)))
        found.append(np.array(dr.grad(radiance), np.float64).sum())
    assert found[0] > 10
    # A sky that is black is divided into other parts than a bright one.
    np.testing.assert_allclose(found[1:], found[0], rtol=0.02 if light == "sky image" else 1e-3)


def test_more_samples_than_triangles(variant: str) -> None:
    """A lamp of two triangles and 200 samples, and one of 320 triangles and one sample."""
    lamp = scenery(sky=None)
    many, few = (render(lamp, area_light_samples=count, soft_map_resolution=32) for count in (200, 32))
    assert difference(few, many) < 0.05
    ball = {"type": "sphere", "center": [0, 1.2, 0], "radius": 0.2, "emitter": area(2.0)}
    single = render(scenery(sky=None, lamp=ball), area_light_samples=1, soft_map_resolution=32)
    assert np.isfinite(single).all() and single.mean() > 0.01
