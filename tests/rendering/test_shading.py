"""Surface records and shading against Mitsuba's own, fed with the same triangles and barycentrics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.rendering.direct_light import ambient_light, background, direct_light
from shadowmap_dr.rendering.gbuffer.surface import surface
from shadowmap_dr.rendering.gbuffer.transmission import transmittance_of
from shadowmap_dr.scene.geometry import NO_TRIANGLE
from shadowmap_dr.scene.load import SceneData, load, refresh
from shadowmap_dr.scene.mitsuba_objects import parameters

SIZE = 48


def pixels(rng_seed: int, shape: tuple[int, ...]) -> Any:
    return mi.Bitmap(mi.TensorXf(np.random.default_rng(rng_seed).random(shape).astype(np.float32)))


def bitmap(seed: int, channels: int = 3, **settings: Any) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": pixels(seed, (8, 8, channels)), "raw": channels == 1, **settings}


def bumpy_mesh(name: str, *, normals: bool, texcoords: bool, face_normals: bool = False, attribute: bool = False) -> Any:
    """A 6 x 6 grid in [-1, 1]^2 with a wavy height."""
    n = 6
    y, x = (a.ravel() for a in np.meshgrid(np.linspace(-1, 1, n + 1), np.linspace(-1, 1, n + 1), indexing="ij"))
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    faces = np.concatenate([corner + np.array([[0], [1], [n + 2]]), corner + np.array([[0], [n + 2], [n + 1]])], 1).T
    props = mi.Properties()
    props["face_normals"] = face_normals
    mesh = mi.Mesh(name, len(x), len(faces), props, has_vertex_normals=normals, has_vertex_texcoords=texcoords)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(np.stack([x, y, 0.3 * np.sin(3 * x) * np.cos(2 * y)], -1).ravel().astype(np.float32))
    params["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    if texcoords:
        params["vertex_texcoords"] = mi.Float(np.stack([x * 0.5 + 0.2 * y, y * 0.4 + 0.5], -1).ravel().astype(np.float32))
    if attribute:
        colours = np.random.default_rng(8).random(3 * len(x)).astype(np.float32)
        mesh.add_attribute("vertex_paint", 3, colours)
    params.update()
    return mesh


BSDFS: dict[str, Any] = {
    "diffuse": lambda: {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.8]}},
    "bitmap": lambda: {"type": "diffuse", "reflectance": bitmap(1)},
    "principled": lambda: {
        "type": "principled",
        "roughness": bitmap(2, 1),
        "metallic": 0.3,
        "anisotropic": 0.7,
        "clearcoat": 0.5,
    },
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": bitmap(1)},
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.2},
    "roughconductor": lambda: {"type": "roughconductor", "alpha_u": 0.1, "alpha_v": 0.4},
    "roughdielectric": lambda: {"type": "roughdielectric", "alpha": 0.3},
    "twosided": lambda: {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": bitmap(1)}},
    "mask": lambda: {"type": "mask", "opacity": bitmap(3, 1), "bsdf": {"type": "diffuse"}},
    "normalmap": lambda: {
        "type": "normalmap",
        "normalmap": bitmap(4, raw=True),
        "bsdf": {"type": "roughconductor", "alpha": 0.4},
    },
    "bumpmap": lambda: {"type": "bumpmap", "arbitrary": bitmap(5, 1), "scale": 0.3, "bsdf": {"type": "diffuse"}},
    "blend": lambda: {"type": "blendbsdf", "weight": bitmap(6, 1), "a": {"type": "diffuse"}, "b": {"type": "roughplastic"}},
    "principledthin": lambda: {"type": "principledthin", "roughness": 0.5, "diff_trans": 0.8},
    "hair": lambda: {"type": "hair"},
}


def base_scene(**extra: Any) -> dict[str, Any]:
    camera = mi.ScalarTransform4f().look_at([0.8, -1.7, 2.6], [0, 0, 0], [0, 1, 0])
    spot = mi.ScalarTransform4f().look_at([1.5, 1, 2], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "eye": {"type": "perspective", "fov": 50, "to_world": camera, "film": film},
        "sun": {"type": "directional", "direction": [0.3, 0.4, -1], "irradiance": {"type": "rgb", "value": [1, 2, 3]}},
        "bulb": {"type": "point", "position": [-1, 1, 2], "intensity": 2.0},
        "lamp": {"type": "spot", "to_world": spot, "cutoff_angle": 30, "intensity": 5.0},
        **extra,
    }


def primary_hits(scene: Any, data: SceneData, index: int = 0) -> tuple[Any, Any, Any, Any]:
    """(triangle, u, v, Mitsuba's surface interaction) at the pixel centres, found with Mitsuba's ray tracer."""
    sensor = data.sensors[index][0]
    pixel = np.arange(sensor.width * sensor.height)
    centre = mi.Point2f((pixel % sensor.width + 0.5) / sensor.width, (pixel // sensor.width + 0.5) / sensor.height)
    ray, _ = scene.sensors()[index].sample_ray(0.0, 0.5, centre, mi.Point2f(0.5))
    hit = scene.ray_intersect_preliminary(ray)
    si = hit.compute_surface_interaction(ray)
    shape, instance = (dr.reinterpret_array(mi.UInt32, ptr).numpy() for ptr in (si.shape, si.instance))
    triangle = np.full(len(pixel), NO_TRIANGLE, np.uint32)
    for source, info in zip(data.sources, data.geometry.shapes, strict=True):
        own = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(source.shape))[0]
        placed = dr.reinterpret_array(mi.UInt32, mi.ShapePtr(source.instance))[0] if source.instance is not None else 0
        mine = (shape == own) & (instance == placed)
        triangle[mine] = info.face_start + hit.prim_index.numpy()[mine]
    # Before the scene changes, with which a GPU's ray tracer would be gone.
    dr.eval(hit, si)
    return mi.UInt32(triangle), mi.Float(hit.prim_uv.x), mi.Float(hit.prim_uv.y), si


def assert_agrees_with_mitsuba(scene: Any) -> None:
    data = load(scene)
    triangle, u, v, si = primary_hits(scene, data)
    seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
    hit = seen.active.numpy()
    assert hit.mean() > 0.2 and np.array_equal(hit, si.is_valid().numpy())
    fields = {
        "p": (seen.p_world, si.p),
        "n": (seen.n_world, si.n),
        "uv": (seen.si.uv, si.uv),
        "dp_du": (seen.si.dp_du, si.dp_du),
        "dp_dv": (seen.si.dp_dv, si.dp_dv),
        "s": (seen.si.sh_frame.s, si.sh_frame.s),
        "t": (seen.si.sh_frame.t, si.sh_frame.t),
        "n_shading": (seen.si.sh_frame.n, si.sh_frame.n),
        "wi": (seen.si.wi, si.wi),
    }
    for name, (ours, mitsubas) in fields.items():
        assert np.allclose(ours.numpy()[:, hit], mitsubas.numpy()[:, hit], rtol=1e-4, atol=1e-4), name
    for light, emitter in zip(data.lights, scene.emitters(), strict=True):
        ds, weight = emitter.sample_direction(si, mi.Point2f(0.5))
        expected = (si.bsdf().eval(mi.BSDFContext(), si, si.to_local(ds.d)) * weight).numpy()[:, hit]
        ours = direct_light(seen, light, gate=False).numpy()
        assert np.all(ours[:, ~hit] == 0)
        assert np.allclose(ours[:, hit], expected, rtol=2e-3, atol=1e-3 * expected.mean() + 1e-6), light.name
        gated = direct_light(seen, light).numpy()[:, hit]
        assert np.all((gated == ours[:, hit]) | (gated == 0))


@pytest.mark.parametrize("bsdf", BSDFS)
def test_bsdfs(variant: str, bsdf: str) -> None:
    mesh = bumpy_mesh("mesh", normals=True, texcoords=True)
    mesh.set_bsdf(mi.load_dict(BSDFS[bsdf]()))
    assert_agrees_with_mitsuba(mi.load_dict(base_scene(mesh=mesh), optimize=False))


def test_a_material_with_parameters_that_have_no_value(variant: str) -> None:
    ball = {"type": "sphere", "bsdf": {"type": "hair"}}
    data = load(mi.load_dict(base_scene(ball=ball), optimize=False))
    assert len(data.geometry.shapes) == 1
    assert "to_world" in parameters(data.sources[0].shape)


@pytest.mark.parametrize("normals", [False, True])
@pytest.mark.parametrize("texcoords", [False, True])
def test_meshes_without_normals_or_texcoords(variant: str, normals: bool, texcoords: bool) -> None:
    mesh = bumpy_mesh("mesh", normals=normals, texcoords=texcoords)
    mesh.set_bsdf(mi.load_dict(BSDFS["roughconductor"]()))
    # The second shape, of another kind, makes per-pixel decisions necessary.
    other = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.5]).scale(3), "bsdf": BSDFS["bitmap"]()}
    assert_agrees_with_mitsuba(mi.load_dict(base_scene(mesh=mesh, other=other), optimize=False))


def test_mesh_attribute_alone_in_a_scene(variant: str) -> None:
    """Vertex colours are no plain colour, though Mitsuba calls them constant: images of nothing else are not black."""
    mesh = bumpy_mesh("mesh", normals=True, texcoords=False, attribute=True)
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}}))
    scene = mi.load_dict(base_scene(mesh=mesh), optimize=False)
    assert load(scene).needs_frames
    integrators = [mi.load_dict({"type": name}) for name in ("shadowmap", "direct")]
    ours, theirs = (np.array(mi.render(scene, integrator=integrator, spp=16)) for integrator in integrators)
    assert theirs[..., :3].mean() > 0.1
    assert abs(ours[..., :3].mean() / theirs[..., :3].mean() - 1) < 0.03


def test_mesh_attribute_and_moved_mesh(variant: str) -> None:
    """Vertex colours stay at their vertices when the functional path moves the mesh and Mitsuba does not know of it."""
    mesh = bumpy_mesh("mesh", normals=True, texcoords=False, attribute=True)
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}}))
    scene = mi.load_dict(base_scene(mesh=mesh), optimize=False)
    assert_agrees_with_mitsuba(scene)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)
    moved = data.geometry.with_positions({"mesh": data.geometry.shape_positions("mesh") + mi.Vector3f(0.3, 0.1, -0.2)})
    sensor = data.sensors[0][0]
    sun = data.light("sun")
    still = direct_light(surface(data, data.geometry, sensor, triangle, u, v), sun)
    assert np.allclose(direct_light(surface(data, moved, sensor, triangle, u, v), sun).numpy(), still.numpy(), atol=1e-4)


def test_mesh_attribute_ignores_rigid_motion_of_mitsubas_mesh(variant: str) -> None:
    """With barycentrics fixed, vertex colours do not depend on where the vertices are, whoever moves them."""
    mesh = bumpy_mesh("mesh", normals=True, texcoords=False, attribute=True)
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}}))
    scene = mi.load_dict(base_scene(mesh=mesh), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)
    params = mi.traverse(scene)
    x, y = mi.Float(0.0), mi.Float(0.0)
    dr.enable_grad(x, y, u)
    positions = dr.unravel(mi.Point3f, params["mesh.vertex_positions"]) + mi.Vector3f(x, 0, 0)
    params["mesh.vertex_positions"] = dr.ravel(positions)
    params.update()
    data = refresh(data)
    geometry = data.geometry.with_positions({"mesh": data.geometry.shape_positions("mesh") + mi.Vector3f(y, 0, 0)})
    seen = surface(data, geometry, data.sensors[0][0], triangle, u, v)
    dr.backward(dr.sum(seen.bsdf.eval_diffuse_reflectance(seen.si, seen.active).x))
    assert np.allclose([x.grad[0], y.grad[0]], 0, atol=1e-3)
    assert np.abs(u.grad.numpy()).max() > 0.1


@pytest.mark.parametrize("flip", [False, True])
def test_flipped_normals_and_instances(variant: str, flip: bool) -> None:
    # Only similarities: under other transforms, Mitsuba 3.9's ``si.n`` of an instance is not orthogonal to its surface.
    transform = mi.ScalarTransform4f
    two = {"type": "twosided", "bsdf": BSDFS["roughconductor"]()}
    group = {
        "type": "shapegroup",
        "box": {"type": "cube", "flip_normals": flip, "bsdf": two, "to_world": transform().translate([0.5, 0, 0.4]).scale(0.4)},
        "mesh": bumpy_mesh("mesh", normals=True, texcoords=True),
    }
    place = {
        "left": transform().translate([-0.8, 0.2, 0]).rotate([0.6, 0, 0.8], 30).scale(0.4),
        "mirrored": transform().translate([0.7, -0.2, 0]).rotate([0, 0.6, 0.8], 20).scale([-0.4, 0.4, 0.4]),
    }
    instances = {
        name: {"type": "instance", "to_world": to_world, "shapegroup": {"type": "ref", "id": "group"}}
        for name, to_world in place.items()
    }
    floor = {"type": "rectangle", "flip_normals": flip, "to_world": transform().translate([0, 0, -0.5]).scale(3), "bsdf": two}
    scene = mi.load_dict(base_scene(group=group, floor=floor, **instances), optimize=False)
    data = load(scene)
    names = {info.name for info in data.geometry.shapes}
    assert names == {"left.box", "left.mesh", "mirrored.box", "mirrored.mesh", "floor"}
    triangle = primary_hits(scene, data)[0].numpy()
    assert len(np.unique(data.geometry.face_shape.numpy()[triangle[triangle != NO_TRIANGLE]])) == 5  # all are in view
    assert_agrees_with_mitsuba(scene)


def test_mesh_attribute_of_an_instance(variant: str) -> None:
    """Against the attribute itself: Mitsuba 3.9 looks up the barycentrics of an instance's *world* position in its local mesh."""
    mesh = bumpy_mesh("mesh", normals=True, texcoords=True, attribute=True)
    mesh.set_bsdf(mi.load_dict({"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_paint"}}))
    placed = {
        "type": "instance",
        "to_world": mi.ScalarTransform4f().translate([0.2, 0.1, 0]).rotate([0, 0.6, 0.8], 30),
        "shapegroup": {"type": "ref", "id": "group"},
    }
    scene = mi.load_dict(base_scene(group={"type": "shapegroup", "mesh": mesh}, placed=placed), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)
    seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
    hit = seen.active.numpy()
    face = mesh.faces_buffer().numpy().reshape(-1, 3)[triangle.numpy()[hit]]
    colour = mesh.attribute_buffer("vertex_paint").numpy().reshape(-1, 3)[face]
    weight = np.stack([1 - u.numpy() - v.numpy(), u.numpy(), v.numpy()], -1)[hit]
    expected = np.einsum("fvc,fv->cf", colour, weight)
    assert np.allclose(seen.bsdf.eval_diffuse_reflectance(seen.si).numpy()[:, hit], expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["orthographic", "batch", "merged", "mono"])
