"""Brightness of area lights of all shapes, near and far, against a dense sum over each lamp. Nothing casts shadows.

    python docs/examples/lamp_brightness.py [--samples 32] [--out lamp_brightness.json]

A ball and a floor below lamps whose longest side is 1, at 0.5 to 10 from their lowest point, and a ball inside lamps that shine
inwards. `bias`: sum of the image over that of the reference, minus 1. `error`: mean absolute difference of pixels over the
reference's mean. The reference sums 4,096 of Mitsuba's own samples of the emitter for each pixel, on a lattice. Fine
meshes, which a lattice meets unevenly (on the bunny it is up to 0.9 % off), it sums triangle by triangle.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import shadowmap_dr
from shadowmap_dr.io import assets

# isort: split
import drjit as dr  # after shadowmap_dr, which chooses the LLVM library
import mitsuba as mi

SIZE, LATTICE, BLOCK, MANY_TRIANGLES = 32, 4096, 512, 1000
DISTANCES = (0.5, 1.0, 2.0, 5.0, 10.0)
RECEIVERS = ("floor", "ball")
Parts = dict[str, Any]


def photograph(size: int = 256) -> Any:
    """A picture of strong contrast, 1:1000: what a window looks like, with a few small, bright spots."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:size, 0:size] / size
    image = np.full((size, size), 0.01)
    for _ in range(40):
        cx, cy, width = rng.uniform(0, 1), rng.uniform(0, 1), 10 ** rng.uniform(-2.3, -1)
        image += 10 ** rng.uniform(-1, 1) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / width**2)
    return mi.Bitmap(np.repeat(np.clip(image, 0.01, 10.0)[..., None], 3, 2).astype(np.float32))


def lamps() -> dict[str, Parts]:
    """Shapes around the origin, by name; those that shine to one side only do so downwards."""
    t = mi.ScalarTransform4f
    down = t().rotate([1, 0, 0], 180)
    picture = {"type": "area", "radiance": {"type": "bitmap", "bitmap": photograph(), "raw": True}}
    return {
        "rectangle": {"type": "rectangle", "to_world": down @ t().scale(0.5)},
        "slab": {"type": "rectangle", "to_world": down @ t().scale([0.5, 0.1, 1])},
        "disk": {"type": "disk", "to_world": down @ t().scale(0.5)},
        "sphere": {"type": "sphere", "radius": 0.5},
        "cylinder": {"type": "cylinder", "p0": [-0.5, 0, 0], "p1": [0.5, 0, 0], "radius": 0.15},
        "tube": {"type": "cylinder", "p0": [-0.5, 0, 0], "p1": [0.5, 0, 0], "radius": 0.02},
        "cube": {"type": "cube", "to_world": t().rotate([1, 0.5, 0.2], 30) @ t().scale(0.3)},
        "mesh": {"type": "ply", "filename": str(assets.mesh("bunny")), "face_normals": True, "to_world": t().scale(0.5)},
        "photograph": {"type": "rectangle", "to_world": down @ t().scale(0.5), "emitter": picture},
    }


def surrounding() -> dict[str, Parts]:
    """Lamps that shine inwards, with a ball inside."""
    t = mi.ScalarTransform4f
    flipped = {"flip_normals": True}
    return {
        "sphere around": {"type": "sphere", "radius": 0.5, **flipped},
        "cube around": {"type": "cube", "to_world": t().scale(0.5), **flipped},
        "cylinder around": {"type": "cylinder", "p0": [-0.5, 0, 0], "p1": [0.5, 0, 0], "radius": 0.4, **flipped},
        "mesh around": {"type": "ply", "filename": str(assets.mesh("bunny")), "face_normals": True, **flipped},
    }


