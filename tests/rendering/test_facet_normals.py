"""Mean normals of flat-shaded faces against NumPy and central differences."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr.raster import build_topology
from shadowmap_dr.rendering.gbuffer.facet_normals import facet_normals, flat_faces, mean_normals
from shadowmap_dr.scene.geometry import Geometry
from shadowmap_dr.scene.load import load

# A fan of three faces around the origin, two of one shape and one of another.
POINTS = np.array([[0, 0, 0], [1, 0, 0.2], [0, 1, -0.1], [-1, 0.1, 0.3], [0.1, -1, 0]], np.float32)
FLAT, OTHER = [[0, 1, 2], [0, 2, 3]], [[0, 3, 4]]


def mesh(name: str, faces: list[list[int]], smooth: bool) -> mi.Mesh:
    result = mi.Mesh(name, len(POINTS), len(faces), has_vertex_normals=smooth)
    params = mi.traverse(result)
    params["vertex_positions"] = POINTS.ravel()
    params["faces"] = np.array(faces, np.uint32).ravel()
    if smooth:
        params["vertex_normals"] = np.tile(np.float32([0, 0, 1]), len(POINTS))
    params.update()
    return result


def build() -> Geometry:
    scene = {"type": "scene", "a": mesh("a", FLAT, False), "b": mesh("b", OTHER, True)}
    return load(mi.load_dict(scene)).geometry


def expected(points: npt.NDArray[np.float64], faces: list[list[int]]) -> npt.NDArray[np.float64]:
    total = np.zeros((len(points), 3))
    for face in faces:
        a, b, c = points[face]
        total[face] += np.cross(b - a, c - a)
    return total


def test_sums_and_derivatives(variant: str) -> None:
    """The smooth shape shares places with the flat one, but has no part in its normals, nor gets a derivative from them."""
    geometry = build()
    flat_shape, other = (next(i for i in geometry.shapes if i.has_normals == smooth) for smooth in (False, True))
    topology = build_topology(geometry.faces.numpy(), geometry.positions.numpy(), mi.UInt32)
    flat = flat_faces(geometry, topology)
    positions = mi.Float(geometry.positions)
    dr.enable_grad(positions)
    sums = mean_normals(facet_normals(replace(geometry, positions=positions), flat), topology, flat)
    places = topology.welded.numpy().reshape(-1, 3)[flat_shape.face_start :][: flat_shape.face_count]
    found = sums.numpy().reshape(-1, 4)
    want = expected(POINTS.astype(np.float64), FLAT)
    for face, place in zip(FLAT, places, strict=True):
        np.testing.assert_allclose(found[place, :3], want[face], atol=1e-6)

    # Weights for places in the order of POINTS; those of place k, wherever welding has put it.
    weights = np.random.default_rng(1).normal(size=(len(POINTS), 3))
    placed = np.zeros((len(found), 4), np.float32)
    for face, place in zip(FLAT, places, strict=True):
        placed[place, :3] = weights[face]
    dr.backward(dr.sum(sums * mi.Float(placed.ravel())))
    gradient = positions.grad.numpy().reshape(-1, 3)
    assert (gradient[other.vertex_start :][: other.vertex_count] == 0).all()
    own = gradient[flat_shape.vertex_start :][: flat_shape.vertex_count]
    used = sorted({vertex for face in FLAT for vertex in face})
    for vertex in used:
        for axis in range(3):
            sides = []
            for sign in (1, -1):
                moved = POINTS.astype(np.float64)
                moved[vertex, axis] += sign * 1e-4
                sides.append((expected(moved, FLAT)[used] * weights[used]).sum())
            np.testing.assert_allclose(own[vertex, axis], (sides[0] - sides[1]) / 2e-4, atol=1e-4)
