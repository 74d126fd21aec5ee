"""Shadow maps of a scene follow its moving parts and what is seen of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer, ShadowmapError


def sheet(n: int = 24, height: float = 0.0) -> mi.Mesh:
    """A 4 x 4 sheet of n x n quads, flat or with a bump in the middle."""
    g = np.linspace(-2, 2, n + 1)
    x, y = np.meshgrid(g, g)
    z = height * np.exp(-4 * (x * x + y * y))
    i = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    mesh = mi.Mesh("sheet", x.size, len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.stack([x, y, z], -1).ravel().astype(np.float32))
    params["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    params.update()
    return mesh


def scene_with(mesh: mi.Mesh, **more: dict) -> mi.Scene:
    """The sheet from above under an oblique sun."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 50,
                "to_world": mi.ScalarTransform4f().look_at([0, -3, 4], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}},
            },
            "sun": {"type": "directional", "direction": [1.5, 0.2, -1.0], "irradiance": 3.0},
            "sheet": mesh,
            **more,
        },
        optimize=False,
    )


def test_more_maps_than_arrays_can_hold_are_refused(variant: str) -> None:
    """Lanes are counted with 32 bits: beyond, indices would wrap around."""
    bulbs = {f"bulb{k}": {"type": "point", "position": [k, 0, 3], "intensity": 1.0} for k in range(6)}
    scene = scene_with(sheet(2), **bulbs)
    with pytest.raises(ShadowmapError, match="37 shadow maps of lights, 4096 x 4096 texels, 8 triangles, are too many: lower"):
        Renderer.from_scene(scene, shadow_map_resolution=4096)
    with pytest.raises(ShadowmapError, match="37 shadow maps of lights, 4096 x 4096"):
        Renderer.from_scene(scene, shadow_map_resolution=512, shadow_supersampling=8)
    Renderer.from_scene(scene, shadow_map_resolution=4096, shadow_method="none")
    with pytest.raises(ShadowmapError, match="maps of extended lights, 4096 x 4096 .*area_light_samples"):
        Renderer.from_scene(scene_with(sheet(2), sky={"type": "constant"}), soft_map_resolution=4096)


def test_a_flat_sheet_that_gets_a_bump_casts_its_shadow(variant: str) -> None:
    """A planar shape with nothing behind it gets no texels, but only for as long as it is planar."""
    flat, bumpy = (scene_with(sheet(height=h)) for h in (0.0, 0.8))
    name = "sheet"
    target = Renderer.from_scene(bumpy)
    moved = Renderer.from_scene(flat)
    vertices = target.data.geometry.shape_positions(name)
    image, want = moved.render({name: vertices}).numpy(), target.render().numpy()
    assert np.abs(want - moved.render().numpy()).max() > 0.1
    assert np.abs(image - want).mean() < 2e-3 * want.mean()


def test_texels_go_to_what_is_in_view(variant: str) -> None:
    """A floor that could cast shadows, but reaches far out of view, must not blur those in view."""
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.5]).scale(0.3)}
    thick = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.01]).scale([40, 40, 1])}
    floor = Renderer.from_scene(scene_with(sheet(), box=box))
    block = Renderer.from_scene(scene_with(sheet(), box=box, thick=thick))
    want, image = floor.render().numpy(), block.render().numpy()
    visible = want.sum(-1) > 0
    # The block reaches towards the light, too, so that its map has a larger range of depths than that of the box alone.
    assert np.abs(image - want)[visible].mean() < 0.025 * want[visible].mean()


def test_samples_per_pixel_are_checked(variant: str) -> None:
    renderer = Renderer.from_scene(scene_with(sheet()))
    with pytest.raises(ShadowmapError, match="spp is -3"):
        renderer.render(spp=-3)