def test_other_cameras_merging_and_mono(variant: str, kind: str) -> None:
    if kind == "mono":
        if variant.replace("rgb", "mono") not in mi.variants():
            pytest.skip("this Mitsuba has no mono variant")
        mi.set_variant(variant.replace("rgb", "mono"))
    bsdf = mi.load_dict(BSDFS["bitmap"]())
    boxes = {
        f"box_{i}": {"type": "cube", "bsdf": bsdf, "to_world": mi.ScalarTransform4f().translate([i - 0.6, 0, 0]).scale(0.4)}
        for i in range(2)
    }
    description = base_scene(**boxes)
    if kind == "orthographic":
        description["eye"]["type"] = kind
        del description["eye"]["fov"]
    elif kind == "batch":
        eye = description["eye"]
        description["eye"] = {
            "type": "batch",
            "film": {**eye["film"], "width": 2 * SIZE},
            "a": eye,
            "b": {"type": "orthographic"},
        }
    scene = mi.load_dict(description, optimize=kind == "merged")
    if kind == "batch":
        left, right = load(scene).sensors[0]
        assert (left.name, right.name, left.width, right.film_column) == ("a", "b", SIZE, SIZE)
    else:
        assert_agrees_with_mitsuba(scene)


def test_gate_closes_where_a_shadow_ray_would(variant: str) -> None:
    """A coarse sphere with smooth normals is lit past its terminator by the shading normal alone."""
    ball = mi.load_dict({"type": "sphere", "id": "ball"})
    light = {"type": "directional", "direction": [1, 0.2, 0.1]}
    eye = {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])}
    scene = mi.load_dict({"type": "scene", "ball": ball, "light": light, "eye": eye})
    data = load(scene, tessellation=12)
    count = data.geometry.face_count
    u, v = dr.full(mi.Float, 0.9, count), dr.full(mi.Float, 0.05, count)  # near a corner, where the two normals differ most
    seen = surface(data, data.geometry, data.sensors[0][0], dr.arange(mi.UInt32, count), u, v)
    free, gated = (direct_light(seen, data.lights[0], gate=gate).numpy()[0] for gate in (False, True))
    away = dr.dot(seen.n_world, mi.Vector3f(1, 0.2, 0.1)).numpy() > 0
    assert np.any(free[away] > 0) and np.all(gated[away] == 0) and np.array_equal(free[~away], gated[~away])


