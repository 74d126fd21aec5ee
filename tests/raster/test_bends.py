"""Steady changes and jumps of colours: surfaces of facets that are bent by little, rims, cuts, turned triangles.

Derivatives are compared with central differences of our own image (both are blurred), or with those of the same surface made
otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from integrator_scenes import camera, shadowmap

SIZE = 64


def looking(*origin: float, up: tuple[float, ...] = (0, 0, 1)) -> Any:
    return mi.ScalarTransform4f().look_at(list(origin), [0, 0, 0], list(up))


def mesh(vertices: Any, faces: Any, normals: Any = None, twosided: bool = False) -> Any:
    bsdf: dict[str, Any] = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.3]}}
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf} if twosided else bsdf)
    result = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=normals is not None, props=props)
    params = mi.traverse(result)
    params["vertex_positions"], params["faces"] = np.float32(vertices).ravel(), np.uint32(faces).ravel()
    params.update()
    if normals is not None:
        params["vertex_normals"] = np.float32(normals).ravel()
        params.update()
    return result


def scene_of(mesh: Any, light: tuple[float, ...], to_world: Any = None, fov: float = 40, wall: bool = True) -> Any:
    behind = mi.ScalarTransform4f().translate([0, 1.5, 0]).rotate([1, 0, 0], 90).scale(4)
    parts = {"wall": {"type": "rectangle", "to_world": behind}} if wall else {}
    sun = {"type": "directional", "direction": list(light), "irradiance": 3.0}
    return mi.load_dict({"type": "scene", **parts, "mesh": mesh, "sun": sun,
                         "camera": {**camera(SIZE, fov), "to_world": to_world or looking(0.1, -4, 0.3)}})  # fmt: skip


def blurred(image: np.ndarray) -> np.ndarray:
    for axis in (0, 1):
        image = sum(np.roll(image, k, axis) for k in range(-2, 3)) / 5
    return image


def sideways(points: Any, x: Any) -> Any:
    return points + mi.Vector3f(1, 0, 0) * x


def grown(points: Any, x: Any) -> Any:
    return points * (1 + x)


def derivative(scene: Any, spp: int = 1, change: Callable[[Any, Any], Any] = sideways, difference: bool = False) -> np.ndarray:
    """The derivative image by a change of the mesh, or the difference quotient of images of 256 samples."""
    params, integrator = mi.traverse(scene), shadowmap(shadow_method="none")
    rest = dr.unravel(mi.Point3f, mi.Float(params["mesh.vertex_positions"]))

    def image(x: Any, spp: int) -> Any:
        params["mesh.vertex_positions"] = dr.ravel(change(rest, x))
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=spp)

    if difference:
        step = 0.005
        result = (image(mi.Float(step), 256).numpy() - image(mi.Float(-step), 256).numpy()) / (2 * step)
    else:
        x = mi.Float(0)
        dr.enable_grad(x)
        attached = image(x, spp)
        dr.forward(x, flags=dr.ADFlag.Default)
        result = dr.grad(attached).numpy()
    image(mi.Float(0), 1)
    return blurred(result)


def agreement(found: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Cosine and scale."""
    product = (found * wanted).sum()
    return product / (np.linalg.norm(found) * np.linalg.norm(wanted) + 1e-30), product / (wanted**2).sum()