def test_a_scene_without_sensors_is_rendered_with_a_camera_of_ones_own(variant: str) -> None:
    with_sensor = scene_with(sheet(height=0.8))
    camera = Renderer.from_scene(with_sensor).data.sensors[0][0]
    bare = mi.load_dict(
        {
            "type": "scene",
            "sun": {"type": "directional", "direction": [1.5, 0.2, -1.0], "irradiance": 3.0},
            "sheet": sheet(height=0.8),
        }
    )
    image = Renderer.from_scene(bare).render(sensor=camera).numpy()
    np.testing.assert_allclose(image, Renderer.from_scene(with_sensor).render().numpy(), atol=1e-5)


@pytest.mark.parametrize("height", [0.43, 0.5, 0.61, 0.77, 0.95, 1.3])
def test_floor_seen_from_close_by_is_lit(variant: str, height: float) -> None:
    """All that is seen lies at the same depth, whose range is narrow, and the near plane is close: rounding must not matter."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    look = T().look_at([0, 0.4, 0], [0, 0, 0], [0, 0, 1]) @ T().scale([0.05, 0.05, 1])
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "orthographic", "near_clip": 0.01, "to_world": look, "film": film},
            "floor": {"type": "rectangle", "to_world": T().rotate([1, 0, 0], -90) @ T().scale(3)},
            "bulb": {"type": "point", "position": [0.01, height, 0.01]},
        }
    )
    shadowed, plain = (Renderer.from_scene(scene, shadow_method=method).render().numpy() for method in ("auto", "none"))
    np.testing.assert_allclose(shadowed, plain, rtol=1e-3)


def lit(parts: dict, look: tuple, **options: str) -> tuple[np.ndarray, np.ndarray]:
    """Image of a scene and Mitsuba's, without indirect light."""
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}}
    look = mi.ScalarTransform4f().look_at(*look, [0, 0, 1])
    camera = {"type": "perspective", "fov": 45, "to_world": look, "film": film}
    scene = mi.load_dict({"type": "scene", "camera": camera, **parts}, optimize=False)
    direct = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
    return np.array(Renderer.from_scene(scene, **options).render(spp=4)), np.array(mi.render(scene, integrator=direct, spp=64))


def wall(to_world: mi.ScalarTransform4f) -> dict:
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "bsdf": white}}


@pytest.mark.parametrize("width", [3, 8], ids=["narrower", "wider"])
@pytest.mark.parametrize("x", [3.0, 4.2, 4.6])
def test_walls_near_the_end_of_a_floor_cast_shadows(variant: str, x: float, width: float) -> None:
    """Little of the floor lies behind them, but not because it has sunk in."""
    T = mi.ScalarTransform4f
    parts = {
        "floor": wall(T().scale(5)),
        "wall": wall(T().translate([x, 0, 0.5]).rotate([0, 1, 0], 90).scale([0.5, width, 1])),
        "sun": {"type": "directional", "direction": [1, 0, -1], "irradiance": 3.0},
    }
    found, expected = lit(parts, ([12, -6, 10], [3.5, 0, 0]))
    assert np.abs(found - expected).mean() < 0.015 * expected.mean()
    assert (np.abs(found - expected).max(2) > 0.25 * expected.max()).mean() < 0.003


@pytest.mark.parametrize("size", [10, 1000, 10_000])
def test_cards_above_floors_of_any_size_cast_shadows(variant: str, size: float) -> None:
    T = mi.ScalarTransform4f
    sun = {"type": "directional", "direction": [0.3, 0, -1], "irradiance": 3.0}
    parts = {"floor": wall(T().scale(size)), "card": wall(T().translate([0, 0, 1])), "sun": sun}
    found, expected = lit(parts, ([4, -6, 5], [0, 0, 0]))
    assert np.abs(found - expected).mean() < 0.01 * expected.mean()