def test_forward_mode_and_barycentrics(variant: str) -> None:
    """d p / d u is an edge of the triangle; forward mode goes through with_positions and smooth normals."""
    scene = mi.load_dict(base_scene(mesh=bumpy_mesh("mesh", normals=True, texcoords=True)), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)
    x = mi.Float(0.0)
    dr.enable_grad(x)
    geometry = data.geometry.with_positions({"mesh": data.geometry.shape_positions("mesh") + mi.Vector3f(x, 0, 0)})
    seen = surface(data, geometry, data.sensors[0][0], triangle, u, v)
    hit = seen.active.numpy()
    dr.set_grad(x, 1.0)
    p_grad, n_grad = dr.forward_to(seen.p_world, seen.si.sh_frame.n)
    assert np.allclose(p_grad.numpy()[:, hit], np.array([[1.0], [0], [0]]), atol=1e-5)
    assert np.allclose(n_grad.numpy(), 0, atol=1e-5)

    dr.enable_grad(u)
    seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
    dr.set_grad(u, 1.0)
    edge = dr.forward_to(seen.p_world).numpy()[:, hit]
    vertex = [dr.gather(mi.UInt32, data.geometry.faces, 3 * triangle + i, seen.active) for i in range(2)]
    first, second = (dr.gather(mi.Point3f, data.geometry.positions, index, seen.active).numpy()[:, hit] for index in vertex)
    assert np.allclose(edge, second - first, atol=1e-6)


