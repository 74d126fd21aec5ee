"""Meshes of the benchmark: subdivided known meshes, two worst cases for a rasterizer, and a well-behaved mesh for comparison."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io import assets
from ...io.meshes import write_ply
from ...scene.mitsuba_meshes import make_mesh, mesh_buffers

Array = npt.NDArray[Any]

# Camera of `scenes/pose.xml`.
_ORIGIN, _TARGET, _UP, _FOV_DEG = np.array([-3.0, 2.0, 4.0]), np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0]), 45.0


@dataclass(frozen=True)
class Mesh:
    """(V, 3) float32 vertices in world space and (F, 3) uint32 faces."""

    vertices: Array
    faces: Array


#: Names that `make` accepts, with their numbers of triangles.
KINDS = {
    "teapot-1k": 992,
    "spot-6k": 5856,
    "spot-23k": 23424,
    "torus-48k": 48000,
    "spot-94k": 93696,
    "spot-375k": 374784,
    "spot-1.5M": 1499136,
    "slivers-100k": 100_000,
    "even-100k": 100_000,
    "screen-filling-10k": 10_000,
}


def make(kind: str) -> Mesh:
    """A mesh of `KINDS`, or `NAME*n` for a mesh of this package with each triangle divided in four n times."""
    if kind == "torus-48k":
        return torus(200, 120)
    if kind.startswith("slivers-"):
        return slivers(KINDS.get(kind) or _count(kind))
    if kind.startswith("even-"):
        return even(KINDS.get(kind) or _count(kind))
    if kind.startswith("screen-filling-"):
        return screen_filling(KINDS.get(kind) or _count(kind))
    name, _, levels = kind.partition("*")
    if kind in KINDS:
        name, levels = kind.split("-")[0], str(round(np.log(KINDS[kind] / (992 if "teapot" in kind else 5856)) / np.log(4)))
    mesh = mi.load_dict({"type": "ply", "filename": str(assets.mesh(name)), "face_normals": True})
    buffers = mesh_buffers(mesh)
    result = Mesh(np.array(buffers.positions).reshape(-1, 3), np.array(buffers.faces).reshape(-1, 3))
    for _ in range(int(levels or 0)):
        result = subdivided(result)
    return result


def _count(kind: str) -> int:
    text = kind.rsplit("-", 1)[1]
    if not text.isdigit() or int(text) < 1:
        raise ShadowmapError(f"no mesh {kind!r}: the last part is a number of triangles.")
    return int(text)


def subdivided(mesh: Mesh) -> Mesh:
    """Each triangle divided into four at the middles of its edges."""
    faces = mesh.faces.astype(np.int64)
    pairs = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    key, inverse = np.unique(pairs[:, 0] * len(mesh.vertices) + pairs[:, 1], return_inverse=True)
    ends = np.stack(np.divmod(key, len(mesh.vertices)), axis=1)
    middles = mesh.vertices[ends].mean(axis=1)
    ab, bc, ca = np.split(inverse.reshape(-1) + len(mesh.vertices), 3)
    a, b, c = faces.T
    four = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return Mesh(np.concatenate([mesh.vertices, middles]).astype(np.float32), four.astype(np.uint32))


def torus(around: int, across: int) -> Mesh:
    """A bumpy ring of 2 x around x across triangles."""
    u, v = (np.linspace(0, 2 * np.pi, n, endpoint=False) for n in (around, across))
    u, v = np.meshgrid(u, v, indexing="ij")
    tube = 0.3 * (1 + 0.2 * np.cos(7 * u) * np.cos(5 * v))
    ring = 0.65 + tube * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), tube * np.sin(v)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    corner = [((i + di) % around * across + (j + dj) % across).ravel() for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1))]
    faces = np.concatenate([np.stack([corner[0], corner[k], corner[k + 1]], axis=1) for k in (1, 2)])
    return Mesh(vertices.astype(np.float32), faces.astype(np.uint32))


def slivers(count: int, seed: int = 0) -> Mesh:
    """Long thin triangles along the diagonals of the image, at random places and depths: a half to a whole diagonal long
    and a thousandth of the image's side wide, so that their boxes are large and hardly a pixel's centre lies in them."""
    return _before_camera(*_slivers(count, seed))


def even(count: int, seed: int = 0) -> Mesh:
    """Equilateral triangles of one size at random places and depths, as many as in `slivers` and covering as many pixels."""
    corners, depth = _slivers(count, seed)
    rng = np.random.default_rng(seed)
    # The mean area of the parts inside the image, estimated from random points.
    u, v = rng.random((2, 64, 1, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    samples = corners[:, 0] + u * (corners[:, 1] - corners[:, 0]) + v * (corners[:, 2] - corners[:, 0])
    one, two = (corners[:, k] - corners[:, 0] for k in (1, 2))
    area = 0.5 * np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
    area = np.mean(area * (np.abs(samples) < 1).all(axis=-1).mean(axis=0))
    radius = np.sqrt(area * 4 / (3 * np.sqrt(3)))
    angle = rng.uniform(0, 2 * np.pi, (count, 1)) + np.arange(3) * (2 * np.pi / 3)
    centre = rng.uniform(radius - 1, 1 - radius, (count, 1, 2))
    return _before_camera(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1), depth)


def _slivers(count: int, seed: int) -> tuple[Array, Array]:
    """Image positions (n, 3, 2) and depths (n,)."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform(-0.7, 0.7, (count, 2))
    along = np.where(rng.random(count) < 0.5, 1.0, -1.0)[:, None] * [1.0, 0.0] + [0.0, 1.0]
    half = rng.uniform(0.5, 1.0, (count, 1)) * along
    side = half[:, ::-1] * [1, -1] / np.linalg.norm(half, axis=1, keepdims=True) * 0.002
    return np.stack([centre - half, centre + half, centre + half + side], axis=1), rng.uniform(3.0, 5.0, count)


