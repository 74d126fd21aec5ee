"""A small, far area light in place of a directional light.

Mitsuba's projective integrators differentiate the shadow boundaries of area lights, but not of delta lights. The proxy is a
disk that faces the receiver, so far away and so small that its image equals that of the directional light up to half a pixel of
penumbra. The deviation is measured with Mitsuba.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.scene.mitsuba_meshes import positions_in

from .reference import path_traced

MAX_DOUBLINGS = 8


@dataclass(frozen=True)
class Proxy:
    """An area light in place of a directional light, and its measured deviations.

    Attributes:
        direction: Unit direction in which the light travels (world).
        irradiance: RGB irradiance E of the directional light on a plane facing it.
        centre: World position of the disk.
        distance: From the disk to the receiver's centre.
        diameter: Of the disk, world units.
        radiance: RGB, E distance^2 / area.
        pixel_size: Smallest width of a pixel in the visible shadow, perpendicular to its ray, world units.
        caster_height: Largest distance along the light from a caster's bounding sphere to the receiver.
        penumbra_px: Largest width of a penumbra in the visible shadow, in pixels: at each pixel, the distance to the farthest
            caster, found by ray tracing, times the light's angle, divided by the pixel's width.
        parallax_px: Largest displacement of a shadow against parallel light, in pixels.
        irradiance_residual: Largest relative deviation from the directional light over the receiver without casters,
            measured by rendering both.
        image_residual: Relative RMS difference of the images with casters, measured by rendering both: penumbrae,
            parallax and noise.
    """

    direction: tuple[float, float, float]
    irradiance: tuple[float, float, float]
    centre: tuple[float, float, float]
    distance: float
    diameter: float
    radiance: tuple[float, float, float]
    pixel_size: float
    caster_height: float
    penumbra_px: float
    parallax_px: float
    irradiance_residual: float = float("nan")
    image_residual: float = float("nan")

    def emitter(self) -> mi.Object:
        """The light as a Mitsuba shape."""
        centre, direction = np.array(self.centre), np.array(self.direction)
        up = [0.0, 1.0, 0.0] if abs(direction[1]) < 0.9 else [1.0, 0.0, 0.0]
        place = mi.ScalarTransform4f().look_at(centre.tolist(), (centre + direction).tolist(), up)
        return mi.load_dict(
            {
                "type": "disk",
                "to_world": place @ mi.ScalarTransform4f().scale(self.diameter / 2),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(self.radiance)}},
                "bsdf": {"type": "diffuse", "reflectance": 0.0},
            }
        )

    def record(self) -> dict[str, object]:
        """All attributes as JSON values."""
        return {key: list(value) if isinstance(value, tuple) else value for key, value in asdict(self).items()}


def calibrate(
    scene: mi.Scene,
    *,
    light: str = "light",
    receiver: str = "wall",
    casters: tuple[str, ...] = ("object",),
    max_penumbra_px: float = 0.5,
    max_parallax_px: float = 0.25,
    uniformity: float = 0.005,
) -> Proxy:
    """Find and measure the area light that replaces a directional light of a scene.

    The distance is large enough for a uniform irradiance over the whole receiver and up to the casters, and for shadows at the
    same place as under parallel light. The diameter is as large as the penumbra allows, since a larger light reduces the noise of
    Mitsuba's derivatives.

    Args:
        scene: Loaded with `optimize=False`; its first sensor determines the size of a pixel.
        light, receiver, casters: Ids of the directional light, of a planar shape and of meshes. Casters may turn about
            the centres of their bounding boxes: the proxy is made for their bounding spheres.
        max_penumbra_px: Upper bound of `penumbra_px` (protocol: 0.5).
        max_parallax_px: Upper bound of `parallax_px`.
        uniformity: Upper bound of `irradiance_residual` (protocol: 0.005); the distance is doubled until it holds.

    Returns:
        The proxy with its measured residuals. No gradients.

    Raises:
        ShadowmapError: An id is missing, the light is not directional, the receiver or the shadow on it is out of view, or the
            irradiance cannot be made uniform.
    """
    direction, irradiance = _directional(scene, light)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    for name in (receiver, *casters):
        if name not in shapes:
            raise ShadowmapError(f"the scene has no shape {name!r}: its shapes are {', '.join(shapes)}.")
    p_receiver = _corners(shapes[receiver].bbox())
    middle = p_receiver.mean(0)
    height_px, pixel_size = _shadow(scene, receiver, casters, direction)
    height, reach = 0.0, 0.0
    for name in casters:
        centre, radius = _bounding_sphere(shapes[name])
        height = max(height, float(np.max((p_receiver - centre) @ direction)) + radius)
        offset = centre - middle
        reach = max(reach, float(np.linalg.norm(offset - (offset @ direction) * direction)) + radius)

    extent = float(np.linalg.norm(p_receiver - middle, axis=1).max())
    distance = max(
        1.1 * extent * np.sqrt(2 / uniformity),  # on a plane facing the light the irradiance falls like cos^4
        2.2 * height / uniformity,  # casters are nearer to the light and must not get more of it
        reach * height / (max_parallax_px * pixel_size),
    )
    for _ in range(MAX_DOUBLINGS):
        diameter = max_penumbra_px / height_px * distance
        area = np.pi * diameter**2 / 4
        proxy = Proxy(
            direction=_triple(direction),
            irradiance=_triple(irradiance),
            centre=_triple(middle - distance * direction),
            distance=float(distance),
            diameter=float(diameter),
            radiance=_triple(irradiance * distance**2 / area),
            pixel_size=pixel_size,
            caster_height=height,
            penumbra_px=diameter / distance * height_px,
            parallax_px=reach * height / distance / pixel_size,
        )
        residual = _irradiance_residual(scene, proxy, light, receiver)
        if residual <= uniformity:
            return replace(proxy, irradiance_residual=residual, image_residual=_image_residual(scene, proxy, light))
        distance *= 2
    raise ShadowmapError(
        f"the light on {receiver!r} is uniform only to {residual:.2%}: it may not face {light!r}, or pixels ({pixel_size:.2g} "
        "wide) are so large that the light that may blur shadows by half of one is too large: choose a larger image."
    )


def with_proxy(scene: mi.Scene, proxy: Proxy, light: str = "light", *, only: tuple[str, ...] | None = None) -> mi.Scene:
    """The scene with its directional light replaced. Shapes and sensors are shared with the given scene.

    Args:
        only: Ids of the shapes to keep; default: all.
    """
    return _rebuilt(scene, light, proxy.emitter(), only)


def _rebuilt(scene: mi.Scene, light: str, substitute: mi.Object, only: tuple[str, ...] | None) -> mi.Scene:
    """The scene with a light replaced, and only the given shapes (None: all)."""
    description: dict[str, object] = {"type": "scene"}
    if scene.integrator() is not None:
        description["integrator"] = scene.integrator()
    for index, sensor in enumerate(scene.sensors()):
        description[sensor.id() or f"sensor_{index}"] = sensor
    for shape in scene.shapes():
        if only is None or shape.id() in only:
            description[shape.id()] = shape
    for emitter in scene.emitters():
        if emitter.id() != light and not mi.has_flag(emitter.flags(), mi.EmitterFlags.Surface):
            description[emitter.id()] = emitter
    description[f"{light}_proxy"] = substitute
    return mi.load_dict(description, optimize=False)


def _directional(scene: mi.Scene, light: str) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction and RGB irradiance of a directional light."""
    emitters = {emitter.id(): emitter for emitter in scene.emitters()}
    if light not in emitters:
        raise ShadowmapError(f"the scene has no emitter {light!r}: its emitters are {', '.join(emitters)}.")
    flags = emitters[light].flags()
    if not (mi.has_flag(flags, mi.EmitterFlags.DeltaDirection) and mi.has_flag(flags, mi.EmitterFlags.Infinite)):
        raise ShadowmapError(f"the emitter {light!r} is not directional: only such a light can have a proxy.")
    sample, weight = emitters[light].sample_direction(dr.zeros(mi.SurfaceInteraction3f), mi.Point2f(0.5), True)
    direction = -np.array(sample.d, dtype=np.float64).ravel()
    value = np.array(mi.unpolarized_spectrum(weight), dtype=np.float64).ravel()
    return direction / np.linalg.norm(direction), np.broadcast_to(value, 3)