def test_no_gradient_is_nan_where_nothing_was_hit(variant: str) -> None:
    scene = mi.load_dict(base_scene(mesh=bumpy_mesh("mesh", normals=True, texcoords=True)), optimize=False)
    data = load(scene)
    triangle = mi.UInt32([NO_TRIANGLE, 0, NO_TRIANGLE, 5])
    u, v = mi.Float([np.nan, 0.2, 0.1, 0.1]), mi.Float([0.1, np.inf, 0.1, 0.3])
    v = dr.select(dr.isfinite(v), v, 0.3)
    p = dr.ravel(data.geometry.shape_positions("mesh"))
    sensor = data.sensors[0][0]
    matrix = mi.Matrix4f(sensor.to_world.matrix)
    dr.enable_grad(p, matrix)
    sensor = replace(sensor, to_world=mi.Transform4f(matrix))
    seen = surface(data, data.geometry.with_positions({"mesh": p}), sensor, triangle, u, v)
    total = sum(direct_light(seen, light) for light in data.lights)
    assert np.all(total.numpy()[:, [0, 2]] == 0)
    dr.backward(dr.sum(dr.squared_norm(total)))
    assert np.all(np.isfinite(p.grad.numpy())) and np.any(p.grad.numpy() != 0)
    assert np.all(np.isfinite(matrix.grad.numpy()))


