"""Lines on smooth meshes at which colours jump: derivatives across them, also where the jump comes later."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import camera, shadowmap

from shadowmap_dr import Renderer

# Two rectangles side by side, with vertices of their own along the line x = 0.
VERTICES = np.array([[-1, -1], [0, -1], [0, 1], [-1, 1], [0, -1], [1, -1], [1, 1], [0, 1]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.uint32)
RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.2, 0.9)


def material(kind: str) -> dict[str, Any]:
    if kind == "texture":
        pixels = np.array([[RED, RED, BLUE, BLUE]], np.float32)
        return {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}}
    if kind == "plain":
        return {"type": "diffuse"}
    return {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": f"{kind}_color"}}


def attribute(kind: str, *colours: tuple[float, ...]) -> Any:
    """The first colour on the left and the last one on the right."""
    return mi.Float(np.repeat(np.float32([colours[0], colours[-1]]), 4 if kind == "vertex" else 2, axis=0).ravel())


def scene_of(kind: str, smooth: bool = True) -> Any:
    textured = kind in ("texture", "emission")
    props = mi.Properties()
    props["mesh_bsdf"] = mi.load_dict(material("plain" if kind == "emission" else kind))
    if kind == "emission":
        props["mesh_emitter"] = mi.load_dict({"type": "area", "radiance": material("texture")["reflectance"]})
    mesh = mi.Mesh("mesh", 8, 4, has_vertex_normals=smooth, has_vertex_texcoords=textured, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.insert(VERTICES, 2, 0, axis=1).ravel()
    params["faces"] = FACES.ravel()
    if textured:
        params["vertex_texcoords"] = np.repeat(np.float32([[0.1, 0.5], [0.9, 0.5]]), 4, axis=0).ravel()
    params.update()
    if kind in ("vertex", "face"):
        mesh.add_attribute(f"{kind}_color", 3, np.array(attribute(kind, RED, BLUE)))
    to_world = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    sun = {"type": "directional", "direction": [0.6, 0, -1], "irradiance": 3.0}
    return mi.load_dict({"type": "scene", "mesh": mesh, "sun": sun, "camera": {**camera(), "to_world": to_world}})


def fold(vertices: Any) -> Any:
    points = dr.unravel(mi.Point3f, vertices)
    return dr.ravel(mi.Point3f(points.x, points.y, -0.6 * dr.abs(points.x)))


def assert_agrees(scene: Any, integrator: Any) -> None:
    """The derivative by a motion across the line, summed up around it, is that of differences, and not zero."""
    params = mi.traverse(scene)
    rest = mi.Float(params["mesh.vertex_positions"])

    def around_the_line(image: Any) -> np.ndarray:
        return np.array(image)[20:44, 28:36].sum((0, 1))

    def move(x: Any) -> Any:
        params["mesh.vertex_positions"] = dr.ravel(dr.unravel(mi.Point3f, rest) + mi.Vector3f(1, 0, 0) * x)
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=16)

    step = 0.03
    expected = (around_the_line(move(mi.Float(step))) - around_the_line(move(mi.Float(-step)))) / (2 * step)
    x = mi.Float(0)
    dr.enable_grad(x)
    image = move(x)
    dr.forward(x)
    assert np.abs(expected).max() > 50
    np.testing.assert_allclose(around_the_line(dr.grad(image)), expected, rtol=0.02, atol=0.5)


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("kind", ["vertex", "face", "texture", "emission"])
def test_colours_that_jump(variant: str, kind: str, smooth: bool) -> None:
    assert_agrees(scene_of(kind, smooth), shadowmap(shadow_method="none"))


@pytest.mark.parametrize("recorded", [False, True])
def test_a_fold_that_comes_later(variant: str, recorded: bool) -> None:
    """The mesh was flat when the integrator saw it first."""
    scene, integrator = scene_of("plain"), shadowmap(shadow_method="none", recorded=recorded)
    mi.render(scene, integrator=integrator)
    params = mi.traverse(scene)
    params["mesh.vertex_positions"] = fold(params["mesh.vertex_positions"])
    params.update()
    assert_agrees(scene, integrator)


@pytest.mark.parametrize("smooth", [True, False])
@pytest.mark.parametrize("kind", ["vertex", "face", "texture"])
def test_colours_that_come_to_jump(variant: str, kind: str, smooth: bool) -> None:
    scene, integrator = scene_of(kind, smooth), shadowmap(shadow_method="none")
    params = mi.traverse(scene)
    key = "mesh.vertex_texcoords" if kind == "texture" else f"mesh.{kind}_color"
    later = mi.Float(params[key])
    params[key] = dr.full(mi.Float, 0.5, dr.width(later))
    params.update()
    mi.render(scene, integrator=integrator)
    params[key] = later
    params.update()
    assert_agrees(scene, integrator)


def textured_sheet(count: int, bend: float) -> Any:
    """Count x count squares from -2 to 2, flat-shaded, with a texture that changes slowly; a roof whose ridge is x = 0."""
    wave = 0.5 + 0.4 * np.sin(2 * np.pi * (np.arange(64) + 0.5) / 64)
    bitmap = mi.Bitmap(np.tile(wave[None, :, None], (8, 1, 3)).astype(np.float32))
    y, x = np.meshgrid(*2 * [np.linspace(-2, 2, count + 1)], indexing="ij")
    first = np.arange(count * (count + 1)).reshape(count, -1)[:, :count].ravel()
    faces = [first, first + 1, first + count + 2], [first, first + count + 2, first + count + 1]
    props = mi.Properties()
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": bitmap, "raw": True}}
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf})
    mesh = mi.Mesh("mesh", (count + 1) ** 2, 2 * count**2, has_vertex_texcoords=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.float32(np.stack([x, y, -bend * np.abs(x)], -1)).ravel()
    params["vertex_texcoords"] = np.float32(np.stack([x / 4 + 0.5, y / 4 + 0.5], -1)).ravel()
    params["faces"] = np.concatenate([np.stack(f, 1) for f in faces]).astype(np.uint32).ravel()
    params.update()
    to_world = mi.ScalarTransform4f().look_at([0, -0.5, 4], [0, 0, 0], [0, 1, 0])
    sun = {"type": "directional", "direction": [0.6, 0.3, -1], "irradiance": 3.0}
    return mi.load_dict({"type": "scene", "mesh": mesh, "sun": sun, "camera": {**camera(), "to_world": to_world}})


@pytest.mark.parametrize(("bend", "samples"), [(0.0, 1), (0.4, 16)])
def test_slopes_of_colours_within_flat_faces_count_once(variant: str, bend: float, samples: int) -> None:
    """Edges between triangles of one plane are none. The ridge of a roof that they make up is one."""
    scene, integrator = textured_sheet(16, bend), shadowmap(shadow_method="none")
    params = mi.traverse(scene)
    rest = mi.Float(params["mesh.vertex_positions"])

    def move(x: Any, spp: int) -> Any:
        params["mesh.vertex_positions"] = dr.ravel(dr.unravel(mi.Point3f, rest) + mi.Vector3f(1, 0, 0) * x)
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=spp)

    step = 0.03
    ends = [move(mi.Float(side * step), 64).numpy().sum(-1) for side in (1, -1)]
    expected = (ends[0] - ends[1])[6:-6, 6:-6] / (2 * step)
    x = mi.Float(0)
    dr.enable_grad(x)
    image = move(x, samples)
    dr.forward(x)
    found = dr.grad(image).numpy().sum(-1)[6:-6, 6:-6]
    # Added up over five columns: the ridge is one pixel wide here, and as wide as the steps there.
    found, expected = (np.convolve(a.sum(0), np.ones(5), "valid") for a in (found, expected))
    cosine = (found * expected).sum() / np.linalg.norm(found) / np.linalg.norm(expected)
    scale = (found * expected).sum() / (expected**2).sum()
    assert cosine > 0.98 and abs(scale - 1) < 0.02, (cosine, scale)


def test_smooth_surfaces_have_no_creases_where_nothing_jumps(variant: str) -> None:
    """Were equal colours blended across the line, what moves along with the shading would count twice there."""
    renderer = Renderer.from_scene(scene_of("plain"))
    assert not dr.any(renderer.creases.now(renderer.data.geometry))
    folded = renderer.data.geometry.with_positions({"mesh": fold(renderer.data.geometry.positions)})
    edges = np.array(renderer.creases.now(folded)).reshape(-1, 3)
    # The edge from (0, -1) to (0, 1) of both triangles that have one.
    assert edges.sum() == 2 and edges[0, 1] and edges[3, 2]


def test_seams_of_textures_that_go_on_across_them(variant: str) -> None:
    """All around a ball, from u = 1 to 0: what the colours' own slope says is counted once there, as everywhere."""
    u = (np.arange(64) + 0.5) / 64
    waves = np.tile((0.5 + 0.45 * np.sin(2 * np.pi * u))[None, :, None], (8, 1, 3)).astype(np.float32)
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(waves), "raw": True}}
    to_world = mi.ScalarTransform4f().look_at([0, -4, 0], [0, 0, 0], [0, 0, 1])
    ball = {"type": "sphere", "to_world": mi.ScalarTransform4f().rotate([0, 0, 1], -90), "bsdf": bsdf}
    sun = {"type": "directional", "direction": [0, 1, -0.2], "irradiance": 3.0}
    scene = mi.load_dict({"type": "scene", "ball": ball, "sun": sun, "camera": {**camera(fov=32), "to_world": to_world}})
    params, integrator = mi.traverse(scene), shadowmap(shadow_method="none")
    start, angle = mi.Transform4f(params["ball.to_world"]), mi.Float(0)
    dr.enable_grad(angle)
    params["ball.to_world"] = mi.Transform4f().rotate([0, 0, 1], angle) @ start
    params.update()
    image = mi.render(scene, params, integrator=integrator)
    dr.forward(angle)
    columns = np.abs(dr.grad(image).numpy()[24:40, 28:36].sum((0, 2)))
    assert columns.min() > 0.1 and columns.max() < 1.1 * columns.min()


def test_other_scenes_with_attributes_are_no_hindrance(variant: str) -> None:
    """Calls of materials go to those of all scenes. What images hang on thereby must not be met by forward passes."""
    kept = []
    for kind, smooth in (("vertex", True), ("vertex", False), ("face", True), ("texture", False), ("vertex", True)):
        scene, integrator = scene_of(kind, smooth), shadowmap(shadow_method="none")
        params = mi.traverse(scene)
        x = mi.Float(0)
        dr.enable_grad(x)
        params["mesh.vertex_positions"] = params["mesh.vertex_positions"] + x
        params.update()
        image = mi.render(scene, params, integrator=integrator)
        dr.forward(x)
        assert np.abs(dr.grad(image).numpy()).max() > 0.1
        kept.append((scene, params, integrator, image, x))
