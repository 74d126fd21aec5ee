"""Loading scenes: names, buffers, tessellation, re-reading, and what is refused."""

from __future__ import annotations

import warnings
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import ShadowmapError
from shadowmap_dr.io import assets
from shadowmap_dr.rendering.gbuffer.surface import surface
from shadowmap_dr.scene import load as scene_module
from shadowmap_dr.scene.descriptions import Parts, describe_all
from shadowmap_dr.scene.load import load, refresh
from shadowmap_dr.scene.mitsuba_objects import children, is_even
from shadowmap_dr.scene.shapes.sources import MeshSource

EXAMPLES = ["pose", "gallery", "still_life", "pavilion", "meadow", "leafy_tree", "stained_window", "curtain"]
TRANSLUCENT = ("meadow", "leafy_tree", "stained_window", "curtain")


@pytest.mark.parametrize("optimize", [False, True], ids=["apart", "merged"])
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_scenes(variant: str, name: str, optimize: bool) -> None:
    scene = mi.load_file(str(assets.scene(name)), optimize=optimize, resolution=32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = load(scene)
    geometry = data.geometry
    faces = geometry.faces.numpy().reshape(-1, 3)
    assert len(faces) == geometry.face_count and len(geometry.positions) == 3 * geometry.vertex_count
    for index, info in enumerate(geometry.shapes):
        own = slice(info.face_start, info.face_start + info.face_count)
        assert np.all(geometry.face_shape.numpy()[own] == index)
        assert faces[own].min() >= info.vertex_start and faces[own].max() < info.vertex_start + info.vertex_count
        assert np.all(geometry.vertex_shape.numpy()[faces[own]] == index)
    assert len({info.name for info in geometry.shapes}) == len(geometry.shapes)
    assert any(info.see_through for info in geometry.shapes) == (name in TRANSLUCENT)
    p = geometry.positions.numpy().reshape(-1, 3)
    # The bounding box of a merged scene is too small in Mitsuba 3.9.
    box = mi.load_file(str(assets.scene(name)), optimize=False, resolution=32).bbox()
    # Inscribed tessellations stay inside, and reach the box where a vertex lies on it.
    assert np.all(p.min(0) >= np.array(box.min) - 1e-4) and np.all(p.max(0) <= np.array(box.max) + 1e-4)
    assert np.allclose([p.min(0), p.max(0)], [box.min, box.max], atol=0.02)
    assert len(data.lights) == len(scene.emitters()) and len(data.sensors) == len(scene.sensors())


ANALYTIC: dict[str, dict[str, Any]] = {
    "sphere": {"center": [0.3, -0.2, 0.4], "radius": 0.8},
    "disk": {},
    "cylinder": {"p0": [0.1, 0, -0.4], "p1": [0.2, 0.7, 0.3], "radius": 0.5},
}


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("kind", ANALYTIC)
def test_tessellation_agrees_with_the_analytic_shape(variant: str, kind: str, flip: bool, mirror: bool) -> None:
    """Shoot Mitsuba's rays at the middles of the triangles; compare position, normals, uv and partial derivatives."""
    to_world = mi.ScalarTransform4f().translate([0.2, 0.1, -0.3]).rotate([0, 0.6, 0.8], 40).scale(1.3)
    if mirror:
        to_world = to_world @ mi.ScalarTransform4f().scale([-1, 1, 1])
    shape = {"type": kind, **ANALYTIC[kind], "flip_normals": flip, "to_world": to_world}
    camera = {"type": "perspective", "to_world": mi.ScalarTransform4f().look_at([3, 4, 5], [0, 0, 0], [0, 1, 0])}
    scene = mi.load_dict({"type": "scene", "shape": shape, "camera": camera})
    data = load(scene, tessellation=200)
    count = data.geometry.face_count
    third = dr.full(mi.Float, 1 / 3, count)
    seen = surface(data, data.geometry, data.sensors[0][0], dr.arange(mi.UInt32, count), third, third)
    origin = data.sensors[0][0].origin
    si = scene.ray_intersect(mi.Ray3f(origin, dr.normalize(seen.p_world - origin)))
    # Those that the camera sees, not at the silhouette.
    near = dr.norm(si.p - seen.p_world) < 5e-3
    facing = dr.abs(dr.dot(dr.normalize(origin - seen.p_world), si.n)) > 0.3
    use = (near & facing & si.is_valid()).numpy()
    assert use.mean() > 0.3
    for name, ours, mitsubas, tolerance in (
        ("n", seen.n_world, si.n, 0.03),
        ("n_shading", seen.si.sh_frame.n, si.sh_frame.n, 3e-3),
        ("wi", seen.si.wi, si.wi, 0.02),
        ("dp_du", dr.normalize(seen.si.dp_du), dr.normalize(si.dp_du), 0.05),
        ("dp_dv", dr.normalize(seen.si.dp_dv), dr.normalize(si.dp_dv), 0.05),
        ("stretch", dr.norm(seen.si.dp_du) / dr.norm(si.dp_du), dr.full(mi.Float, 1.0, count), 0.1),
        ("uv", seen.si.uv, si.uv, 5e-3),
    ):
        difference = np.abs(ours.numpy() - mitsubas.numpy())[..., use]
        # Triangles around a pole have their own idea of how long dp_du is; at a seam a few rays fall on the neighbour.
        assert np.mean(difference.reshape(-1, use.sum()).max(0) > tolerance) < (0.1 if name == "stretch" else 0.03), name


@pytest.mark.parametrize("count", [1, 16], ids=["few", "many"])
def test_normals_of_stretched_shapes_are_perpendicular(variant: str, count: int) -> None:
    """Spheres that become ellipsoids, whose normals are gradients of |inverse(M) (p - c)|^2. Many shapes are placed together."""
    place = mi.ScalarTransform4f().translate([0.2, 0.1, -0.3]).rotate([0.6, 0, 0.8], 30).scale([0.5, 1, 2])
    copy = {"type": "instance", "to_world": place, "group": {"type": "ref", "id": "group"}}
    group = {"type": "shapegroup", "ball": {"type": "sphere"}}
    scene = mi.load_dict({"type": "scene", "group": group, **{f"copy{k}": copy for k in range(count)}}, optimize=False)
    data = load(scene, tessellation=12)
    assert (data.soup is not None) == (count > 1)
    matrix = np.array(place.matrix, np.float64)
    points, normals = (buffer.numpy().reshape(-1, 3) for buffer in (data.geometry.positions, data.geometry.normals))
    gradient = (points - matrix[:3, 3]) @ np.linalg.inv(matrix[:3, :3] @ matrix[:3, :3].T)
    np.testing.assert_allclose(normals, gradient / np.linalg.norm(gradient, axis=1, keepdims=True), atol=1e-4)


def test_tessellation_size(variant: str) -> None:
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    assert load(scene, tessellation=8).geometry.face_count == 8 * (4 - 1) * 2
    p = load(scene, tessellation=8).geometry.positions.numpy().reshape(-1, 3)
    assert np.allclose(np.linalg.norm(p, axis=1), 1, atol=1e-6)
    for wrong in (2, 6.5, "many"):
        with pytest.raises(ShadowmapError, match="tessellation"):
            load(scene, tessellation=wrong)


def test_unnamed_shapes_lights_and_sensors_get_names(variant: str) -> None:
    scene = mi.load_string(
        '<scene version="3.0.0"><emitter type="point"/><emitter type="point"/><sensor type="perspective"/>'
        '<shape type="cube"/><shape type="sphere"/></scene>'
    )
    data = load(scene)
    assert [info.name for info in data.geometry.shapes] == ["shape_0", "shape_1"]
    assert [light.name for light in data.lights] == ["light_0", "light_1"]
    assert data.light("light_1") is data.lights[1]
    with pytest.raises(ShadowmapError, match="'sun'.*'light_0'"):
        data.light("sun")


@pytest.mark.parametrize("kind", ["mesh", "rectangle", "sphere", "disk", "cylinder", "instance"])
def test_refresh_reads_attached_parameters(variant: str, kind: str) -> None:
    """A parameter of the scene moves everything that depends on it, with gradients."""
    shapes: dict[str, Any] = {
        "mesh": {"thing": {"type": "cube"}},
        "rectangle": {"thing": {"type": "rectangle"}},
        **{name: {"thing": {"type": name}} for name in ("sphere", "disk", "cylinder")},
        "instance": {
            "group": {"type": "shapegroup", "box": {"type": "cube"}},
            "thing": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        },
    }
    scene = mi.load_dict(
        {"type": "scene", **shapes[kind], "lamp": {"type": "point"}, "eye": {"type": "perspective"}}, optimize=False
    )
    data = load(scene)
    before = data.geometry.positions.numpy().copy()
    params = mi.traverse(scene)
    x = mi.Float(0.25)
    dr.enable_grad(x)
    if kind == "mesh":
        positions = dr.unravel(mi.Point3f, params["thing.vertex_positions"])
        params["thing.vertex_positions"] = dr.ravel(positions + mi.Vector3f(x, 0, 0))
    else:
        params["thing.to_world"] = mi.Transform4f().translate([x, 0, 0])
    params["lamp.position"] = mi.Point3f(0, x, 0)
    params["eye.to_world"] = mi.Transform4f().translate([0, 0, 3 * x])
    params.update()
    moved = refresh(data)
    assert np.allclose((moved.geometry.positions - data.geometry.positions).numpy().reshape(-1, 3), [0.25, 0, 0], atol=1e-6)
    light, sensor = moved.lights[0], moved.sensors[0][0]
    dr.backward(dr.sum(moved.geometry.positions) + 1000 * light.position.y + 1e6 * sensor.origin.z)
    assert np.allclose(x.grad.numpy(), moved.geometry.vertex_count + 1000 + 3e6)
    assert np.array_equal(data.geometry.positions.numpy(), before)


def test_all_instances_of_a_mesh_pass_gradients_on(variant: str) -> None:
    factors = [1.0, 2.0, 5.0]
    instances = {
        f"copy{k}": {
            "type": "instance",
            "to_world": mi.ScalarTransform4f().scale(factor),
            "group": {"type": "ref", "id": "group"},
        }
        for k, factor in enumerate(factors)
    }
    mesh = {"type": "ply", "filename": str(assets.mesh("spot")), "face_normals": True}
    scene = mi.load_dict({"type": "scene", "group": {"type": "shapegroup", "mesh": mesh}, **instances}, optimize=False)
    data = load(scene)
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("vertex_positions"))
    dr.enable_grad(params[key])
    params.update()
    dr.backward(dr.sum(refresh(data).geometry.positions))
    np.testing.assert_allclose(dr.grad(params[key]).numpy(), sum(factors), rtol=1e-5)


