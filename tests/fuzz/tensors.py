"""Meshes as PyTorch tensors, given to the functions of `shadowmap_dr.torch`."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch

import shadowmap_dr.torch as sdr
from shadowmap_dr import ShadowSettings

from .outcome import check
from .random_meshes import RandomMesh, random_mesh
from .values import OTHERS, chance, integer, number, pick


def run(rng: np.random.Generator, folder: Path) -> str:
    """Give tensors to one of the functions."""
    return pick(rng, (_rasterize, _rasterize, _antialias, _shadows, _render))(rng, random_mesh(rng))


def _tensor(rng: np.random.Generator, values: Any) -> Any:
    """A tensor; one of eight of another shape, type or layout."""
    tensor = torch.from_numpy(np.ascontiguousarray(values))
    if chance(rng, 0.88):
        return tensor
    choices: list[Any] = [
        tensor.double(),
        tensor.half(),
        tensor.int(),
        tensor.long(),
        tensor[:0],
        tensor[..., :1],
        tensor[None],
        tensor.reshape(-1),
        tensor.T,
        tensor.to_sparse(),
        tensor.bool(),
        torch.tensor(1.0),
        np.asarray(values),
        tensor.to(torch.complex64),
        tensor.to("meta"),
        tensor.float().requires_grad_(),
        *OTHERS,
    ]
    return pick(rng, choices)


def _clip(mesh: RandomMesh) -> Any:
    return np.c_[mesh.vertices, np.full(len(mesh.vertices), 1.5)].astype(np.float32)


def _faces(rng: np.random.Generator, mesh: RandomMesh) -> Any:
    return _tensor(rng, mesh.faces.astype(pick(rng, (np.int64, np.int32))))


def _finite(tensor: torch.Tensor, name: str) -> None:
    check(bool(torch.isfinite(tensor).all()), f"{name} not finite")


def _rasterize(rng: np.random.Generator, mesh: RandomMesh) -> str:
    options: dict[str, Any] = {}
    if chance(rng, 0.2):
        options["ranges"] = pick(
            rng, ([(0, 1)], [(0, 1), (0, 1)], [(0, 0)], [(-1, 2)], [(0, 10**9)], torch.zeros(1, 2), [], "x", [(0,)], None)
        )
    if chance(rng, 0.1):
        options["layers"] = pick(rng, (0, -1, 2, 1.5, None, True))
    size: Any = (8, 8) if chance(rng, 0.8) else pick(rng, ((7, 13), (0, 8), (integer(rng), 0), 8, (8.5, 8), None, "ab"))
    faces = _faces(rng, mesh)
    found = sdr.rasterize(_tensor(rng, _clip(mesh)), faces, size, **options)
    triangles = found.triangle
    check(int(triangles.max()) < faces.shape[-2], f"triangle {int(triangles.max())} of {faces.shape[-2]}")
    if mesh.sound:
        for name in ("u", "v", "depth"):
            _finite(getattr(found, name), name)
        attributes = torch.from_numpy(mesh.vertices)
        if chance(rng, 0.5):
            attributes = _tensor(rng, mesh.vertices)
        values = sdr.interpolate(attributes, found, faces)
        _finite(values, "interpolated values")
    return f"{int((triangles >= 0).sum())} pixels"


def _antialias(rng: np.random.Generator, mesh: RandomMesh) -> str:
    positions = torch.from_numpy(_clip(mesh)).requires_grad_()
    faces = torch.from_numpy(mesh.faces.astype(np.int64))
    topology = sdr.build_topology(_tensor(rng, mesh.faces.astype(np.int64)), _tensor(rng, mesh.vertices))
    found = sdr.rasterize(positions, faces, (8, 8))
    image = (found.triangle >= 0).float()[..., None]
    options: dict[str, Any] = {}
    if chance(rng, 0.3):
        options["gap"] = pick(rng, (0, 1e-3, -1.0, float("nan"), float("inf"), "x", None))
    if chance(rng, 0.3):
        options["creases"] = pick(
            rng, (torch.ones(faces.shape, dtype=torch.bool), torch.ones(faces.shape), torch.ones(2, 2, dtype=torch.bool), 1)
        )
    if chance(rng, 0.2):
        options["face_normals"] = pick(
            rng, (torch.zeros(faces.shape), torch.full(faces.shape, float("nan")), torch.ones(1, 3), "x")
        )
    if chance(rng, 0.2):
        options["continued"] = pick(rng, (True, 1, None))
    blended = sdr.antialias(image if chance(rng, 0.9) else _tensor(rng, image.numpy()), found, positions, topology, **options)
    _finite(blended, "a blended image is")
    if blended.requires_grad:
        blended.sum().backward()
        if mesh.sound and positions.grad is not None:
            _finite(positions.grad, "a gradient is")
    return f"mean {float(blended.detach().mean()):.3f}"


def _vector(rng: np.random.Generator) -> Any:
    if chance(rng, 0.8):
        return torch.tensor(rng.normal(size=3), dtype=torch.float32)
    return pick(
        rng,
        (
            torch.zeros(3),
            torch.full((3,), float("nan")),
            torch.tensor([number(rng), 0, 1]).float(),
            torch.ones(2),
            torch.ones(3).double(),
            None,
            [0, 0, 1],
        ),
    )


def _spot(position: Any, direction: Any, angle: Any) -> Any:
    return sdr.SpotLight(position, direction, angle)


def _shadows(rng: np.random.Generator, mesh: RandomMesh) -> str:
    makers = (
        lambda: sdr.DirectionalLight(_vector(rng)),
        lambda: sdr.PointLight(_vector(rng)),
        lambda: _spot(
            _vector(rng), _vector(rng), 40.0 if chance(rng, 0.7) else pick(rng, (0, -1, 90, 180, float("nan"), "x", None, 75.0))
        ),
        lambda: pick(rng, OTHERS),
    )
    lights: Any = makers[int(pick(rng, (0, 0, 0, 1, 2, 2, 3)))]()
    settings = ShadowSettings(method=pick(rng, ("auto", "vsm", "msm", "pcf", "standard", "esm")), resolution=16, filter_size=3)
    faces = torch.from_numpy(mesh.faces.astype(np.int64))
    topology = sdr.build_topology(faces, torch.from_numpy(mesh.vertices))
    maps = sdr.filter_maps(
        sdr.render_maps(_tensor(rng, mesh.vertices), topology, [lights] if chance(rng, 0.5) else lights, settings)
    )
    points = torch.from_numpy(rng.uniform(-3, 3, (4, 5, 3)).astype(np.float32))
    light: Any = 0 if chance(rng, 0.9) else pick(rng, (1, -1, "x", None, 0.5))
    seen = sdr.visibility(maps, points if chance(rng, 0.9) else _tensor(rng, points.numpy()), light)
    _finite(seen, "visibilities are")
    seen = seen.detach()
    low, high = float(seen.min()), float(seen.max())
    check(low >= -1e-4 and high <= 1 + 1e-4, f"visibilities from {low} to {high}")
    return f"mean {float(seen.mean()):.3f}"


@functools.cache
def _renderer() -> Any:
    import renderer_scenes

    scene = renderer_scenes.build(camera=renderer_scenes.camera(16, 16))
    return sdr.Renderer.from_scene(scene, shadow_map_resolution=32, shadow_filter_size=3, tessellation=8)


def _render(rng: np.random.Generator, mesh: RandomMesh) -> str:
    renderer = _renderer()
    count = len(renderer.vertices("ball"))
    vertices = np.resize(mesh.vertices, (count, 3)).astype(np.float32)
    given: dict[str, Any] = {"vertex_positions": {pick(rng, ("ball", "ball", "ball", "floor", "none")): _tensor(rng, vertices)}}
    if chance(rng, 0.4):
        light = pick(rng, ("sun", "lamp", "none"))
        given["lights"] = {light: {pick(rng, ("direction", "position", "irradiance", "intensity", "x")): _vector(rng)}}
    if chance(rng, 0.2):
        names = ("floor.bsdf.reflectance.value", "camera.to_world", "none", "", "lamp.intensity.value", "camera.film.size")
        values = (torch.rand(3), torch.rand(1), torch.eye(4), torch.full((3,), float("nan")), torch.zeros(4, 4), 1.0)
        given["parameters"] = {pick(rng, names): pick(rng, values)}
    if chance(rng, 0.1):
        given[pick(rng, ("spp", "sensor"))] = pick(rng, (0, -1, 2, "x", None, 1e9, float("nan"), True))
    if chance(rng, 0.05):
        given[pick(rng, ("vertex_positions", "lights", "parameters"))] = pick(rng, OTHERS)
    image = renderer.render(**given)
    check(tuple(image.shape) == (16, 16, 3), f"an image of shape {tuple(image.shape)}")
    if not any("nan" in str(value) or "inf" in str(value) for key, value in given.items() if key != "vertex_positions"):
        _finite(image, "an image is")
    return f"mean {float(image.detach().mean()):.3f}"