def test_frozen_step_records_once(variant: str) -> None:
    """Moving vertices, a new light direction, loss and backward pass inside one frozen function."""
    mesh = bumpy_mesh("mesh", normals=True, texcoords=True)
    mesh.set_bsdf(mi.load_dict(BSDFS["principled"]()))
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.5]).scale(3)}
    slide = {"type": "spot", "texture": bitmap(5), "to_world": mi.ScalarTransform4f().look_at([0, 1, 3], [0, 0, 0], [0, 1, 0])}
    sky = {"type": "envmap", "bitmap": pixels(7, (8, 16, 3))}
    scene = mi.load_dict(base_scene(mesh=mesh, floor=floor, slide=slide, sky=sky), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)

    def step(data: SceneData, positions: Any, direction: Any, triangle: Any, u: Any, v: Any) -> tuple[Any, Any, Any]:
        dr.enable_grad(positions, direction)
        geometry = data.geometry.with_positions({"mesh": positions})
        seen = surface(data, geometry, data.sensors[0][0], triangle, u, v)
        sun, *others = data.lights
        image = direct_light(seen, replace(sun, direction=direction), 0.5)
        for light in others:
            image += direct_light(seen, light)
        (sky,) = data.environments
        image += ambient_light(seen, sky, 2) + dr.select(seen.active, 0.0, background(sky, data.sensors[0][0]))
        loss = dr.sum(dr.squared_norm(image))
        dr.backward(loss)
        return loss, positions.grad, direction.grad

    frozen = dr.freeze(step)
    rest = dr.ravel(data.geometry.shape_positions("mesh"))
    for i in range(6):
        moved, direction = rest + 0.01 * i, mi.Vector3f(0.1 * i, 0.2, -1)
        dr.make_opaque(moved, direction)
        results = frozen(data, moved, direction, triangle, u, v)
        if i == 2:
            recordings = frozen.n_recordings
    assert frozen.n_recordings == recordings
    expected = step(data, dr.detach(moved), dr.detach(direction), triangle, u, v)
    for ours, reference in zip(results, expected, strict=True):
        assert np.allclose(ours.numpy(), reference.numpy(), rtol=1e-3, atol=1e-4 * np.abs(reference.numpy()).max())