def sheet(count: int, bend: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and normals of a sheet of strips, each with vertices of its own, bent by so many degrees to the next."""
    angles = np.radians(bend * (np.arange(count) + 0.5 - count / 2))
    width = 1.8 / count
    ends = np.cumsum(np.c_[width * np.cos(angles), -width * np.sin(angles)], 0)
    points = np.r_[[[0, 0]], ends]
    points = points - points[count // 2]
    left, right, y = points[:-1], points[1:], np.full(count, 2.0)
    corners = [np.c_[p[:, 0], s * y, p[:, 1]] for p, s in ((left, -1), (right, -1), (right, 1), (left, 1))]
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.c_[np.sin(angles), 0 * angles, np.cos(angles)]
    return np.stack(corners, 1).reshape(-1, 3), faces.reshape(-1, 3), np.repeat(normals, 4, 0)


@pytest.mark.parametrize(("own_normals", "count", "bend", "light"), [(True, 20, 1.0, 60), (False, 40, 0.05, 78)])
def test_small_bends_add_up(variant: str, own_normals: bool, count: int, bend: float, light: float) -> None:
    """Facets whose bends nobody sees one by one make up a slope of shading, which moves along with the surface."""
    vertices, faces, normals = sheet(count, bend)
    angle = np.radians(light)
    to_world = looking(1.6, 0.01, 1.6, up=(0, 1, 0))
    surface = mesh(vertices, faces, normals if own_normals else None)
    scene = scene_of(surface, (-np.sin(angle), 0, -np.cos(angle)), to_world, 20, wall=False)
    wanted = derivative(scene, difference=True)
    cosine, scale = agreement(derivative(scene, 16), wanted)
    assert np.abs(wanted).max() > 0.01
    assert cosine > 0.97 and abs(scale - 1) < 0.03, (cosine, scale)


def test_coplanar_triangles_turned_opposite_ways(variant: str) -> None:
    """One of them is black: nothing of it is lit, or seen, from its back."""
    card = np.array([[-0.7, 0, -0.5], [0.6, 0, -0.55], [0.65, 0, 0.6], [-0.6, 0, 0.5]])
    scene = scene_of(mesh(card, [[0, 1, 2], [0, 3, 2]]), (0.3, 0.5, -1))
    cosine, scale = agreement(derivative(scene), derivative(scene, difference=True))
    assert cosine > 0.98 and abs(scale - 1) < 0.02, (cosine, scale)


def test_a_connected_strip_that_cuts_itself(variant: str) -> None:
    """It is folded and comes up through its first piece. Its upper end alone moves, and with it the line of the cut."""
    profile = np.array([[-0.9, 0], [0.7, 0], [0.7, -0.6], [0, -0.6], [-0.1, 0.6]])
    vertices = np.array([[x, y, z] for y in (-0.5, 0.5) for x, z in profile])
    count = len(profile)
    faces = [[[k, k + 1, k + count + 1], [k, k + count + 1, k + count]] for k in range(count - 1)]
    to_world = looking(-1.8, -2.2, 2.2)
    scene = scene_of(mesh(vertices, np.reshape(faces, (-1, 3)), twosided=True), (0.6, 0.5, -1), to_world)

    def lean(points: Any, x: Any) -> Any:
        return sideways(points, dr.select((points.z > 0.01) | ((points.z < -0.01) & (points.x < 0.5)), x, 0))

    cosine, scale = agreement(derivative(scene, change=lean), derivative(scene, change=lean, difference=True))
    assert cosine > 0.98 and abs(scale - 1) < 0.05, (cosine, scale)


def tube(count: int, caps: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A smooth tube, open or closed by disks whose rims are sharp."""
    angles = 2 * np.pi * np.arange(count) / count
    ring = np.c_[np.cos(angles), np.sin(angles), 0 * angles]
    low, high = 0.5 * ring - [0, 0, 0.7], 0.5 * ring + [0, 0, 0.7]
    i, j = np.arange(count), (np.arange(count) + 1) % count
    vertices, normals = [low, high], [ring, ring]
    faces = [np.c_[i, j, count + j], np.c_[i, count + j, count + i]]
    if caps:
        for k, end in enumerate((low, high)):
            first, up = 2 * count + k * (count + 1), 2 * k - 1
            vertices += [end, [[0, 0, 0.7 * up]]]
            normals += [np.tile([0, 0, up], (count + 1, 1))]
            around = (i, j) if k else (j, i)
            faces.append(np.c_[first + around[0], first + around[1], np.full(count, first + count)])
    return np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals)


@pytest.mark.parametrize("spp", [1, 4])
def test_sharp_rims_do_not_matter_away_from_them(variant: str, spp: int) -> None:
    """Every triangle of the tube's side touches a rim. Its outlines, at which shading falls, are the same without caps."""
    found = []
    for caps in (False, True):
        scene = scene_of(mesh(*tube(64, caps)), (0, 1, 0), looking(0.1, -4, 0))
        found.append(derivative(scene, spp)[20:44])
    open_, closed = found
    assert np.abs(open_).max() > 1
    np.testing.assert_allclose(closed, open_, atol=2e-3 * np.abs(open_).max())


def test_triangles_of_a_plane_do_not_matter(variant: str) -> None:
    """A flat-shaded square near a lamp, grown: what shading falls by towards its outlines, it does in any number of triangles."""
    found = []
    for count in (1, 32):
        x, z = (v.ravel() for v in np.meshgrid(*2 * [np.linspace(-0.6, 0.6, count + 1)]))
        corner = np.add.outer((count + 1) * np.arange(count), np.arange(count)).ravel()[:, None]
        faces = np.r_[corner + [0, 1, count + 2], corner + [0, count + 2, count + 1]]
        lamp = {"type": "point", "position": [0.3, -0.6, -0.2], "intensity": 1.0}
        square = mesh(np.c_[x, 0 * x, z], faces, twosided=True)
        parts = {"mesh": square, "lamp": lamp, "camera": {**camera(SIZE, 40), "to_world": looking(0.1, -4, 0.3)}}
        found.append(derivative(mi.load_dict({"type": "scene", **parts}), change=grown))
    cosine, scale = agreement(found[1], found[0])
    assert cosine > 0.999 and abs(scale - 1) < 0.005, (cosine, scale)


@pytest.mark.parametrize("smooth", [False, True])
def test_a_curved_sheet_that_cuts_itself(variant: str, smooth: bool) -> None:
    """A loop. Its last third moves, and with it the line of the cut, beside which no pixel may see neighbouring triangles."""
    columns, rows = 60, 8
    t, y = np.meshgrid(np.linspace(-1, 1, columns + 1), np.linspace(-0.5, 0.5, rows + 1))
    vertices = np.stack([1.9 * (t**3 - 0.6 * t), y, 1.2 * t**2 - 0.5], -1).reshape(-1, 3)
    corner = np.add.outer((columns + 1) * np.arange(rows), np.arange(columns)).ravel()[:, None]
    faces = np.r_[corner + [0, 1, columns + 2], corner + [0, columns + 2, columns + 1]]
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals if smooth else None
    surface = mesh(vertices, faces, normals, twosided=True)
    scene = scene_of(surface, (0.6, 0.5, -1), looking(0.3, -2.6, 2.2))
    end = mi.Float(np.clip(3 * t - 1, 0, 1).astype(np.float32).ravel())

    def slide(points: Any, x: Any) -> Any:
        return sideways(points, x * end)

    wanted, found = derivative(scene, change=slide, difference=True), derivative(scene, 16, change=slide)
    cosine, scale = agreement(found, wanted)
    assert cosine > 0.99 and abs(scale - 1) < 0.03, (cosine, scale)