@pytest.mark.parametrize("kinds", [("cube", "sphere", "cylinder"), ("cube", "cube", "cube")], ids=["unlike", "alike"])
def test_instances_of_several_groups(variant: str, kinds: tuple[str, ...]) -> None:
    """Instances are told what they show, also where groups have no names and say the same of themselves. No kernel runs."""
    scene = {"type": "scene"}
    for k, kind in enumerate(kinds):
        scene[f"group{k}"] = {"type": "shapegroup", f"shape{k}": {"type": kind}}
    for k in range(6):
        scene[f"copy{k}"] = {"type": "instance", "group": {"type": "ref", "id": f"group{k % 3}"}}
    scene = mi.load_dict(scene, optimize=False)
    for _, node in children(scene):
        if node.class_name().startswith("ShapeGroup"):
            node.set_id("")
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        found = [(name, shape.class_name().lower()) for name, shape, _ in scene_module.named_shapes(scene)]
        assert not dr.kernel_history()
    assert [name for name, _ in found] == [f"copy{k}.shape{k % 3}" for k in range(6)]
    if len(set(kinds)) > 1:
        assert [info.plugin.lower() for info in load(scene).geometry.shapes] == [*kinds, *kinds]


def test_topology_change_is_refused(variant: str) -> None:
    scene = mi.load_dict({"type": "scene", "box": {"type": "cube"}}, optimize=False)
    data = load(scene)
    params = mi.traverse(scene)
    params["box.vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0])
    params["box.vertex_normals"] = mi.Float([0, 0, 1] * 3)
    params["box.vertex_texcoords"] = mi.Float([0] * 6)
    params["box.faces"] = mi.UInt32([0, 1, 2])
    params.update()
    with pytest.raises(ShadowmapError, match="'box' now has 3 vertices.*24"):
        refresh(data)


def triangle_mesh(positions: list[float], faces: list[int]) -> Any:
    mesh = mi.Mesh("broken", len(positions) // 3, len(faces) // 3)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(positions)
    params["faces"] = mi.UInt32(faces)
    mesh.set_id("broken")
    return mesh


def test_broken_meshes_are_named(variant: str) -> None:
    nan = triangle_mesh([0, 0, 0, 1, float("nan"), 0, 0, 1, 0], [0, 1, 2])
    with pytest.raises(ShadowmapError, match="Vertex 1 of shape 'broken'"):
        load(mi.load_dict({"type": "scene", "broken": nan}, optimize=False))


def test_faces_out_of_range_and_empty_meshes_are_named(variant: str) -> None:
    """On the buffers themselves: Mitsuba would read beyond the end of its own before one could load such a mesh."""
    source = MeshSource(triangle_mesh([0, 0, 0, 1, 0, 0, 0, 1, 0], [0, 1, 2]), None)
    points = source.own().positions.numpy().reshape(-1, 3)

    def describe(faces: np.ndarray) -> None:
        parts = Parts(points, np.zeros_like(points), faces, np.array([len(points)]), np.array([len(faces)]))
        describe_all(["broken"], [source], [(False, False)], (np.array([False]), np.array([False])), parts)

    with pytest.raises(ShadowmapError, match="Face 1 of shape 'broken' refers to vertex 3.* 3 vertices"):
        describe(np.array([[0, 1, 2], [0, 1, 3]], np.uint32))
    with pytest.raises(ShadowmapError, match="'broken' is an empty mesh"):
        describe(np.zeros((0, 3), np.uint32))


def test_nothing_to_render_is_refused(variant: str) -> None:
    with pytest.raises(ShadowmapError, match="nothing to render.*no shapes"):
        load(mi.load_dict({"type": "scene"}))
    grid = mi.TensorXf(np.linspace(-1, 1, 27, dtype=np.float32).reshape(3, 3, 3, 1))
    with pytest.raises(ShadowmapError, match="nothing to render.*'blob' .SDFGrid"):
        load(mi.load_dict({"type": "scene", "blob": {"type": "sdfgrid", "grid": grid}}))


def test_scalar_variant_is_refused(variant: str) -> None:
    mi.set_variant("scalar_rgb")
    try:
        with pytest.raises(ShadowmapError, match="scalar_rgb.*llvm_ad_rgb"):
            load(mi.load_dict({"type": "scene", "box": {"type": "cube"}}))
    finally:
        mi.set_variant(variant)


EVEN = {"type": "rgb", "value": [0.2, 0.5, 0.3]}
CHECKS = {"type": "checkerboard"}


@pytest.mark.parametrize(
    ("material", "varied"),
    [
        ({"type": "diffuse", "reflectance": EVEN}, False),
        ({"type": "diffuse", "reflectance": CHECKS}, True),
        ({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}, True),
        ({"type": "roughplastic", "diffuse_reflectance": EVEN, "alpha": 0.3}, False),
        ({"type": "plastic", "specular_reflectance": CHECKS}, True),
        ({"type": "roughconductor", "alpha": CHECKS}, True),
        ({"type": "principled", "base_color": EVEN}, False),
        ({"type": "principled", "roughness": CHECKS}, True),
        ({"type": "thindielectric"}, False),
        ({"type": "thindielectric", "specular_transmittance": CHECKS}, True),
        ({"type": "twosided", "inner": {"type": "diffuse", "reflectance": CHECKS}}, True),
        ({"type": "mask", "opacity": 0.5, "inner": {"type": "diffuse"}}, False),
        ({"type": "mask", "opacity": CHECKS, "inner": {"type": "diffuse"}}, True),
        ({"type": "blendbsdf", "weight": CHECKS, "a": {"type": "diffuse"}, "b": {"type": "plastic"}}, True),
        ({"type": "bumpmap", "arbitrary": CHECKS, "inner": {"type": "diffuse"}}, True),
        ({"type": "hair"}, True),
    ],
)
def test_materials_that_vary_over_a_surface(variant: str, material: dict[str, Any], varied: bool) -> None:
    assert is_even(mi.load_dict(material)) != varied


@pytest.mark.parametrize(("radiance", "varied"), [(EVEN, False), (CHECKS, True)])
def test_lamps_that_vary_over_a_surface(variant: str, radiance: dict[str, Any], varied: bool) -> None:
    lamp = {"type": "rectangle", "light": {"type": "area", "radiance": radiance}}
    data = load(mi.load_dict({"type": "scene", "lamp": lamp, "floor": {"type": "rectangle"}}), warn=False)
    assert {info.name: info.varied for info in data.geometry.shapes} == {"lamp": varied, "floor": False}
