"""Turns a ball into something that casts the shadow of a cow, with an optimiser of PyTorch.

The camera of the optimisation sees the shadow on the wall and never the ball. Adam moves variables u with vertices
x = (I + 20 L)^-1 u (L: graph Laplacian), so that each gradient moves the surface smoothly
(Nicolet et al., "Large Steps in Inverse Rendering of Geometry", 2021).

    python docs/examples/torch_mesh.py [--steps N] [--out DIR]

writes DIR/before.png, DIR/after.png (the mesh and its shadow) and DIR/shadows.png (shadow before, after, wanted).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import track

import shadowmap_dr.torch as sdr
from shadowmap_dr.io import assets
from shadowmap_dr.io.images import write_png

# isort: split
import mitsuba as mi  # after shadowmap_dr, which chooses the LLVM library


def ball(subdivisions: int, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Vertices (V, 3) and faces (F, 3) of an octahedron whose faces are divided into four again and again."""
    vertices = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], np.float32)
    faces = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(subdivisions):
        edges = np.sort(np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
        edges, which = np.unique(edges, axis=0, return_inverse=True)
        (a, b, c), (ab, bc, ca) = faces.T, len(vertices) + which.reshape(3, -1)
        faces = np.concatenate([np.stack(corners, 1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        vertices = np.concatenate([vertices, vertices[edges].mean(1)])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return torch.tensor(radius * vertices), torch.tensor(faces)


def smoothing(faces: torch.Tensor, count: int, strength: float) -> torch.Tensor:
    """The matrix I + strength * L (V, V)."""
    neighbours = torch.zeros(count, count)
    for k in range(3):
        neighbours[faces[:, k], faces[:, (k + 1) % 3]] = neighbours[faces[:, (k + 1) % 3], faces[:, k]] = 1
    return torch.eye(count) + strength * (torch.diag(neighbours.sum(1)) - neighbours)


def scene_of(mesh: Any, size: int) -> Any:
    """A mesh in front of a wall, under a light that throws its shadow there."""

    def film(side: int) -> dict[str, Any]:
        return {"type": "hdrfilm", "width": side, "height": side, "pixel_format": "rgb", "rfilter": {"type": "box"}}

    def look(origin: list[float], target: list[float]) -> Any:
        return mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])

    wall = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.75, 0.72, 0.68]}}
    facing = look([0, 0, -1.5], [0, 0, -2]) @ mi.ScalarTransform4f().scale(1.25)
    view = {"type": "perspective", "fov": 40, "to_world": look([-3.6, 1.6, 2.6], [0.1, 0, -1]), "film": film(384)}
    return mi.load_dict(
        {
            "type": "scene",
            "shadow": {"type": "orthographic", "near_clip": 0.01, "to_world": facing, "film": film(size)},
            "view": view,
            "light": {"type": "directional", "direction": [0, 0, -1], "irradiance": {"type": "rgb", "value": 3.0}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.15}},
            "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(12), "bsdf": wall},
            "mesh": mesh,
        },
        optimize=False,
    )


def camera(scene: Any, name: str) -> int:
    """Number of a camera in a scene: Mitsuba loads them in any order."""
    return [sensor.id() for sensor in scene.sensors()].index(name)


def mesh_of(vertices: torch.Tensor, faces: torch.Tensor) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.45, 0.25]}})
    mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=True, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = vertices.numpy().ravel(), faces.numpy().astype(np.uint32).ravel()
    params.update()
    return mesh


def wanted_shadow(size: int) -> torch.Tensor:
    """The wall with the shadow of a cow, which turns its side to the light."""
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 60)
    spot = {"type": "ply", "filename": str(assets.mesh("spot")), "to_world": turned}
    scene = scene_of(spot, size)
    return sdr.Renderer.from_scene(scene).render(sensor=camera(scene, "shadow"))


def optimise(steps: int, size: int, out: Path, subdivisions: int = 4) -> list[float]:
    """Returns the loss before each step."""
    mi.set_variant("llvm_ad_rgb")
    target = wanted_shadow(size)
    start, faces = ball(subdivisions, 0.6)
    scene = scene_of(mesh_of(start, faces), size)
    shadow_camera, view_camera = camera(scene, "shadow"), camera(scene, "view")
    renderer = sdr.Renderer.from_scene(scene, frozen=True)
    matrix = smoothing(faces, len(start), 20.0)
    inverse = torch.linalg.inv(matrix)
    # The shadow knows nothing of what lies along the light: only x and y move.
    u = torch.nn.Parameter(matrix @ start[:, :2])

    def vertices() -> torch.Tensor:
        return torch.cat([inverse @ u, start[:, 2:]], 1)

    optimiser = torch.optim.Adam([u], lr=0.05)
    losses = []
    for _ in track(range(steps), "moving vertices"):
        optimiser.zero_grad()
        shadow = renderer.render({"mesh": vertices()}, sensor=shadow_camera)
        loss = (shadow - target).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    out.mkdir(parents=True, exist_ok=True)
    with torch.no_grad():
        shadows = []
        for name, mesh in (("before", start), ("after", vertices())):
            write_png(out / f"{name}.png", renderer.render({"mesh": mesh}, sensor=view_camera, spp=4).numpy())
            shadows.append(renderer.render({"mesh": mesh}, sensor=shadow_camera))
    write_png(out / "shadows.png", torch.cat([*shadows, target], 1).numpy())
    return losses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=300, help="steps of the optimiser")
    parser.add_argument("--size", type=int, default=192, help="pixels along each side of the shadow's image")
    parser.add_argument("--out", type=Path, default=Path("out/torch_mesh"), help="folder of the pictures")
    options = parser.parse_args()
    losses = optimise(options.steps, options.size, options.out)
    print(f"loss {losses[0]:.5f} -> {losses[-1]:.5f}; pictures in {options.out}")


if __name__ == "__main__":
    main()
