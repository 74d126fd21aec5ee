"""The G-buffer: its derivative in world space against that of the barycentrics, and the shortcuts that it takes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer
from shadowmap_dr.rendering.gbuffer.surface import normals_at
from shadowmap_dr.rendering.gbuffer.surface_points import SurfacePoints, hits_at, pixel_hits
from shadowmap_dr.scene.sensor import ImageSize

SIZE = 40


def build(kind: str) -> Renderer:
    """A smooth ball, a box and a wall before a camera of each kind."""
    to_world = mi.ScalarTransform4f().look_at([-2, 1.5, 4], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE + 4, "rfilter": {"type": "box"}}
    camera: dict[str, Any] = {"type": "perspective", "fov": 40, "principal_point_offset_x": 0.1, "to_world": to_world}
    if kind == "orthographic":
        camera = {"type": "orthographic", "to_world": to_world @ mi.ScalarTransform4f().scale([1.6, 1.6, 1])}
    scene = {
        "type": "scene",
        "camera": {**camera, "film": film},
        "sun": {"type": "directional", "direction": [0.3, -0.2, -1.0]},
        "ball": {"type": "sphere", "radius": 0.8},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([1.1, -0.2, 0.4]).rotate([0, 1, 0], 30).scale(0.4)},
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(4)},
    }
    return Renderer.from_scene(mi.load_dict(scene), tessellation=16, shadow_method="none")


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_derivatives_are_those_of_the_barycentrics(variant: str, kind: str) -> None:
    renderer = build(kind)
    geometry = renderer.data.geometry
    camera = renderer.data.sensors[0][0]
    count = SIZE * (SIZE + 4)
    rng = np.random.default_rng(3)
    weights = [mi.Float(rng.normal(size=count).astype(np.float32)) for _ in range(8)]

    def gradients(of: Any) -> tuple[list[np.ndarray], list[np.ndarray]]:
        p, rows = mi.Float(geometry.positions), mi.Matrix4f(camera.to_world.matrix)
        dr.enable_grad(p, rows)
        sensor = replace(camera, to_world=mi.Transform4f(rows))
        moved = replace(geometry, positions=p)
        cameras = renderer.camera_pass
        raster = cameras.view(sensor, cameras.placed(moved), 1).raster
        hits: SurfacePoints = of(moved, sensor, raster)
        _, normal = normals_at(moved, hits)
        values = [*hits.p_world, hits.u, hits.v, *normal]
        dr.backward(dr.sum(sum(dr.select(hits.active, x * w, 0) for x, w in zip(values, weights, strict=True))))
        # The last row of the matrix is constant; what it would do is of no interest.
        return [np.array(x) for x in values], [p.grad.numpy(), np.array(rows.grad)[:3].ravel()]

    want, want_gradients = gradients(lambda g, s, raster: hits_at(g, raster.triangle, raster.u, raster.v))
    got, got_gradients = gradients(lambda g, s, raster: pixel_hits(g, s, raster.triangle, ImageSize(raster.width, raster.height)))
    for k, (a, b) in enumerate(zip(want, got, strict=True)):
        # Points five units away agree to a few roundings, more where one sees a face nearly edge-on; in units of edges, some as
        # short as a thirtieth, that is as much more.
        np.testing.assert_allclose(b, a, atol=2e-5 if k < 3 else 1e-4)
    for a, b in zip(want_gradients, got_gradients, strict=True):
        assert np.abs(a).max() > 0.1
        np.testing.assert_allclose(b, a, atol=1e-3 * np.abs(a).max())


def test_shapes_that_do_not_move_leave_image_and_gradients_alone(variant: str) -> None:
    """Moving one shape of several takes shortcuts for the others; giving all of them new vertices takes none."""
    renderer = build("perspective")
    geometry = renderer.data.geometry
    assert {info.name for info in geometry.shapes if info.faceted} == {"box", "wall"}
    results = []
    for names in (["ball"], ["ball", "box", "wall"]):
        moving = {name: mi.Float(dr.ravel(geometry.shape_positions(name))) for name in names}
        dr.enable_grad(moving)
        image = renderer.render(moving)
        dr.backward(dr.sum(dr.square(image.array)))
        results.append((image.numpy(), moving["ball"].grad.numpy()))
    (image, gradient), (plain_image, plain_gradient) = results
    # New vertex normals of box and wall are those of their faces, up to rounding.
    np.testing.assert_allclose(image, plain_image, atol=1e-4)
    np.testing.assert_allclose(gradient, plain_gradient, atol=1e-3 * np.abs(gradient).max())


def test_tangents_make_no_difference_to_diffuse_materials(variant: str) -> None:
    renderer = build("perspective")
    assert not renderer.data.needs_frames
    with_frames = renderer.with_data(replace(renderer.data, needs_frames=True))
    np.testing.assert_allclose(renderer.render().numpy(), with_frames.render().numpy(), atol=1e-5)


def test_corners_of_triangles_are_those_of_their_vertices(variant: str) -> None:
    renderer = build("perspective")
    geometry, camera = renderer.data.geometry, renderer.data.sensors[0][0]
    count = SIZE * (SIZE + 4)
    assert geometry.in_packets(geometry.face_count).corners is None  # not worth it
    prepared = geometry.in_packets(4 * geometry.face_count)
    assert prepared.corners is not None and dr.width(prepared.corners) == 12 * geometry.face_count
    raster = renderer.camera_pass.view(camera, renderer.camera_pass.placed(geometry), 1).raster
    plain, packed = (pixel_hits(g, camera, raster.triangle, ImageSize(SIZE, SIZE + 4)) for g in (geometry, prepared))
    assert 0.3 < np.mean(plain.active.numpy()) < 1
    for name in ("face", "e1", "e2", "n_face", "u", "v", "p_world"):
        a, b = (np.array(getattr(hits, name))[..., plain.active.numpy()] for hits in (plain, packed))
        assert a.shape[-1] > 0.3 * count
        np.testing.assert_array_equal(b, a)
    # They are numbers of these positions only.
    moved = prepared.with_positions({"ball": geometry.shape_positions("ball") + 0.1})
    assert moved.corners is None


def textured(names: tuple[str, ...]) -> Renderer:
    """A ball and a block before a wall, with textures on some of them."""
    pattern = np.random.default_rng(5).uniform(0.1, 0.9, (5, 4, 3)).astype(np.float32)
    paint = {"type": "bitmap", "bitmap": mi.Bitmap(pattern), "raw": True}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at([-2, 1.5, 4], [0, 0, 0], [0, 1, 0])
    shapes = {
        "ball": {"type": "sphere", "radius": 0.8},
        "block": {
            "type": "cube",
            "to_world": mi.ScalarTransform4f().translate([1.1, -0.2, 0.4]).rotate([0, 1, 0], 30).scale(0.4),
        },
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(4)},
    }
    for name in names:
        shapes[name]["bsdf"] = {"type": "diffuse", "reflectance": paint}
    scene = {"type": "scene", "sun": {"type": "directional", "direction": [0.3, -0.2, -1.0]}, **shapes}
    return Renderer.from_scene(
        mi.load_dict({**scene, "camera": {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}}, optimize=False),
        tessellation=16,
    )


@pytest.mark.parametrize("moving", ["ball", "block", "camera", "sun"])
@pytest.mark.parametrize("names", [("wall",), ("ball",), ("wall", "block")])
def test_only_textures_at_rest_are_not_asked_for_derivatives(variant: str, names: tuple[str, ...], moving: str) -> None:
    """Derivative images against differences of images."""
    renderer = textured(names)
    assert {info.name for info in renderer.data.geometry.shapes if info.varied} == set(names)

    def image(x: mi.Float) -> Any:
        move = mi.Transform4f().translate([x, 0, 0]) @ mi.Transform4f().rotate([0, 1, 0], 20 * x)
        given: dict[str, Any] = {"transforms": {moving: move}}
        if moving == "camera":
            camera = renderer.data.sensors[0][0]
            given = {"sensor": replace(camera, to_world=move @ camera.to_world)}
        elif moving == "sun":
            light = renderer.light("sun")
            given = {"lights": {"sun": replace(light, direction=move @ light.direction)}}
        return renderer.render(spp=64, **given)

    x, step = mi.Float(0), 0.005
    dr.enable_grad(x)
    moved = image(x)
    dr.forward(x)
    got = moved.grad.numpy()
    want = (image(mi.Float(step)).numpy() - image(mi.Float(-step)).numpy()) / (2 * step)
    assert np.sum(got * want) / np.sqrt(np.sum(got**2) * np.sum(want**2)) > 0.97
    assert np.sum(got * want) / np.sum(want**2) == pytest.approx(1, abs=0.05)
