"""Meshes in memory, given to the functions of `raster` and `shadow`, and to `Renderer`."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import brute_force
import drjit as dr
import mitsuba as mi
import numpy as np
import shadow_scene

import shadowmap_dr
from shadowmap_dr import raster, shadow

from .outcome import check
from .random_meshes import RandomMesh, random_mesh
from .values import OTHERS, chance, integer, number, pick

_SIZES = ((8, 8), (7, 13), (24, 24), (1, 1))
_SETTINGS = {"shadow_map_resolution": 32, "shadow_filter_size": 3, "tessellation": 8}


def run(rng: np.random.Generator, folder: Path) -> str:
    """Give a mesh to one of the functions."""
    mesh = random_mesh(rng)
    return pick(
        rng, (_rasterize, _rasterize, _wrong_arguments, _wrong_values, _antialias, _shadow_maps, _render, _scene, _settings)
    )(rng, mesh)


def _clip(rng: np.random.Generator, mesh: RandomMesh) -> Any:
    with np.errstate(over="ignore", invalid="ignore"):
        w = np.ones(len(mesh.vertices)) if chance(rng, 0.5) else 2 - mesh.vertices[:, 2] * pick(rng, (0.5, 3.0, -1.0))
        return np.c_[mesh.vertices * [1, 1, 0.9], w].astype(np.float32)


def _faces(mesh: RandomMesh) -> Any:
    return (
        mi.TensorXu(mesh.faces.astype(np.int64).astype(np.uint32))
        if len(mesh.faces)
        else mi.TensorXu(dr.zeros(mi.UInt32, 0), (0, 3))
    )


def _rasterize(rng: np.random.Generator, mesh: RandomMesh) -> str:
    positions = _clip(rng, mesh)
    size = pick(rng, _SIZES) if chance(rng, 0.9) else (integer(rng), integer(rng))
    if size[0] * size[1] > 1 << 20:
        size = size[0], 0
    out = raster.rasterize(mi.TensorXf(positions), _faces(mesh), size)
    check(mesh.usable, "indices out of range were accepted")
    ids = out.triangle.numpy().astype(np.int64)
    seen = ids != raster.NO_TRIANGLE
    check(len(ids) == size[0] * size[1], f"{len(ids)} pixels")
    check((ids[seen] < len(mesh.faces)).all(), f"triangle {ids[seen].max(initial=0)} of {len(mesh.faces)}")
    corners = positions[mesh.faces[ids[seen]].astype(np.int64)]
    check(np.isfinite(corners).all(), "a triangle without finite vertices is seen")
    values = np.stack([getattr(out, name).numpy() for name in ("u", "v", "depth")])
    if np.abs(corners).max(initial=0) < 1e6:
        check(np.isfinite(values).all(), "barycentrics or depths are not finite")
    if mesh.sound:
        _compare(positions, mesh, size, ids, seen)
    return f"{int(seen.sum())} of {len(ids)} pixels"


def _compare(positions: Any, mesh: RandomMesh, size: tuple[int, int], ids: Any, seen: Any) -> None:
    """Compare with the rasterizer in NumPy, where pixels are not close to a decision."""
    if np.abs(positions).max() > 100:
        return
    with np.errstate(all="ignore"):
        found = brute_force.rasterize(positions, mesh.faces.astype(np.int64), *size)
    decided = (found["margin_px"] > 1 / 128) & (found["margin_depth"] > 1e-4)
    # Triangles that lie on each other.
    wrong = decided & (np.where(seen, ids, -1) != found["triangle"])
    check(not wrong.any(), f"{int(wrong.sum())} pixels see other triangles than by brute force")


def _wrong_arguments(rng: np.random.Generator, mesh: RandomMesh) -> str:
    """Arguments of other types and shapes."""
    positions = _clip(rng, mesh)
    choices: list[Any] = [
        mi.TensorXf(positions[:, :3]),
        mi.TensorXf(positions.ravel()),
        mi.Float(positions.ravel()),
        mi.Float(positions.ravel()[:-1]),
        mi.TensorXf(positions[None]),
        mi.TensorXf(positions[None, None]),
        mi.TensorXd(positions),
        positions,
        mi.TensorXu(positions),
        mi.Point3f(0),
        mi.Float(),
        *OTHERS,
    ]
    indices: list[Any] = [
        _faces(mesh),
        mi.TensorXf(positions),
        mi.TensorXi(mesh.faces.astype(np.int32)) if len(mesh.faces) else mi.TensorXi(),
        mi.UInt32(np.zeros(3, np.uint32)),
        mi.UInt32(np.zeros(4, np.uint32)),
        mi.UInt32(),
        mesh.faces,
        *OTHERS,
    ]
    options: dict[str, Any] = {}
    if chance(rng, 0.3):
        options["batch"] = pick(rng, (1, 2, 0, -1, None, 3))
    if chance(rng, 0.1):
        options["layers"] = pick(rng, (1, 0, -1, 3))
    size: Any = (8, 8) if chance(rng, 0.6) else pick(rng, (8, (8,), (8, 8, 8), (8.0, 8), ("8", 8), None, (0, 8), (8, 5000)))
    first = mi.TensorXf(positions) if chance(rng, 0.3) else pick(rng, choices)
    out = raster.rasterize(first, pick(rng, indices), size, **options)
    ids = out.triangle.numpy()
    return f"{int((ids != raster.NO_TRIANGLE).sum())} of {len(ids)} pixels"


def _wrong_values(rng: np.random.Generator, mesh: RandomMesh) -> str:
    """Arguments of other types and shapes for what follows a rasterization."""
    if not mesh.usable:
        return _rasterize(rng, mesh)
    positions, faces = mi.TensorXf(_clip(rng, mesh)), _faces(mesh)
    found = raster.rasterize(positions, faces, (8, 8))
    others: list[Any] = [
        *OTHERS,
        mi.Float(),
        mi.Float(0),
        mi.TensorXf(),
        mi.Point3f(0),
        mi.Float64(0.5),
        faces,
        positions,
        [mi.Float(1)] * 2,
    ]
    kind = int(rng.integers(3))
    if kind == 0:
        values = raster.interpolate(pick(rng, [positions, *others]), found, pick(rng, [faces, *others]))
        check(values.shape[:2] == (8, 8), f"interpolated values of shape {values.shape}")
        return f"{values.shape}"
    rows: list[Any] = [
        mesh.faces,
        mesh.faces.astype(float),
        mesh.faces.ravel(),
        mesh.faces.T,
        mesh.faces.astype(str),
        [[0, 1], [2]],
        *OTHERS,
    ]
    places: list[Any] = [mesh.vertices, mesh.vertices.astype(complex), mesh.vertices[:1], mesh.vertices.T, *OTHERS]
    chosen = (mesh.faces, mesh.vertices) if kind == 1 else (pick(rng, rows), pick(rng, places))
    topology = raster.build_topology(*chosen, mi.UInt32)
    image = pick(rng, [mi.Float(np.ones(64)), [mi.Float(0.5)], mi.TensorXf(np.ones((8, 8, 2))), *others])
    blended = raster.antialias(image, found, pick(rng, [positions, positions, positions, *others]), topology)
    return f"{dr.width(blended.array if dr.is_tensor_v(blended) else blended)} values"


def _antialias(rng: np.random.Generator, mesh: RandomMesh) -> str:
    if not mesh.usable:
        return _rasterize(rng, mesh)
    positions, size = _clip(rng, mesh), (8, 8)
    flat, faces = mi.Float(positions.ravel()), mi.UInt32(mesh.faces.astype(np.uint32).ravel())
    topology = raster.build_topology(mesh.faces.astype(np.uint32).ravel(), mesh.vertices, mi.UInt32)
    dr.enable_grad(flat)
    found = raster.rasterize(flat, faces, size)
    colours = dr.select(found.valid, mi.Float(1.0), 0.25)
    blended = raster.antialias(colours, found, flat, topology)
    values = blended.numpy()
    check(np.isfinite(values).all(), "a blended image is not finite")
    check(values.min() >= 0.25 - 1e-4 and values.max() <= 1 + 1e-4, f"blended values from {values.min()} to {values.max()}")
    dr.backward(dr.sum(blended))
    if mesh.sound:
        check(np.isfinite(dr.grad(flat).numpy()).all(), "a gradient is not finite")
    return f"mean {values.mean():.3f}"


def _shadow_maps(rng: np.random.Generator, mesh: RandomMesh) -> str:
    """Shadow maps of one light, and its visibility from points behind the mesh."""
    if not mesh.usable:
        return _rasterize(rng, mesh)
    method = pick(rng, ("evsm4", "vsm", "msm", "pcf", "standard", "esm", "csm"))
    settings = shadow.ShadowSettings(method=method, resolution=16, filter_size=3)
    direction = mi.Vector3f(*(float(x) for x in rng.normal(size=3)))
    if chance(rng, 0.5):
        views = [shadow.directional_view(direction)]
    else:
        own = shadow.directional_view(direction)
        position = mi.Point3f(*(float(x) for x in 2 * rng.normal(size=3)))
        views = [shadow.spot_view(position, own.right, own.up, own.forward, mi.Float(float(rng.uniform(0.01, 1.7))))]
    vertices = mi.Point3f(mesh.vertices.T)
    maps = shadow_scene.make_maps(views, vertices, mesh.vertices, mesh.faces.astype(np.int64), settings)
    points = mi.Point3f(rng.uniform(-3, 3, (3, 64)).astype(np.float32))
    seen = np.asarray(shadow.visibility(maps, 0, points).numpy())
    check(np.isfinite(seen).all(), f"a visibility of {method} is not finite")
    check(seen.min() >= -1e-4 and seen.max() <= 1 + 1e-4, f"visibilities of {method} from {seen.min()} to {seen.max()}")
    return f"{method}: mean {seen.mean():.3f}"


@functools.cache
def _renderer() -> Any:
    import renderer_scenes

    return shadowmap_dr.Renderer.from_scene(renderer_scenes.build(camera=renderer_scenes.camera(16, 16)), **_SETTINGS)


def _render(rng: np.random.Generator, mesh: RandomMesh) -> str:
    """Other vertices, lights and settings for a scene."""
    renderer = _renderer()
    count = renderer.data.geometry.shape("ball").vertex_count
    vertices = np.resize(mesh.vertices, (count, 3)).astype(np.float32)
    flat = mi.Float(vertices.ravel())
    forms: list[Any] = [flat, mi.TensorXf(vertices), mi.Point3f(vertices.T)]
    if chance(rng, 0.2):
        forms = [
            mi.Float(vertices.ravel()[:-3]),
            mi.TensorXf(vertices.T.copy()),
            mi.Float(0),
            mi.TensorXf(vertices[None]),
            *OTHERS,
        ]
    given: Any = {"ball" if chance(rng, 0.95) else pick(rng, ("none", "", "sun")): pick(rng, forms)}
    options: dict[str, Any] = (
        {"spp": int(pick(rng, (1, 4)))}
        if chance(rng, 0.8)
        else {pick(rng, ("spp", "sensor")): pick(rng, (0, -1, 10**9, "x", None, 1.5, 2))}
    )
    image = renderer.render(given, **options).numpy()
    check(image.shape == (16, 16, 3), f"an image of shape {image.shape}")
    check(np.isfinite(image).all() or not mesh.moderate, "an image is not finite")
    return f"mean {image.mean():.3f}"


def _scene(rng: np.random.Generator, mesh: RandomMesh) -> str:
    """A mesh in a scene of its own."""
    import renderer_scenes

    made = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces))
    params = mi.traverse(made)
    params["vertex_positions"] = mi.Float(mesh.vertices.ravel())
    params["faces"] = mi.UInt32(mesh.faces.astype(np.int64).astype(np.uint32).ravel())
    params.update()
    scene = renderer_scenes.build(ball=made, camera=renderer_scenes.camera(16, 16))
    image = shadowmap_dr.Renderer.from_scene(scene, **_SETTINGS).render().numpy()
    check(mesh.usable, "indices out of range were accepted")
    check(image.shape == (16, 16, 3), f"an image of shape {image.shape}")
    check(np.isfinite(image).all() or not mesh.moderate, "an image is not finite")
    return f"mean {image.mean():.3f}"


def _settings(rng: np.random.Generator, mesh: RandomMesh) -> str:
    """Settings of renderings, of any type."""
    from dataclasses import fields

    from shadowmap_dr.rendering.settings import SHADOW_NAMES, RenderSettings

    names = [*SHADOW_NAMES, *(f.name for f in fields(RenderSettings)), "unknown", ""]
    values: list[Callable[[], Any]] = [
        lambda: integer(rng),
        lambda: number(rng),
        lambda: pick(rng, OTHERS),
        lambda: pick(rng, ("vsm", "box", "none", "samples", "single")),
        lambda: chance(rng, 0.5),
    ]
    given = {pick(rng, names): pick(rng, values)() for _ in range(int(rng.integers(1, 4)))}
    settings = RenderSettings.of(**given)
    hash(settings)
    return f"{sorted(given)}"
