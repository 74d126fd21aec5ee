"""Scenes of the tests of the plug-in."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from shadowmap_dr import Renderer

SIZE = 64
# Shadows a little softer than a pixel: images of this size would alias a sharper map, and so would their differences.
SOFT = {"shadow_map_resolution": 64, "shadow_filter_size": 5}


def ball(subdivisions: int = 2) -> Any:
    """A smooth ``mi.Mesh`` of a sphere, radius 0.5 about (0, 0, 0.9)."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    mesh = mi.Mesh("ball", len(sphere.vertices), len(sphere.faces), has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = (np.asarray(sphere.vertices) + [0, 0, 0.9]).astype(np.float32).ravel()
    params["faces"] = np.asarray(sphere.faces).astype(np.uint32).ravel()
    params.update()
    # Mitsuba sums face normals in any order: those of two equal balls may differ in the last bit, and so would their pictures.
    params["vertex_normals"] = np.asarray(sphere.vertices / 0.5).astype(np.float32).ravel()
    params.update()
    return mesh


def camera(size: int = SIZE, fov: float = 45, **film: Any) -> dict[str, Any]:
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb", **film}
    to_world = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    # The sampler's count must not matter: a plug-in that heeded it would take 64 samples.
    sampler = {"type": "independent", "sample_count": 64}
    return {"type": "perspective", "fov": fov, "to_world": to_world, "film": film, "sampler": sampler}


def floor(**changes: Any) -> dict[str, Any]:
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), **changes}


def sun(**changes: Any) -> dict[str, Any]:
    return {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": {"type": "rgb", "value": 2.0}, **changes}


def small_scene(**changes: Any) -> Any:
    """A ball over a floor in the sun, seen by one camera."""
    parts = {"type": "scene", "ball": ball(), "floor": floor(), "camera": camera(), "sun": sun(), **changes}
    return mi.load_dict({k: v for k, v in parts.items() if v is not None}, optimize=False)


def full_scene() -> Any:
    """The small scene with a textured floor and all kinds of lights."""
    texture = mi.Bitmap(np.random.default_rng(0).uniform(0.2, 0.8, (4, 4, 3)).astype(np.float32))
    bsdf = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texture, "raw": True}}
    look_at = mi.ScalarTransform4f().look_at([-1.5, -1, 3], [0, 0, 0.2], [0, 0, 1])
    return small_scene(
        floor=floor(bsdf=bsdf),
        sun=sun(irradiance={"type": "rgb", "value": 1.0}),
        lamp={"type": "point", "position": [1.5, 0, 2.5], "intensity": {"type": "rgb", "value": 4.0}},
        spot={"type": "spot", "cutoff_angle": 35.0, "to_world": look_at, "intensity": {"type": "rgb", "value": [8.0, 7.0, 6.0]}},
    )


def shadowmap(**options: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", **options})


def render(scene: Any, integrator: Any = None, **arguments: Any) -> np.ndarray:
    return mi.render(scene, integrator=integrator or shadowmap(), **arguments).numpy()


def relative_error(image: np.ndarray, reference: np.ndarray) -> float:
    return float(np.abs(image - reference).mean() / reference.mean())


def weights(shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(3).uniform(-1, 1, shape).astype(np.float32)


def translated(base: Any, t: Any) -> Any:
    return base + t * mi.Float(np.tile(np.float32([1.0, 0.5, 0.2]), dr.width(base) // 3))


def scaled(base: Any, t: Any) -> Any:
    return mi.TensorXf(base.array * (1 + t), base.shape) if dr.is_tensor_v(base) else base * (1 + t)


def image_and_derivative(
    scene: Any, name: str, direction: tuple[float, float, float], start: float = 0.0, **options: Any
) -> tuple[np.ndarray, np.ndarray]:
    """An image with one shape moved by ``start`` along ``direction``, and its derivative with respect to moving it on."""
    renderer = Renderer.from_scene(scene, **options)
    x = mi.Float(start)
    dr.enable_grad(x)
    moved = renderer.data.geometry.shape_positions(name) + mi.Vector3f(*direction) * x
    image = renderer.render(vertex_positions={name: moved})
    dr.forward(x)
    return np.array(image), np.array(dr.grad(image))


def recordings(integrator: Any) -> int:
    return sum(record.recorded.recordings for record in integrator.shell.scenes)


def weighted_step(scene: Any, integrator: Any, key: str, value: Any, **arguments: Any) -> tuple[np.ndarray, np.ndarray]:
    """Image with a new value of a parameter, and the gradients of a weighted sum of it."""
    params = mi.traverse(scene)
    value = type(value)(value)
    dr.enable_grad(value)
    params[key] = value
    params.update()
    image = mi.render(scene, params, integrator=integrator, **arguments)
    weight = np.random.default_rng(1).uniform(0, 1, image.shape).astype(np.float32)
    dr.backward(dr.sum(image * mi.TensorXf(weight), axis=None))
    return image.numpy(), np.concatenate([np.ravel(dr.grad(part).numpy()) for part in _arrays(value)])


def _arrays(value: Any) -> list[Any]:
    return [value.matrix] if isinstance(value, mi.Transform4f) else [value]