def test_frozen_step_with_texture_gradient(variant: str) -> None:
    """Scene parameters change outside of the frozen function, which differentiates all the same and is not recorded again."""
    mesh = bumpy_mesh("mesh", normals=True, texcoords=True)
    mesh.set_bsdf(mi.load_dict({"type": "principled", "base_color": bitmap(1), "roughness": 0.5}))
    scene = mi.load_dict(base_scene(mesh=mesh), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)
    params = mi.traverse(scene)

    def step(data: SceneData, triangle: Any, u: Any, v: Any) -> Any:
        seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
        loss = dr.sum(dr.squared_norm(direct_light(seen, data.light("sun"))))
        dr.backward(loss)
        return loss

    frozen = dr.freeze(step)
    for i in range(5):
        pictures = [mi.TensorXf(np.random.default_rng(i).random((8, 8, 3)).astype(np.float32)) for _ in range(2)]
        for picture, function in zip(pictures, (frozen, step), strict=True):
            dr.enable_grad(picture)
            params["mesh.bsdf.base_color.data"] = picture
            params.update()
            function(data, triangle, u, v)
        assert np.abs(pictures[1].grad.numpy()).max() > 0.1
        assert np.allclose(pictures[0].grad.numpy(), pictures[1].grad.numpy(), rtol=1e-3, atol=1e-3)
    assert frozen.n_recordings == 1