def _shadow(scene: mi.Scene, receiver: str, casters: tuple[str, ...], direction: np.ndarray) -> tuple[float, float]:
    """Measures of the shadow on the receiver in the first sensor's image: the largest ratio of the farthest caster's distance
    along the light to the width of a pixel (perpendicular to its ray), and the smallest width of a pixel."""
    sensor = scene.sensors()[0]
    width, height = (int(size) for size in sensor.film().crop_size())
    index = dr.arange(mi.UInt32, width * height)
    position = (mi.Point2f(index % width, index // width) + 0.5) / mi.ScalarVector2f(width, height)
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    shapes = {shape.id(): shape for shape in scene.shapes()}
    # Compare pointers: in merged scenes several shapes have the same id.
    seen = si.is_valid() & (si.shape == mi.ShapePtr(shapes[receiver]))
    t = dr.select(seen, si.t, 0)
    size = mi.Float(dr.inf)
    for shift in (mi.Vector2f(1 / width, 0), mi.Vector2f(0, 1 / height)):
        neighbour, _ = sensor.sample_ray(0.0, 0.5, position + shift, mi.Point2f(0.5))
        size = dr.minimum(size, dr.norm(neighbour(t) - ray(t)))
    away = 2 * float(np.linalg.norm(np.array(scene.bbox().max) - np.array(scene.bbox().min)))
    towards = mi.Vector3f(*(float(value) for value in direction))
    blocker = scene.ray_intersect(mi.Ray3f(si.p - away * towards, towards), seen)
    shadowed = mi.Bool(False)
    for name in casters:
        shadowed |= seen & blocker.is_valid() & (blocker.shape == mi.ShapePtr(shapes[name]))
    seen_, shadowed_, size_, distance = (np.array(array) for array in (seen, shadowed, size, away - blocker.t))
    if not seen_.any():
        raise ShadowmapError(f"the camera does not see {receiver!r}: choose the shape that receives the shadow.")
    if not shadowed_.any():
        raise ShadowmapError(f"the camera sees no shadow of {', '.join(casters)} on {receiver!r}.")
    return float((distance / size_)[shadowed_].max()), float(size_[shadowed_].min())


def _bounding_sphere(shape: mi.Shape) -> tuple[np.ndarray, float]:
    """Bounding sphere about the centre of the bounding box: centre (3,) and radius."""
    box = _corners(shape.bbox())
    centre = box.mean(0)
    points = np.array(positions_in(mi.traverse(shape))).reshape(-1, 3) if isinstance(shape, mi.Mesh) else box
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def _irradiance_residual(scene: mi.Scene, proxy: Proxy, light: str, receiver: str) -> float:
    """Largest relative deviation of the irradiance over the whole receiver, both lights rendered alone."""
    box = _corners([shape for shape in scene.shapes() if shape.id() == receiver][0].bbox())
    extent = np.linalg.norm(box - box.mean(0), axis=1).max()
    eye = box.mean(0) - 4 * extent * np.array(proxy.direction)
    up = [0, 1, 0] if abs(proxy.direction[1]) < 0.9 else [1, 0, 0]
    sensor = mi.load_dict(
        {
            "type": "orthographic",
            "to_world": mi.ScalarTransform4f().look_at(eye.tolist(), box.mean(0).tolist(), up)
            @ mi.ScalarTransform4f().scale([float(extent), float(extent), 1.0]),
            "film": {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
            "sampler": {"type": "independent"},
        }
    )
    integrator = mi.load_dict({"type": "direct", "bsdf_samples": 0, "emitter_samples": 1})
    parallel = {
        "type": "directional",
        "direction": list(proxy.direction),
        "irradiance": {"type": "rgb", "value": list(proxy.irradiance)},
    }
    images = []
    for substitute in (proxy.emitter(), mi.load_dict(parallel)):
        alone = _rebuilt(scene, light, substitute, (receiver,))
        images.append(np.array(mi.render(alone, sensor=sensor, integrator=integrator, spp=256)))
    near, far = images
    # Pixels on the receiver's border are covered partly, and differently in each image.
    inside = far.sum(-1) > 0.98 * far.sum(-1).max()
    return float(np.abs(near[inside] / np.maximum(far[inside], 1e-12) - 1)[far[inside] > 0].max())


def _image_residual(scene: mi.Scene, proxy: Proxy, light: str) -> float:
    """Relative RMS difference of the images with either light."""
    width, height = scene.sensors()[0].film().crop_size()
    spp = int(np.clip(2**22 // (int(width) * int(height)), 16, 256))
    near, far = (path_traced(each, spp=spp).image for each in (with_proxy(scene, proxy, light), scene))
    return float(np.sqrt(np.mean((near - far) ** 2) / np.mean(far**2)))


def _corners(box: mi.ScalarBoundingBox3f) -> np.ndarray:
    """(8, 3) corners of a bounding box."""
    low, high = np.array(box.min), np.array(box.max)
    choice = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    return np.where(choice == 1, high, low).astype(np.float64)


def _triple(values: npt.ArrayLike) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in np.asarray(values))
    return x, y, z
