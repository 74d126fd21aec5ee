"""Large scenes under the sun: tiles of maps, and derivatives by a sun that turns about a far origin. References are Mitsuba's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.maps.scenes import box, merged

Array = npt.NDArray[np.float64]
SIZE = 128
#: Offset of the town from the world's origin, about which the sun turns.
FAR = np.array([900.0, -400.0, 0.0])
ELEVATION = np.radians(40)


def sun_direction(azimuth: float) -> list[float]:
    return [-np.cos(azimuth) * np.cos(ELEVATION), -np.sin(azimuth) * np.cos(ELEVATION), -np.sin(ELEVATION)]


def town(azimuth: float = 0.5, size: int = SIZE) -> mi.Scene:
    """12 x 12 houses of different heights on a ground of 240 x 240, seen from the air."""
    generator = np.random.default_rng(3)
    houses = []
    for i in range(12):
        for j in range(12):
            x, y, h = 20 * i - 110, 20 * j - 110, generator.uniform(4, 14)
            houses.append(box((x - 4, y - 4, 0), (x + 4, y + 4, h)))
    points, faces = merged(houses)
    mesh = mi.Mesh("houses", len(points), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = (points + FAR).astype(np.float32).ravel(), faces.ravel()
    parameters.update()
    t = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = t().look_at((FAR + [-150, -150, 90]).tolist(), FAR.tolist(), [0, 0, 1])
    return mi.load_dict({
        "type": "scene",
        "sun": {"type": "directional", "direction": sun_direction(azimuth), "irradiance": 3.0},
        "sensor": {"type": "perspective", "fov": 50, "near_clip": 0.5, "far_clip": 10000, "to_world": view, "film": film},
        "ground": {"type": "rectangle", "to_world": t().translate(FAR.tolist()).scale(120)},
        "houses": mesh,
    }, optimize=False)  # fmt: skip


def traced(scene: mi.Scene, spp: int, seed: int = 0) -> Array:
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=spp, seed=seed), np.float64)


def turned(renderer: Renderer, azimuth: Any) -> Any:
    """The image for a sun at an azimuth (Float), attached."""
    light = renderer.data.lights[0]
    across, down = float(np.cos(ELEVATION)), float(np.sin(ELEVATION))
    direction = mi.Vector3f(-dr.cos(azimuth) * across, -dr.sin(azimuth) * across, mi.Float(-down))
    return renderer.render(lights={light.name: replace(light, direction=direction)})


def box_blur(image: Array, side: int = 5) -> Array:
    padded = np.pad(image.sum(-1), side // 2, mode="edge")
    return np.lib.stride_tricks.sliding_window_view(padded, (side, side)).mean((-1, -2))


@pytest.mark.usefixtures("variant")
def test_tiles_make_shadows_as_sharp_as_maps_with_as_many_texels() -> None:
    """Light in shadow and darkness in light: with four maps of 64 texels no more than with one of 128, and half of one of 64."""
    scene = town()
    reference, bare = traced(scene, 64), np.array(Renderer.from_scene(scene, shadow_method="none").render(), np.float64)
    lit = bare.max(-1) > 0.2 * bare.max()
    dark = lit & (reference.max(-1) < 0.02 * bare.max())
    full = lit & (np.abs(reference - bare).max(-1) < 0.02 * bare.max())
    faults = {}
    for name, tiles, texels in (("tiles", 4, 64), ("one", 1, 64), ("fine", 1, 128)):
        renderer = Renderer.from_scene(scene, shadow_map_resolution=texels, shadow_tiles=tiles)
        assert renderer.plan.tiles == (tiles,)
        share = np.array(renderer.render(), np.float64).max(-1) / np.maximum(bare.max(-1), 1e-6)
        faults[name] = share[dark].mean(), 1 - share[full].mean()
    for k in range(2):
        assert faults["tiles"][k] <= 1.02 * faults["fine"][k] and faults["tiles"][k] < 0.6 * faults["one"][k]


@pytest.mark.usefixtures("variant")
def test_automatic_maps_follow_the_film() -> None:
    """Small films have one map, larger ones several; a given number of texels is that of one map."""
    assert Renderer.from_scene(town(size=64)).plan.tiles == (1,)
    large = Renderer.from_scene(town(size=512))
    assert large.plan.tiles[0] >= 4 and large.settings.shadow.resolution == 256
    assert large.texels == large.plan.tiles[0] * 256**2
    assert Renderer.from_scene(town(size=512), shadow_tiles=3).plan.tiles == (2,)
    assert Renderer.from_scene(town(size=512), shadow_map_resolution=256).plan.tiles == (1,)
    with pytest.raises(ShadowmapError, match="shadow tiles are 17; they must lie between 1 and 16"):
        Renderer.from_scene(town(), shadow_tiles=17)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("size", "settings"),
    [(128, {"shadow_map_resolution": 1024}), (256, {"shadow_map_resolution": 128, "shadow_tiles": 4})],
    ids=["one map", "tiles"],
)
def test_a_sun_that_turns_about_a_far_origin(size: int, settings: dict[str, int]) -> None:
    """Derivatives do not suffer from the way of the town through the map, which is fifty times that of the shadows."""
    angle, step = 0.5, 0.04
    pair = [traced(town(angle + sign * step, size), 256) for sign in (1, -1)]
    expected = box_blur((pair[0] - pair[1]) / (2 * step))
    renderer = Renderer.from_scene(town(angle, size), **settings)
    assert renderer.plan.tiles == (settings.get("shadow_tiles", 1),)
    t = mi.Float(angle)
    dr.enable_grad(t)
    image = turned(renderer, t)
    dr.forward(t)
    found = box_blur(np.array(dr.grad(image), np.float64))
    assert (found * expected).sum() > 0.97 * np.linalg.norm(found) * np.linalg.norm(expected)
    assert (found * expected).sum() == pytest.approx((expected**2).sum(), rel=0.05)


@pytest.mark.usefixtures("variant")
def test_both_modes_agree_across_tiles() -> None:
    """By the sun and by all houses' places at once."""
    renderer = Renderer.from_scene(town(), shadow_map_resolution=64, shadow_tiles=4)
    rest = renderer.data.geometry.shape_positions("houses")
    weight = np.random.default_rng(1).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
    motion = mi.Float(np.random.default_rng(2).normal(size=dr.width(rest)).astype(np.float32))
    light = renderer.data.lights[0]

    def image(t: Any, s: Any) -> Any:
        direction = mi.Vector3f(light.direction) + t * mi.Vector3f(0.3, -0.2, 0.1)
        return renderer.render({"houses": rest + s * motion}, lights={light.name: replace(light, direction=direction)})

    for own in ((1.0, 0.0), (0.0, 1.0)):
        t = mi.Float(0)
        dr.enable_grad(t)
        made = image(own[0] * t, own[1] * t)
        dr.forward(t)
        forward = float((weight * np.array(dr.grad(made), np.float64)).sum())
        s = mi.Float(0)
        dr.enable_grad(s)
        dr.backward(dr.sum(image(own[0] * s, own[1] * s) * mi.TensorXf(weight), axis=None))
        assert float(dr.grad(s)[0]) == pytest.approx(forward, rel=2e-3)


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize("number", [2, 4, 8])
def test_numbers_of_tiles_that_are_selected_or_gathered(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Large images select the numbers of a point's tile from those of all tiles, small ones gather them: the same image, and the
    same derivatives by the houses' places."""
    renderer = Renderer.from_scene(town(), shadow_map_resolution=64 if number < 8 else 32, shadow_tiles=number)
    assert renderer.plan.maps == number
    rest = renderer.data.geometry.shape_positions("houses")
    weight = mi.TensorXf(np.random.default_rng(1).normal(size=(SIZE, SIZE, 3)).astype(np.float32))
    found = []
    for least in (1, 1 << 30):
        monkeypatch.setattr("shadowmap_dr.shadow.light_camera._MANY", least)
        places = mi.Point3f(rest)
        dr.enable_grad(places)
        image = renderer.render({"houses": places})
        dr.backward(dr.sum(image * weight, axis=None))
        found.append((np.array(image), np.array(dr.grad(places))))
    assert np.abs(found[0][1]).max() > 0
    for selected, gathered in zip(*found, strict=True):
        np.testing.assert_allclose(selected, gathered, atol=1e-4 * np.abs(gathered).max())


@pytest.mark.usefixtures("variant")
def test_frozen_steps_with_tiles() -> None:
    """A recording replays with a turning sun, and equals the step that is not recorded."""
    renderer, plain = (Renderer.from_scene(town(), shadow_map_resolution=64, shadow_tiles=4) for _ in range(2))

    @dr.freeze
    def step(own: Renderer, azimuth: Any, target: Any) -> Any:
        dr.enable_grad(azimuth)
        loss = dr.mean(dr.square(turned(own, azimuth) - target), axis=None)
        dr.backward(loss)
        return loss, dr.grad(azimuth)

    target = mi.TensorXf(traced(town(0.6), 16).astype(np.float32))
    for k in range(6):
        angle = 0.5 + 0.01 * k
        loss, gradient = step(renderer, dr.opaque(mi.Float, angle), target)
        azimuth = mi.Float(angle)
        dr.enable_grad(azimuth)
        expected = dr.mean(dr.square(turned(plain, azimuth) - target), axis=None)
        dr.backward(expected)
        assert float(loss.array[0]) == pytest.approx(float(expected.array[0]), rel=1e-4)
        assert float(gradient[0]) == pytest.approx(float(dr.grad(azimuth)[0]), rel=1e-2, abs=1e-5)
    assert step.n_recordings <= 2


@pytest.mark.usefixtures("variant")
def test_spots_have_tiles() -> None:
    """A wide spot over the town: with four maps of 64 texels shadows are as sharp as with one of 128."""
    scene = town()
    lamp = {"type": "spot", "intensity": 3e4, "cutoff_angle": 55, "beam_width": 54,
            "to_world": mi.ScalarTransform4f().look_at((FAR + [30, 20, 90]).tolist(), FAR.tolist(), [0, 1, 0])}  # fmt: skip
    shapes = {shape.id(): shape for shape in scene.shapes()}
    lit = mi.load_dict({"type": "scene", "lamp": lamp, "sensor": scene.sensors()[0], **shapes}, optimize=False)
    images = {}
    for name, tiles, texels in (("tiles", 4, 64), ("one", 1, 64), ("fine", 1, 128), ("finest", 1, 1024)):
        renderer = Renderer.from_scene(lit, shadow_map_resolution=texels, shadow_tiles=tiles)
        assert renderer.plan.kinds == ("spot",) and renderer.plan.tiles == (tiles,)
        images[name] = np.array(renderer.render(), np.float64)
    error = {name: np.abs(image - images["finest"]).mean() for name, image in images.items()}
    assert error["tiles"] < 1.02 * error["fine"] and error["tiles"] < 0.6 * error["one"]


@pytest.mark.usefixtures("variant")
def test_memory_bounds_the_maps() -> None:
    """Fewer maps where all would take more than `light_memory`; images of other sizes have other numbers of maps."""
    scene = town(size=512)
    assert Renderer.from_scene(scene, light_memory=0.012).plan.tiles == (1,)
    whole = Renderer.from_scene(scene)
    assert whole.with_maps_for(64**2).plan.tiles == (1,) and whole.with_maps_for(1024**2).plan.maps > whole.plan.maps
    assert whole.with_maps_for(spp=4).plan == whole.with_maps_for(1024**2).plan
    again = whole.with_maps_for(64**2).with_maps_for()
    assert again.plan.tiles == whole.plan.tiles and not again.slices
    assert np.array_equal(np.array(again.render()), np.array(Renderer.from_scene(scene).render()))


@pytest.mark.usefixtures("variant")
def test_recordings_do_not_walk_through_the_scene() -> None:
    """Dr.Jit would look at all buffers of all meshes at each call of a frozen function."""
    renderer = Renderer.from_scene(town())
    leaves = renderer.recording_parts[1]
    assert any(isinstance(leaf, mi.BSDF) for leaf in leaves)
    assert not any(isinstance(leaf, mi.Scene | mi.Shape) for leaf in leaves)
    frozen = dr.freeze(lambda renderer: renderer.refresh().render())
    with pytest.raises(RuntimeError) as failure:
        frozen(renderer)
    assert "a frozen function does not read the scene" in str(failure.value.__cause__ or failure.value)


def _board(size: int) -> tuple[mi.Scene, Array]:
    """A turned board, behind the camera, above a floor; and the share (size, size) of each pixel that its shadow covers."""
    t, light, height = mi.ScalarTransform4f, np.array([0.3, 0.2, -1.0]), 1.0
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = t().look_at([0, 0, 0.5], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict({
        "type": "scene",
        "sun": {"type": "directional", "direction": light.tolist(), "irradiance": 3.0},
        "sensor": {"type": "orthographic", "to_world": view, "film": film},
        "floor": {"type": "rectangle"},
        "board": {"type": "rectangle", "to_world": t().translate([0, 0, height]).rotate([0, 0, 1], 20).scale([0.45, 0.3, 1])},
    }, optimize=False)  # fmt: skip
    side, angle = 16 * size, np.radians(20)
    centres = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = centres[None, :] - height * light[0], -centres[:, None] - height * light[1]
    across, up = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    inside = (abs(across) < 0.45) & (abs(up) < 0.3)
    return scene, inside.reshape(size, 16, size, 16).mean((1, 3))


@pytest.mark.usefixtures("variant")
def test_edges_of_tiles_are_as_sharp_as_pixels_and_their_derivatives_exact() -> None:
    """Against coverage by brute force, and the change of a rectangle's area with its size."""
    size = 128
    scene, covered = _board(size)
    renderer = Renderer.from_scene(scene, shadow_map_resolution=64, shadow_tiles=4, shadow_filter_size=1)
    assert renderer.plan.tiles == (2,)  # for the part of the image that the map covers
    lit = np.array(Renderer.from_scene(scene, shadow_method="none").render(), np.float64)[..., 0]
    seen = np.array(renderer.render(), np.float64)[..., 0] / lit
    border = np.isin(np.arange(size), (0, size - 1))
    inner = ~(border[:, None] | border[None])
    assert np.sqrt(((seen - 1 + covered) ** 2)[inner].mean()) < 0.03
    rim = np.lib.stride_tricks.sliding_window_view(np.pad(covered, 1, mode="edge"), (3, 3))
    for whole, least, wrong in ((covered == 1, rim.min((-1, -2)), seen), (covered == 0, 1 - rim.max((-1, -2)), 1 - seen)):
        beside = whole & (least < 1) & inner
        assert beside.sum() > 100 and wrong[beside].mean() < 0.005  # 0.02 if edges took two texels
    rest = renderer.data.geometry.shape_positions("board")
    centre = mi.Point3f(0, 0, 1)
    scale, pixels = mi.Float(1), (size / 2) ** 2
    dr.enable_grad(scale)
    image = renderer.render({"board": centre + scale * (rest - centre)})
    dr.forward(scale, flags=dr.ADFlag.ClearEdges)
    forward = (np.array(dr.grad(image), np.float64)[..., 0] / lit).sum()
    assert forward == pytest.approx(-2 * 0.9 * 0.6 * pixels, rel=0.01)
    weight = mi.TensorXf((np.eye(3)[0] / lit[..., None]).astype(np.float32))
    dr.set_grad(scale, 0)
    dr.backward(dr.sum(renderer.render({"board": centre + scale * (rest - centre)}) * weight, axis=None))
    assert float(dr.grad(scale)[0]) == pytest.approx(forward, rel=1e-3)