def test_steps_need_no_ray_tracing(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = mi.load_dict(base_scene(mesh=bumpy_mesh("mesh", normals=True, texcoords=True)), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)

    def forbidden(*_: Any, **__: Any) -> None:
        raise AssertionError("a ray was traced")

    for method in ("ray_intersect", "ray_intersect_preliminary", "ray_test"):
        monkeypatch.setattr(mi.Scene, method, forbidden)
    seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
    assert direct_light(seen, data.light("sun")).numpy().max() > 0


@pytest.mark.parametrize("bsdf", ["diffuse", "roughplastic"])
def test_ambient_light_under_constant_sky(variant: str, bsdf: str) -> None:
    """A convex object under a constant sky reflects its directional-hemispherical albedo."""
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 1.0, 2.0]}}
    ball = {"type": "sphere", "bsdf": {"type": "twosided", "bsdf": BSDFS[bsdf]()}}
    scene = mi.load_dict({**base_scene(ball=ball), "sky": sky})
    data = load(scene)
    count = data.geometry.face_count
    third = dr.full(mi.Float, 1 / 3, count)
    seen = surface(data, data.geometry, data.sensors[0][0], dr.arange(mi.UInt32, count), third, third)
    (environment,) = data.environments
    ours = ambient_light(seen, environment, 16 if bsdf == "diffuse" else 64).numpy()
    if bsdf == "diffuse":
        assert np.allclose(ours, np.array([[0.1], [0.5], [1.6]]), rtol=1e-4)
        return
    rng = np.random.default_rng(9)
    expected = np.zeros_like(ours)
    for _ in range(256):
        sample, weight = seen.bsdf.sample(
            mi.BSDFContext(), seen.si, mi.Float(rng.random(count)), mi.Point2f(rng.random((2, count)))
        )
        expected += weight.numpy() * np.array([[0.5], [1.0], [2.0]]) / 256
    facing = np.abs(seen.si.wi.z.numpy()) > 0.3
    assert abs(ours[:, facing].mean() / expected[:, facing].mean() - 1) < 0.03


def test_background_and_environment_gradient(variant: str) -> None:
    sky = {"type": "envmap", "bitmap": pixels(7, (8, 16, 3)), "to_world": mi.ScalarTransform4f().rotate([1, 2, 3], 50)}
    scene = mi.load_dict({**base_scene(mesh=bumpy_mesh("mesh", normals=True, texcoords=True)), "sky": sky})
    data = load(scene)
    picture = background(data.environments[0], data.sensors[0][0]).numpy()
    pixel = np.arange(SIZE * SIZE)
    centre = mi.Point2f((pixel % SIZE + 0.5) / SIZE, (pixel // SIZE + 0.5) / SIZE)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, centre, mi.Point2f(0.5))
    si = dr.zeros(mi.SurfaceInteraction3f, SIZE * SIZE)
    si.wi = -ray.d
    assert np.allclose(picture, scene.environment().eval(si).numpy(), atol=1e-4)

    params = mi.traverse(scene)
    x = mi.Float(1.0)
    dr.enable_grad(x)
    params["sky.scale"] = x
    params.update()
    triangle, u, v, _ = primary_hits(scene, data)
    seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
    light = dr.sum(ambient_light(seen, data.environments[0], 8).y)
    dr.backward(light)
    assert np.allclose(x.grad.numpy(), light.numpy(), rtol=1e-3)


def test_transmittance_of_surfaces(variant: str) -> None:
    mesh = bumpy_mesh("mesh", normals=True, texcoords=True)
    mesh.set_bsdf(mi.load_dict(BSDFS["mask"]()))
    solid = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -0.5]).scale(3)}
    scene = mi.load_dict(base_scene(mesh=mesh, solid=solid), optimize=False)
    data = load(scene)
    triangle, u, v, _ = primary_hits(scene, data)
    seen = surface(data, data.geometry, data.sensors[0][0], triangle, u, v)
    bsdfs = [bsdf for bsdf in data.materials if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null)]
    ours, shape = 1 - dr.mean(transmittance_of(seen, bsdfs)).numpy(), seen.shape.numpy()
    texture = mi.load_dict(bitmap(3, 1))
    masked = seen.active.numpy() & (shape == [info.name for info in data.geometry.shapes].index("mesh"))
    assert np.allclose(ours[masked], texture.eval_1(seen.si).numpy()[masked], atol=1e-5)
    assert np.all(ours[seen.active.numpy() & ~masked] == 1)