def screen_filling(count: int, seed: int = 0) -> Mesh:
    """Triangles that each cover the whole image, behind each other in random order."""
    depth = np.random.default_rng(seed).permutation(np.linspace(3.0, 5.0, count))
    corners = np.array([[-1.5, -1.5], [4.5, -1.5], [-1.5, 4.5]])
    return _before_camera(np.broadcast_to(corners, (count, 3, 2)), depth)


def _before_camera(corners: Array, depth: Array) -> Mesh:
    """Separate triangles from image positions in [-1, 1]^2 (n, 3, 2) and distances along the camera's axis (n,)."""
    forward = _TARGET - _ORIGIN
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, _UP)
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    scale = np.tan(np.radians(_FOV_DEG / 2)) * depth[:, None, None]
    lateral = corners * scale
    points = _ORIGIN + depth[:, None, None] * forward + lateral[..., :1] * right + lateral[..., 1:] * up
    faces = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    return Mesh(points.reshape(-1, 3).astype(np.float32), faces)


def stored(kind: str, folder: Path) -> Path:
    """PLY file of `make(kind)` in a folder, written the first time."""
    path = folder / f"{kind.replace('*', '_')}.ply"
    if not path.exists():
        mesh = make(kind)
        write_ply(path, make_mesh(kind, mesh.vertices, mesh.faces))
    return path


def scene(mesh: Path, resolution: int, lights: int = 1, sensors: int = 1, *, points: bool = False) -> mi.Scene:
    """`scenes/pose.xml` with a mesh, more lights from directions around the first (of the same total irradiance), or the
    same camera several times side by side. ``points``: point lights on a circle instead of directional ones."""
    text = assets.scene("pose").read_text(encoding="utf-8")
    begin, end = text.index("<emitter"), text.index("</emitter>") + len("</emitter>")
    emitters = []
    for k in range(lights):
        angle = 2 * np.pi * k / lights
        x, y = (0.3 * np.cos(angle), 0.3 * np.sin(angle)) if lights > 1 else (0.0, 0.0)
        emitters.append(
            f'<emitter type="point" id="light{k}"><point name="position" x="{-9 * x}" y="{-9 * y}" z="3"/>'
            f'<rgb name="intensity" value="{20 * np.pi / lights}"/></emitter>'
            if points
            else f'<emitter type="directional" id="light{k}"><vector name="direction" x="{x}" y="{y}" z="-1"/>'
            f'<rgb name="irradiance" value="{np.pi / lights}"/></emitter>'
        )
    text = text[:begin] + "".join(emitters) + text[end:]
    if sensors > 1:
        begin, end = text.index("<sensor"), text.index("</sensor>") + len("</sensor>")
        camera = text[begin:end].replace(' id="camera"', "")
        film_begin, film_end = camera.index("<film"), camera.index("</film>") + len("</film>")
        film = camera[film_begin:film_end].replace(
            '<integer name="width" value="$resolution"/>', f'<integer name="width" value="{resolution * sensors}"/>'
        )
        text = text[:begin] + f'<sensor type="batch">{film}{camera * sensors}</sensor>' + text[end:]
    return mi.load_string(text, optimize=False, object=str(mesh), resolution=str(resolution))
