"""One view of a scene under the sun, and motions of its parts whose derivatives are compared. Metres, z is up."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...jit.arrays import device_array
from ...jit.types import Float, TensorXf
from ...rendering.renderer import Renderer
from ...scene.lights.punctual import DirectionalLight
from ...scene.mitsuba_meshes import make_mesh, mesh_buffers

#: Irradiance of the sun on a surface that faces it.
IRRADIANCE = 3.0
#: Pixels along each side of images, if nothing else is said.
USUAL = 512


@dataclass(frozen=True)
class Motion:
    """A motion of one shape, or of the sun.

    Attributes:
        step: of central differences in images of 512 pixels: shadows of the two lie about one pixel apart. Metres, or radians
            for the sun.
        shape: name of the shape that moves, or "" for the sun, whose azimuth changes.
        rate: (V, 3), or (1, 3) for all vertices: metres that vertices move for one metre of the motion.
    """

    step: float
    shape: str = ""
    rate: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((1, 3)))


@dataclass(frozen=True)
class View:
    """A camera, the sun, and all shapes.

    Attributes:
        name: for the record.
        meshes: shapes by name.
        origin, target: of the camera, metres.
        azimuth, elevation: of the sun, degrees; the azimuth counts from +x towards +y.
        fov: across the image, degrees.
        near, far: clipping planes of the camera, metres.
        motions: by the words of the record.
        caster: the shape whose shadow may detach from it, with ``along``, the (column, row) in which its shadow leaves it in the
            image, in whole pixels of -1 to 1; "" for none.
        least_dark: the view is left out if a smaller share of the image is dark.
    """

    name: str
    meshes: Mapping[str, mi.Mesh]
    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    azimuth: float
    elevation: float = 40.0
    fov: float = 60.0
    near: float = 0.5
    far: float = 10000.0
    motions: Mapping[str, Motion] = field(default_factory=dict)
    caster: str = ""
    along: tuple[int, int] = (0, 0)
    least_dark: float = 0.0

    def direction(self, turn: float = 0.0) -> npt.NDArray[np.float64]:
        """Direction (3,) in which light travels, with the azimuth turned by radians."""
        a, e = np.radians(self.azimuth) + turn, np.radians(self.elevation)
        return -np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])

    def step(self, motion: str, resolution: int) -> float:
        """Step of a motion's central differences in images of resolution x resolution pixels."""
        return self.motions[motion].step * USUAL / resolution

    def scene(self, resolution: int, motion: str = "", amount: float = 0.0) -> mi.Scene:
        """The scene, with one of the motions carried out. Its camera has resolution x resolution pixels and a box filter."""
        meshes, turn = dict(self.meshes), 0.0
        if motion:
            moved = self.motions[motion]
            if moved.shape:
                meshes[moved.shape] = displaced(meshes[moved.shape], amount * moved.rate)
            else:
                turn = amount
        t = mi.ScalarTransform4f
        up = [0, 0, 1]
        film = {"type": "hdrfilm", "width": resolution, "height": resolution, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        camera = {"type": "perspective", "fov": self.fov, "near_clip": self.near, "far_clip": self.far, "film": film}
        camera["to_world"] = t().look_at(list(self.origin), list(self.target), up)
        sun = {"type": "directional", "direction": self.direction(turn).tolist(), "irradiance": IRRADIANCE}
        return mi.load_dict({"type": "scene", "camera": camera, "sun": sun, **meshes}, optimize=False)

    def derivative(self, renderer: Renderer, motion: str) -> npt.NDArray[np.float32]:
        """Forward derivative (H, W, 3) of a renderer's image by the amount of a motion."""
        moved = self.motions[motion]
        amount = dr.opaque(mi.Float, 0.0)  # a literal zero would be broadcast at its first product
        dr.enable_grad(amount)
        if moved.shape:
            at = cast(Float, dr.ravel(renderer.data.geometry.shape_positions(moved.shape)))
            rate = np.broadcast_to(moved.rate, (dr.width(at) // 3, 3)).astype(np.float32)
            image: TensorXf = renderer.render({moved.shape: at + device_array(mi.Float, rate) * amount})
        else:
            x, y, z = (mi.Float(float(c)) for c in self.direction())
            cos, sin = dr.cos(amount), dr.sin(amount)
            sun = replace(
                cast(DirectionalLight, renderer.light("sun")), direction=mi.Vector3f(cos * x - sin * y, sin * x + cos * y, z)
            )
            image = renderer.render(lights={"sun": sun})
        dr.forward(amount)
        return np.array(dr.grad(image))[..., :3]


def displaced(mesh: mi.Mesh, offset: npt.NDArray[np.float64]) -> mi.Mesh:
    """A copy of a mesh with offsets (V, 3) or (1, 3) added to its vertices, metres."""
    points = points_of(mesh) + offset
    return make_mesh(mesh.id(), points, np.array(mesh_buffers(mesh).faces).reshape(-1, 3), mesh.bsdf())


def points_of(mesh: mi.Mesh) -> npt.NDArray[np.float64]:
    """Vertices (V, 3) of a mesh, metres."""
    return np.array(mesh_buffers(mesh).positions, np.float64).reshape(-1, 3)


@dataclass(frozen=True)
class Seen:
    """Surfaces and casters of shadows in the middles of pixels, all (H, W).

    Attributes:
        shape: number of the shape, in the order of the view's meshes; -1 for none.
        p_world: (H, W, 3), metres; not numbers where there is no shape.
        caster: number of the shape that casts a shadow there; -1 for none, and on surfaces that do not face the sun.
        p_caster: (H, W, 3), where light is held up, metres; not numbers where nothing does.
        lit: pixels of surfaces that face the sun and have no caster.
    """

    shape: npt.NDArray[np.int64]
    p_world: npt.NDArray[np.float32]
    caster: npt.NDArray[np.int64]
    p_caster: npt.NDArray[np.float32]
    lit: npt.NDArray[np.bool_]


def seen_by(view: View, scene: mi.Scene, resolution: int) -> Seen:
    """Trace rays through the middles of pixels, and from there to the sun."""
    middle = (np.arange(resolution) + 0.5) / resolution
    v, u = np.meshgrid(middle, middle, indexing="ij")
    sample = mi.Point2f(mi.Float(u.ravel().astype(np.float32)), mi.Float(v.ravel().astype(np.float32)))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, sample, mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    towards = mi.Vector3f(*(-view.direction()).tolist())
    faces = dr.dot(hit.n, towards) * dr.dot(hit.n, ray.d) < 0
    above = scene.ray_intersect(hit.spawn_ray(towards), hit.is_valid() & faces)
    # Dr.Jit numbers all shapes.
    order = {name: index for index, name in enumerate(view.meshes)}
    pointers = {_number(mi.ShapePtr(shape))[0]: order[shape.id()] for shape in scene.shapes()}

    def numbers(found: mi.SurfaceInteraction3f) -> npt.NDArray[np.int64]:
        own, index = np.unique(_number(dr.select(found.is_valid(), found.shape, mi.ShapePtr(None))), return_inverse=True)
        return np.array([pointers.get(pointer, -1) for pointer in own])[index].reshape(resolution, resolution)

    def places(found: mi.SurfaceInteraction3f) -> npt.NDArray[np.float32]:
        at = np.array(mi.Point3f(dr.select(found.is_valid(), found.p, dr.nan)), np.float32)
        return at.T.reshape(resolution, resolution, 3)

    lit = np.array(hit.is_valid() & faces & ~above.is_valid()).reshape(resolution, resolution)
    return Seen(numbers(hit), places(hit), numbers(above), places(above), lit)


def _number(pointer: mi.ShapePtr) -> npt.NDArray[np.uint32]:
    return np.atleast_1d(np.array(dr.reinterpret_array(mi.UInt32, pointer)))