@pytest.mark.parametrize("size", [5, 10_000])
def test_beams_meet_what_is_near_them_in_scenes_of_any_size(variant: str, size: float) -> None:
    T = mi.ScalarTransform4f
    glow = {"type": "directionalarea", "radiance": {"type": "rgb", "value": 3.0}}
    parts = {
        "floor": wall(T().scale(size)),
        "cube": {"type": "cube", "to_world": T().translate([0, 0, 2]).scale(0.3)},
        "lamp": {"type": "rectangle", "to_world": T().translate([0, 0, 4]).rotate([1, 0, 0], 180), "glow": glow},
    }
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}}
    look = T().look_at([2, -3, 1], [0, 0, 0], [0, 0, 1])
    parts["camera"] = {"type": "perspective", "fov": 40, "to_world": look, "film": film}
    scene = mi.load_dict({"type": "scene", **parts}, optimize=False)
    image = np.array(Renderer.from_scene(scene, aovs=("visibility", "position")).render())
    place = np.abs(image[..., 4:6]).max(2)
    floor = (np.abs(image[..., 6]) < 0.01) & (place > 0)  # where nothing is seen, the place is 0
    below, beside = floor & (place < 0.15), floor & (place > 0.5) & (place < 0.8)
    assert below.any() and beside.any()
    assert image[below, 3].max() < 0.05 and image[beside, 3].min() > 0.9


@pytest.mark.parametrize("method", ["auto", "vsm", "msm"])
def test_floors_seen_at_grazing_angles_are_lit(variant: str, method: str) -> None:
    """Look-ups all over a pixel that is many times as long as wide lie on the floor, too."""
    parts = {
        "floor": wall(mi.ScalarTransform4f().scale(10)),
        "ball": {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.6},
        "bulb": {"type": "point", "position": [-2, -3, 3], "intensity": 40.0},
    }
    found, expected = lit(parts, ([4, -6, 1.5], [0, 0, 1]), shadow_method=method)
    assert np.abs(found - expected).mean() < 0.012 * expected.mean()


@pytest.mark.parametrize("light", ["point", "spot"])
def test_no_line_where_a_floor_leaves_the_depth_range(variant: str, light: str) -> None:
    """Maps tell depths apart up to the last caster; the floor goes on behind that, and is lit on both sides."""
    place, centre, half, turn = np.array([2.81, 2.9, 2.35]), [0, 0, 1.22], np.array([1.32, 0.34, 0.28]), 82.4
    T = mi.ScalarTransform4f
    emitters = {
        "point": {"type": "point", "position": place.tolist()},
        "spot": {"type": "spot", "to_world": T().look_at(place.tolist(), centre, [0, 0, 1]), "cutoff_angle": 50},
    }
    view = T().look_at([0.1, -2.5, 5], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 60, "to_world": view, "film": film},
            "floor": {"type": "rectangle", "to_world": T().scale([3, 3, 1])},
            "box": {"type": "cube", "to_world": T().translate(centre).rotate([0, 0, 1], turn).scale(half.tolist())},
            "light": emitters[light],
        },
        optimize=False,
    )
    image = Renderer.from_scene(scene, aovs=("position", "visibility")).render().numpy()
    p, visibility = image[..., 3:6].astype(np.float64), image[..., 6]
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    axes = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])

    def meets(more: float) -> np.ndarray:
        """True if the way to the light passes through the box, made larger on all sides (slabs)."""
        ends = np.stack([(sign * (half + more) - (p - centre) @ axes.T) / ((place - p) @ axes.T) for sign in (-1, 1)])
        return ends.min(0).max(-1) <= ends.max(0).min(-1)

    floor = (np.abs(p[..., 2]) < 1e-4) & (np.abs(p[..., :2]).max(-1) < 2.9)
    lit, shadowed = floor & ~meets(0.15), floor & meets(-0.1)
    assert lit.sum() > 1000 and visibility[lit].min() > 0.99
    assert shadowed.sum() > 50 and visibility[shadowed].max() < 0.05


@pytest.mark.parametrize("distance", [10, 1000])
def test_shadows_of_far_point_lights_are_as_sharp_as_those_of_near_ones(variant: str, distance: float) -> None:
    """Maps of a point light cover the casters, as those of others do, however small they are as seen from the light."""
    towards, film = np.array([-1.5, -2, 4]), {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}}
    view = mi.ScalarTransform4f().look_at([1.5, -3.5, 2.5], [0, 0, 0.3], [0, 0, 1])
    scene = mi.load_dict(
        {
            "type": "scene",
            "camera": {"type": "perspective", "fov": 45, "to_world": view, "film": film},
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([3, 3, 1])},
            "ball": {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.6},
            "lamp": {"type": "point", "position": (distance * towards).tolist(), "intensity": 30.0 * distance**2},
        },
        optimize=False,
    )
    ours = mi.render(scene, integrator=mi.load_dict({"type": "shadowmap"}), spp=16).numpy()
    traced = mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=256).numpy()
    assert np.abs(ours - traced).mean() < 0.006 * traced.mean()