def scene_of(lamp: Parts, receiver: str, z: float, size: float) -> Any:
    """A lamp and a receiver whose highest point is (0, 0, ``z``), which covers the image."""
    t = mi.ScalarTransform4f
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    if receiver == "ball":
        shape: Parts = {"type": "sphere", "radius": size, "center": [0, 0, z - size], "bsdf": bsdf}
        origin, target, half = [8 * size, 0, z - 0.2 * size], [0, 0, z - size], 1.1 * size
    else:
        shape = {"type": "rectangle", "to_world": t().translate([0, 0, z]) @ t().scale(3 * size), "bsdf": bsdf}
        origin, target, half = [0, 0.01, z + 0.1], [0, 0, z], size
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    place = t().look_at(origin, target, [0, 0.6, 0.8]) @ t().scale([half, half, 1])
    camera = {"type": "orthographic", "to_world": place, "near_clip": 1e-3, "far_clip": 100.0, "film": film}
    glow = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    parts = {"camera": camera, "receiver": shape, "lamp": {"emitter": glow, **lamp}}
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def reference(scene: Any) -> tuple[Any, Any]:
    """(radiance, counted) of the pixels' centres, (H, W): a sum over a lattice on the emitter. Outlines do not count."""
    lane = dr.arange(mi.UInt32, SIZE * SIZE)
    uv = mi.Point2f((mi.Float(lane % SIZE) + 0.5) / SIZE, (mi.Float(lane // SIZE) + 0.5) / SIZE)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, uv, mi.Point2f(0.5))
    emitter = scene.emitters()[0]
    # The lamp may stand in the way.
    while dr.any((hit := scene.ray_intersect(ray)).shape == emitter.get_shape()):
        ray = dr.select(hit.shape == emitter.get_shape(), hit.spawn_ray(ray.d), ray)
    valid = hit.is_valid()
    counted = np.array(valid).reshape(SIZE, SIZE)
    inner = counted.copy()
    for axis in (0, 1):
        for shift in (-1, 1):
            inner &= np.roll(counted, shift, axis)
    lamp = emitter.get_shape()
    if lamp.is_mesh() and lamp.face_count() >= MANY_TRIANGLES:
        return _sum_over_triangles(lamp, hit).reshape(SIZE, SIZE), inner
    total = dr.zeros(mi.Float, SIZE * SIZE)
    for block in range(LATTICE // BLOCK):
        lane = dr.arange(mi.UInt32, SIZE * SIZE * BLOCK)
        si = dr.gather(mi.SurfaceInteraction3f, hit, lane // BLOCK)
        k = mi.Float64(lane % BLOCK + block * BLOCK)
        # The plastic number's lattice: even in two dimensions.
        point = mi.Point2f(*(mi.Float(k * step - dr.floor(k * step)) for step in (0.7548776662466927, 0.5698402909980532)))
        sample, weight = emitter.sample_direction(si, point)
        value = si.bsdf().eval(mi.BSDFContext(), si, si.to_local(sample.d)) * weight
        value = dr.select(sample.pdf > 0, value[0], 0)
        total += dr.block_sum(value, BLOCK)
        dr.eval(total)
    return np.array(total).reshape(SIZE, SIZE) / LATTICE, inner


def _sum_over_triangles(lamp: Any, hit: Any) -> np.ndarray:
    """Radiance (P,) at points of a diffuse surface of reflectance 0.5 under a mesh of radiance 1, in double precision.

    The middles of the quarters of each triangle stand for it.
    """
    parameters = mi.traverse(lamp)
    corners = np.array(parameters["vertex_positions"], np.float64).reshape(-1, 3)[np.array(parameters["faces"]).reshape(-1, 3)]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    middles = np.concatenate([(x + y + z) / 3 for x, y, z in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    # Half the product of edges is a triangle's area; a quarter of that is a piece's.
    vectors = np.tile(np.cross(b - a, c - a) / 8, (4, 1))
    if lamp.has_flipped_normals():
        vectors = -vectors
    points, normals = (np.array(values, np.float64).T for values in (hit.p, hit.n))
    found = np.zeros(len(points))
    for block in np.array_split(np.arange(len(points)), 64):
        to = middles[None] - points[block, None]
        squared = (to**2).sum(-1)
        received = np.maximum((to * normals[block, None]).sum(-1), 0)
        sent = np.maximum(-(to * vectors[None]).sum(-1), 0)
        found[block] = (received * sent / squared**2).sum(-1)
    return found * (0.5 / np.pi)


def compare(scene: Any, **options: Any) -> dict[str, float]:
    """Bias and error of ours."""
    renderer = shadowmap_dr.Renderer.from_scene(scene, shadow_method="none", hide_emitters=True, **options)
    right, counted = reference(scene)
    ours = np.array(renderer.render())[..., 0]
    difference = (ours - right)[counted]
    mean = right[counted].mean()
    return {"bias": float(difference.mean() / mean), "error": float(np.abs(difference).mean() / mean)}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=32, help="area_light_samples")
    parser.add_argument("--lamp", action="append", help="only these")
    parser.add_argument("--out", type=Path, help="JSON file")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    found: dict[str, dict[str, dict[str, float]]] = {}
    wanted = lambda names: [name for name in names if not options.lamp or name in options.lamp]  # noqa: E731
    for name in wanted(lamps()):
        lamp = lamps()[name]
        low = float(mi.load_dict({key: part for key, part in lamp.items() if key != "emitter"}).bbox().min.z)
        found[name] = {
            f"{receiver}, {distance:g}": compare(
                scene_of(lamp, receiver, low - distance, 0.5), area_light_samples=options.samples
            )
            for receiver in RECEIVERS
            for distance in DISTANCES
        }
        show(name, found[name])
    for name in wanted(surrounding()):
        found[name] = {
            f"ball of {size:g}": compare(scene_of(surrounding()[name], "ball", size, size), area_light_samples=options.samples)
            for size in (0.02, 0.1, 0.2)
        }
        show(name, found[name])
    if options.out:
        options.out.write_text(json.dumps({"samples": options.samples, "lamps": found}, indent=1) + "\n")


def show(name: str, rows: dict[str, dict[str, float]]) -> None:
    """Print one lamp's numbers."""
    numbers = "  ".join(f"{key}: {100 * v['bias']:+.2f}/{100 * v['error']:.2f} %" for key, v in rows.items())
    print(f"{name:16}", numbers, flush=True)


if __name__ == "__main__":
    main()
