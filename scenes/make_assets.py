"""Makes the textures and the procedural meshes of the example scenes: ``python scenes/make_assets.py [NAME ...]``.

Names are those of the functions of `ASSETS`; all without.

Everything follows from the constants below, so the files can be made again at any time. The textures are smooth at the
scale of a pixel (except the leaf's opacity, which is binary on purpose): hard texture edges would make a comparison
between two renderers one of their texture filters.
"""

from __future__ import annotations

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

HERE = Path(__file__).parent
SIZE = 256


def grid(size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Texel centres in [0, 1): two (size, size) arrays, x along columns and y along rows."""
    line = (np.arange(size) + 0.5) / size
    return np.meshgrid(line, line)


def smooth_step(low: float, high: float, value: np.ndarray) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def waves(x: np.ndarray, y: np.ndarray, seed: int, frequencies: int, count: int) -> np.ndarray:
    """Periodic noise in about [-1, 1]: a sum of sines with random integer frequencies, so that it tiles."""
    rng = np.random.default_rng(seed)
    total = np.zeros_like(x)
    for _ in range(count):
        fx, fy = rng.integers(-frequencies, frequencies + 1, size=2)
        total += rng.normal() * np.sin(2 * np.pi * (fx * x + fy * y + rng.random()))
    return total / np.abs(total).max()


def save(name: str, pixels: np.ndarray, dtype: type = np.uint8) -> None:
    """Writes values in [0, 1] as a PNG of 8 or 16 bits without a change of encoding."""
    data = np.round(np.clip(pixels, 0, 1) * np.iinfo(dtype).max).astype(dtype)
    mi.Bitmap(data).write(str(HERE / "textures" / name))


def tiles() -> np.ndarray:
    """Floor tiles: 4 x 4, each of a tint of its own, with soft joints."""
    x, y = grid()
    rng = np.random.default_rng(3)
    tint = rng.uniform(0.75, 1.0, size=(4, 4, 1)) * np.array([0.78, 0.66, 0.52])
    cell = tint[(y * 4).astype(int), (x * 4).astype(int)]
    joint = np.maximum(np.abs((x * 4) % 1 - 0.5), np.abs((y * 4) % 1 - 0.5))
    blend = smooth_step(0.43, 0.49, joint)[..., None]
    marble = 1 + 0.10 * waves(x, y, 5, 7, 30)[..., None]
    return cell * marble * (1 - blend) + np.array([0.42, 0.38, 0.36]) * blend


def glaze() -> np.ndarray:
    """The vase's glaze: bands along v, which runs up the vase, with a wavy pattern between them."""
    x, y = grid()
    wave = 0.5 + 0.5 * np.sin(2 * np.pi * (6 * x + 0.35 * np.sin(2 * np.pi * 5 * y)))
    band = smooth_step(0.55, 0.8, 0.5 + 0.5 * np.cos(2 * np.pi * 4 * y))
    base = np.array([0.85, 0.80, 0.70]) * (1 - wave[..., None]) + np.array([0.10, 0.28, 0.55]) * wave[..., None]
    return base * (1 - band[..., None]) + np.array([0.62, 0.22, 0.10]) * band[..., None]


def hammered() -> tuple[np.ndarray, np.ndarray]:
    """Height and normal map of a gently hammered surface."""
    x, y = grid()
    height = waves(x, y, 11, 6, 40)
    dx = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * SIZE / 2
    dy = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) * SIZE / 2
    normal = np.stack([-dx, dy, np.full_like(dx, 60.0)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return 0.5 + 0.5 * height, 0.5 + 0.5 * normal


def leaf() -> tuple[np.ndarray, np.ndarray]:
    """Colour and binary opacity of a lobed leaf with holes."""
    x, y = grid()
    angle, radius = np.arctan2(y - 0.5, x - 0.5), np.hypot(x - 0.5, y - 0.5)
    outline = 0.33 + 0.11 * np.cos(5 * angle) + 0.02 * np.cos(15 * angle)
    opacity = (radius < outline).astype(float)
    for hole_angle in np.arange(5) * 2 * np.pi / 5:
        centre = 0.5 + 0.24 * np.array([np.cos(hole_angle), np.sin(hole_angle)])
        opacity[np.hypot(x - centre[0], y - centre[1]) < 0.055] = 0
    vein = smooth_step(0.0, 0.03, np.abs(np.sin(2.5 * angle)) * radius)
    return np.array([0.55, 0.62, 0.20]) * (0.6 + 0.4 * vein[..., None]), opacity


def slide() -> np.ndarray:
    """The picture that a spot light projects: soft coloured window panes."""
    x, y = grid()
    pane = smooth_step(0.06, 0.14, np.abs(((x * 3) % 1) - 0.5) * -1 + 0.5) * smooth_step(
        0.06, 0.14, np.abs(((y * 3) % 1) - 0.5) * -1 + 0.5
    )
    hue = np.stack([0.6 + 0.4 * np.cos(2 * np.pi * (x + y + k / 3)) for k in range(3)], axis=-1)
    return 0.15 + 0.85 * pane[..., None] * hue


def write_mesh(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray,
    texcoords: np.ndarray,
    colors: np.ndarray | None = None,
) -> None:
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True)
    if colors is not None:
        mesh.add_attribute("vertex_color", 3, colors.astype(np.float32).ravel())
    params = mi.traverse(mesh)
    params["vertex_positions"] = vertices.astype(np.float32).ravel()
    params["vertex_normals"] = normals.astype(np.float32).ravel()
    params["vertex_texcoords"] = texcoords.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    mesh.write_ply(str(HERE / "meshes" / name))


def sheet(columns: int, rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters u, v in [0, 1] of a (columns + 1) x (rows + 1) lattice and its two triangles per cell."""
    u, v = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, up = corner + 1, corner + columns + 1
    faces = np.concatenate([np.stack([corner, right, up + 1], 1), np.stack([corner, up + 1, up], 1)])
    return u.ravel(), v.ravel(), faces


def normalised(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def vase() -> None:
    """Surface of revolution about y, standing on y = 0, 2 high; u around, v up. Seam at u = 0 (duplicated vertices)."""
    u, v, faces = sheet(72, 48)
    angle = 2 * np.pi * u

    def radius(t: np.ndarray) -> np.ndarray:
        return 0.38 + 0.26 * np.sin(np.pi * (1.25 * t + 0.08)) + 0.10 * t**6

    slope = (radius(v + 1e-4) - radius(v - 1e-4)) / 2e-4 / 2  # the height is 2 v
    around = np.stack([np.cos(angle), np.zeros_like(u), -np.sin(angle)], 1)
    vertices = around * radius(v)[:, None] + np.stack([np.zeros_like(u), 2 * v, np.zeros_like(u)], 1)
    normals = normalised(around - slope[:, None] * np.array([0, 1, 0]))
    write_mesh("vase.ply", vertices, faces, normals, np.stack([u, v], 1))


def drape() -> None:
    """A wavy cloth over [-1, 1]^2 in x, z with a colour at each vertex."""
    u, v, faces = sheet(80, 80)
    x, z = 2 * u - 1, 1 - 2 * v

    def height(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        return 0.16 * np.sin(4.2 * x + 1.2 * np.sin(2.1 * z)) + 0.09 * np.cos(5.0 * z - 1.5 * x)

    step = 1e-4
    slope_x = (height(x + step, z) - height(x - step, z)) / (2 * step)
    slope_z = (height(x, z + step) - height(x, z - step)) / (2 * step)
    normals = normalised(np.stack([-slope_x, np.ones_like(x), -slope_z], 1))
    ripple = 0.5 + 0.5 * np.sin(2 * np.pi * 2.5 * np.hypot(x, z))
    colors = np.array([0.75, 0.18, 0.15]) * ripple[:, None] + np.array([0.85, 0.75, 0.35]) * (1 - ripple[:, None])
    write_mesh("drape.ply", np.stack([x, height(x, z), z], 1), faces, normals, np.stack([u, v], 1), colors)


def leaf_card() -> np.ndarray:
    """Opacity of a pointed leaf along u, with an outline as wide as a texel."""
    x, y = grid(64)
    half_width = 0.42 * np.sin(np.pi * np.clip((x - 0.04) / 0.92, 0, 1)) ** 0.8 * (1.15 - 0.35 * x)
    return smooth_step(-0.016, 0.016, half_width - np.abs(y - 0.5))


def quads(centres: np.ndarray, along: np.ndarray, across: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces, normals and texture coordinates of N parallelograms, from their middles and half sides (N, 3)."""
    count = len(centres)
    corners = np.stack([centres + a * along + b * across for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], 1)
    faces = (4 * np.arange(count))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
    normals = np.repeat(normalised(np.cross(along, across)), 4, axis=0)
    texcoords = np.tile(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), (count, 1))
    return corners.reshape(-1, 3), faces.reshape(-1, 3), normals, texcoords


def leaves() -> None:
    """A crown of 360 cards in an ellipsoid about (0, 2.1, 0), larger outwards; each is a square that a leaf fills."""
    rng = np.random.default_rng(8)
    directions = normalised(rng.normal(size=(360, 3)))
    centres = directions * rng.uniform(0.35, 1.0, (360, 1)) ** 0.6 * np.array([1.15, 0.95, 1.15]) + np.array([0, 2.1, 0])
    along = normalised(directions + 0.9 * rng.normal(size=(360, 3)) - np.array([0, 0.4, 0]))
    across = normalised(np.cross(along, rng.normal(size=(360, 3))))
    size = rng.uniform(0.15, 0.24, (360, 1))
    write_mesh("leaves.ply", *quads(centres, size * along, size * across))


def tube(points: np.ndarray, radii: np.ndarray, sides: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces, normals and texture coordinates of a tapered tube along points (N, 3)."""
    u, v, faces = sheet(sides, len(points) - 1)
    ring, angle = np.round(v * (len(points) - 1)).astype(int), 2 * np.pi * u
    forward = normalised(points[-1] - points[0])
    side = normalised(np.cross(forward, [0.3, 0.1, 1.0]))
    around = np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * np.cross(forward, side)
    return points[ring] + radii[ring, None] * around, faces, around, np.stack([u, v], 1)


def joined(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """One mesh of several."""
    starts = np.cumsum([0, *(len(part[0]) for part in parts[:-1])])
    moved = [(vertices, faces + start, *rest) for (vertices, faces, *rest), start in zip(parts, starts, strict=True)]
    return [np.concatenate(arrays) for arrays in zip(*moved, strict=True)]


def trunk() -> None:
    """A trunk from (0, 0, 0) to (0.05, 2.2, 0) with five branches."""
    t = np.linspace(0, 1, 9)
    bend = np.stack([0.08 * np.sin(3 * t), 2.2 * t, 0.05 * np.sin(4 * t)], 1)
    parts = [tube(bend, 0.17 - 0.12 * t)]
    for k in range(5):
        angle, start = 2 * np.pi * (0.1 + k / 5), bend[4 + k % 3]
        end = start + np.array([0.75 * np.cos(angle), 0.45 + 0.1 * k, 0.75 * np.sin(angle)])
        parts.append(tube(start + (end - start) * t[:, None], 0.055 - 0.04 * t, 8))
    write_mesh("trunk.ply", *joined(parts))


def box(low: tuple[float, ...], high: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The six sides of a box, with normals to the outside."""
    middle, half = (np.array(high) + low) / 2, (np.array(high) - low) / 2
    axes = [(sign, np.roll(np.eye(3), k, axis=0)) for k in range(3) for sign in (-1, 1)]
    centres = np.stack([middle + sign * half * axis[0] for sign, axis in axes])
    along = np.stack([half * axis[1] for _, axis in axes])
    across = np.stack([sign * half * axis[2] for sign, axis in axes])
    return quads(centres, along, across)


#: Columns and rows of panes of the window, their side, and half the width of the bars between them.
COLUMNS, ROWS, PANE, BAR = 3, 4, 0.5, 0.04


def window() -> None:
    """A frame about 3 x 4 panes in the plane z = 0, and the panes of three kinds; the lower left corner is the origin."""
    width, height = COLUMNS * PANE, ROWS * PANE
    upright = [box((k * PANE - BAR, -BAR, -BAR), (k * PANE + BAR, height + BAR, BAR)) for k in range(COLUMNS + 1)]
    across = [box((-BAR, k * PANE - BAR, -0.9 * BAR), (width + BAR, k * PANE + BAR, 0.9 * BAR)) for k in range(ROWS + 1)]
    write_mesh("window_frame.ply", *joined(upright + across))
    column, row = (numbers.ravel() for numbers in np.meshgrid(np.arange(COLUMNS), np.arange(ROWS)))
    middle = np.stack([(column + 0.5) * PANE, (row + 0.5) * PANE, 0 * row], 1)
    sides = [np.broadcast_to(np.eye(3)[axis] * PANE / 2, middle.shape) for axis in (0, 1)]
    for kind in range(3):
        chosen = (column + row) % 3 == kind
        write_mesh(f"window_panes_{kind + 1}.ply", *quads(middle[chosen], *(side[chosen] for side in sides)))


def curtain() -> None:
    """A sheet in folds about the plane z = 0, 2 wide and 2 high, standing on y = 0; its folds widen downwards."""
    u, v, faces = sheet(96, 24)
    width = 0.05 + 0.05 * (1 - v)
    phase = 2 * np.pi * 5 * u + 0.6 * np.sin(3 * v)
    vertices = np.stack([2 * u - 1, 2 * v, width * np.sin(phase)], 1)
    slope_x = width * np.cos(phase) * 2 * np.pi * 5 / 2
    slope_y = (-0.05 * np.sin(phase) + width * np.cos(phase) * 1.8 * np.cos(3 * v)) / 2
    write_mesh("curtain.ply", vertices, faces, normalised(np.stack([-slope_x, -slope_y, 1 + 0 * u], 1)), np.stack([u, v], 1))


def textures() -> None:
    """The textures of the scenes without translucent surfaces, and of the meadow."""
    height, normal = hammered()
    leaf_color, leaf_opacity = leaf()
    save("tiles.png", tiles())
    save("glaze.png", glaze())
    save("hammered_height.png", height, np.uint16)  # 8 bits would show as terraces
    save("hammered_normal.png", normal)
    save("leaf_color.png", leaf_color)
    save("leaf_opacity.png", leaf_opacity)
    save("slide.png", slide())


def tree() -> None:
    """The leaves, their opacity, and the trunk."""
    save("leaf_card.png", leaf_card())
    leaves()
    trunk()


ASSETS = (textures, vase, drape, tree, window, curtain)


def main(names: list[str]) -> None:
    (HERE / "textures").mkdir(exist_ok=True)
    for make in ASSETS:
        if not names or make.__name__ in names:
            make()


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    main(sys.argv[1:])