@pytest.mark.parametrize("moved", [False, True], ids=["loaded", "moved"])
def test_vertices_without_faces_leave_maps_as_they_are(variant: str, moved: bool) -> None:
    """Vertices that nobody sees, a hundred thousand units away: maps would stretch to them."""

    def render(stray: bool) -> tuple[np.ndarray, np.ndarray]:
        vertices = np.array([[-1, -1, 1], [1, -1, 1], [0, 1, 1.2]], np.float32)
        if stray:
            vertices = np.vstack([[1e5, 2e5, 3e5], vertices, [-1e5, 0, 0]]).astype(np.float32)
        mesh = mi.Mesh("card", len(vertices), 1)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float(vertices.ravel())
        params["faces"] = mi.UInt32([1, 2, 3] if stray else [0, 1, 2])
        params.update()
        scene = mi.load_dict({
            "type": "scene",
            "camera": {
                "type": "perspective", "to_world": mi.ScalarTransform4f().look_at([3, 0, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}},
            },
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4)},
            "card": mesh,
            "sun": {"type": "directional", "direction": [0.2, 0.1, -1], "irradiance": 3.0},
        })  # fmt: skip
        renderer = Renderer.from_scene(scene, shadow_map_resolution=64)
        start = mi.Float((vertices + [0.3, 0, 0]).astype(np.float32).ravel())
        dr.enable_grad(start)
        image = renderer.render(vertex_positions={"card": start} if moved else None)
        if not moved:
            return np.array(image), np.zeros(0)
        dr.backward(dr.sum(dr.square(image.array)))
        gradient = np.array(dr.grad(start)).reshape(-1, 3)
        return np.array(image), gradient[1:4] if stray else gradient

    (with_image, with_gradient), (image, gradient) = render(True), render(False)
    assert image.std() > 0.05
    assert np.abs(with_image - image).max() < 1e-5
    assert np.abs(with_gradient - gradient).max(initial=0) <= 1e-4 * np.abs(gradient).max(initial=0)


def test_what_is_thin_in_a_large_image_keeps_its_shadow(variant: str) -> None:
    """A bar three pixels thick, along the rows of the image, in the shadow of a plate: its depths belong to the map's range."""
    size, place = 512, mi.ScalarTransform4f
    row = 2 - 260.5 * 4 / size  # of which one pixel in four was looked at, not this
    bar = {"type": "rectangle", "to_world": place().translate([0, row, 2]).scale([1.8, 6 / size, 1])}
    plate = {"type": "rectangle", "to_world": place().translate([2.2, 0, 2.6]).scale([1.2, 0.9, 1])}
    view = place().look_at([-0.2, 0, 2.5], [-0.2, 0, 0], [0, 1, 0]) @ place().scale([2, 2, 1])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    parts = {
        "floor": {"type": "rectangle", "to_world": place().scale(4)},
        "sun": {"type": "directional", "direction": [-1, 0, -0.6]},
        "camera": {"type": "orthographic", "to_world": view, "near_clip": 0.01, "far_clip": 10.0, "film": film},
    }
    scene = mi.load_dict({"type": "scene", **parts, "bar": bar, "plate": plate})
    integrator = mi.load_dict({"type": "shadowmap", "aovs": "visibility"})
    visibility = mi.render(scene, integrator=integrator).numpy()[259:262, 30:480, -1]
    dark = mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=4).numpy()[259:262, 30:480, 0] == 0
    assert 500 < dark.sum() < 800
    assert (visibility[dark] < 0.5).mean() > 0.95
