"""A slow NumPy twin of the rasterizer in double precision: every pixel against every triangle."""

from __future__ import annotations

import numpy as np


def rasterize(pos: np.ndarray, faces: np.ndarray, height: int, width: int) -> dict[str, np.ndarray]:
    """Rasterize one image; also returns per pixel how close a decision was.

    ``margin_px`` is the distance of the pixel centre to the nearest edge of any triangle whose plane it sees, and
    ``margin_depth`` the depth gap between the two nearest covering triangles (or to the clip planes).
    """
    pos = pos.astype(np.float64)
    x = (2 * np.arange(width) + 1) / width - 1
    y = (2 * np.arange(height) + 1) / height - 1
    px, py = np.meshgrid(x, y)
    ray = np.stack([px, py, np.ones_like(px)], -1).reshape(-1, 3)
    n = len(ray)
    best_z, best_id = np.full(n, np.inf), np.full(n, -1)
    second_z = np.full(n, np.inf)
    uv = np.zeros((n, 2))
    margin = np.full(n, np.inf)
    clip_margin = np.full(n, np.inf)
    for f, face in enumerate(faces):
        p = pos[face][:, [0, 1, 3]]
        lines = np.stack([np.cross(p[1], p[2]), np.cross(p[2], p[0]), np.cross(p[0], p[1])])
        det = lines[0] @ p[0]
        if det == 0:
            continue
        value = ray @ lines.T
        b = value / det
        norm = np.hypot(lines[:, 0] * 2 / width, lines[:, 1] * 2 / height)
        distance = np.abs(value) / np.maximum(norm, 1e-300)
        inside = (b >= 0).all(1)
        # Only edges of the (nearly) covered region matter: the other two edges must accept the pixel, or nearly so.
        signed = np.sign(det) * value / np.maximum(norm, 1e-300)
        near_region = (signed > -0.01).all(1)
        margin = np.where(near_region, np.minimum(margin, distance.min(1)), margin)
        z = b @ pos[face][:, 2]
        clip_margin = np.where(inside, np.minimum(clip_margin, np.abs(1 - np.abs(z))), clip_margin)
        covered = inside & (np.abs(z) <= 1)
        closer = covered & (z < best_z)
        second_z = np.where(closer, best_z, np.where(covered, np.minimum(second_z, z), second_z))
        best_z = np.where(closer, z, best_z)
        best_id = np.where(closer, f, best_id)
        total = b.sum(1)
        uv = np.where(closer[:, None], b[:, 1:] / np.where(total == 0, 1, total)[:, None], uv)
    with np.errstate(invalid="ignore"):
        gap = second_z - best_z
    return {
        "triangle": best_id,
        "uv": uv,
        "depth": np.where(best_id < 0, 1.0, best_z),
        "margin_px": margin,
        "margin_depth": np.minimum(np.where(np.isnan(gap), np.inf, gap), clip_margin),
    }


def perspective(fov_deg: float = 60.0, near: float = 0.1, far: float = 20.0) -> np.ndarray:
    """OpenGL-style projection."""
    c = 1 / np.tan(np.radians(fov_deg) / 2)
    a, b = -(far + near) / (far - near), -2 * far * near / (far - near)
    return np.array([[c, 0, 0, 0], [0, c, 0, 0], [0, 0, a, b], [0, 0, -1.0, 0]])


def random_soup(rng: np.random.Generator, sizes: np.random.Generator) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Random triangles before (and behind) a random camera, with shared vertices, slivers, tiny and huge triangles.

    How many they are and how large the image is comes from `sizes`: kernels are compiled for each size anew.
    """
    kind = rng.integers(5)
    v = int(sizes.integers(3, 40))
    f = int(sizes.integers(1, 60))
    height, width = (int(r) for r in sizes.integers(1, 70, 2))
    extent = [1.0, 1.0, 0.1, 5.0, 1.0][kind]
    world = rng.uniform(-extent, extent, (v, 3))
    if kind == 3:  # through the camera plane
        world[:, 2] -= 1.0
    else:
        world[:, 2] -= 3.0
    if kind == 4:  # coordinates on a coarse lattice: edges through pixel centres, coincident and degenerate triangles
        world = np.round(world * 4) / 4
    homogeneous = np.c_[world, np.ones(v)]
    if kind in (1, 4):
        clip = homogeneous.copy()
        clip[:, 2] = (homogeneous[:, 2] + 3) / 2
    else:
        clip = homogeneous @ perspective(rng.uniform(30, 110)).T
    return clip.astype(np.float32), rng.integers(0, v, (f, 3)).astype(np.uint32), height, width
