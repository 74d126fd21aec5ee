"""Cameras: a record with everything the rasterizer and the shading need, read from a Mitsuba sensor.

``Sensor.view_projection`` takes world space to OpenGL clip space (visible where -w <= x, y, z <= w) with row 0 of the image, the
topmost row of Mitsuba's film, at y = -w.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
import mitsuba as mi

from ..errors import ShadowmapError
from ..jit.arrays import backend
from ..jit.broadcast import broadcast_differentiable
from ..jit.kernel_inputs import float_input, split
from ..jit.types import Float, Matrix4f, Point2f, Point3f, Vector3f
from .mitsuba_objects import children, parameters
from .pixel_filter import Filter
from .transforms import axis, translation

_KINDS = {
    "PerspectiveCamera": "perspective",
    "ThinLensCamera": "perspective",
    "OrthographicCamera": "orthographic",
}


# Mitsuba replaces an aperture radius of zero by about this number.
_PINHOLE = 1e-6


@dataclass(frozen=True)
class ImageSize:
    """Size of an image in pixels or samples."""

    width: int
    height: int


@dataclass(frozen=True)
class Sensor:
    """A pinhole (``kind='perspective'``) or orthographic camera. Replace fields with ``dataclasses.replace``.

    to_world         Transform4f; the camera looks along +z, x points to the *left* (Mitsuba's convention), y up
    x_fov            Float, degrees, horizontal angle of the whole film (perspective only)
    principal_point  Point2f, Mitsuba's principal_point_offset_x/y, as a fraction of the film's width and height
    near, far        Float, clip distances along the viewing direction
    film_size, crop_size, crop_offset   pixels
    channels         colour channels of the film: 1 (luminance) or 3; ``alpha``: whether the film has one more, for coverage
    filter           the film's reconstruction filter
    sample_border    whether samples beyond the window contribute to its outermost pixels, as the film's parameter says
    film_column      leftmost column of this camera's picture in its film (batch sensors put several side by side)
    pixel_aspect     width of a pixel for a height of 1; other than 1 if a batch sensor has a crop window, into which Mitsuba
                     squeezes the whole pictures of its cameras

    Gradients flow from ``view_projection``, ``origin``, ``direction`` and ``wi_world`` to to_world, x_fov and principal_point.
    """

    RECORDED_OFTEN: ClassVar[bool] = True  # see `jit.frozen.take_apart`

    name: str
    kind: str
    to_world: mi.Transform4f
    x_fov: Float
    principal_point: Point2f
    near: Float
    far: Float
    film_size: ImageSize
    crop_size: ImageSize
    crop_offset: tuple[int, int]
    channels: int
    alpha: bool
    filter: Filter
    sample_border: bool = False
    film_column: int = 0
    pixel_aspect: float = 1.0

    @property
    def width(self) -> int:
        """Columns of the picture (the crop window)."""
        return self.crop_size.width

    @property
    def height(self) -> int:
        """Rows of the picture (the crop window)."""
        return self.crop_size.height

    @property
    def border(self) -> int:
        """Pixels on each side of the picture that are sampled for the filter's sake."""
        return self.filter.border if self.sample_border else 0

    @property
    def origin(self) -> Point3f:
        """Point3f, centre of projection (perspective) or a point on the optical axis (orthographic), world space."""
        return translation(self.to_world)

    @property
    def direction(self) -> Vector3f:
        """Vector3f, unit viewing direction, world space."""
        return dr.normalize(axis(self.to_world, 2))

    @property
    def view(self) -> Matrix4f:
        """Matrix4f, world to camera space."""
        return dr.rcp(mi.Matrix4f(self.to_world.matrix))

    @property
    def reach(self) -> Float:
        """Float, camera space: distance of the far plane from the near plane.

        Mitsuba's orthographic camera, if its transformation scales along the axis, takes ``near`` in its own units, but the
        length of its rays, ``far - near``, in world units.
        """
        between = mi.Float(self.far) - mi.Float(self.near)
        if self.kind == "perspective":
            return between
        matrix = dr.detach(mi.Matrix4f(self.to_world.matrix))
        return between / dr.norm(mi.Vector3f(matrix[0, 2], matrix[1, 2], matrix[2, 2]))

    @property
    def projection(self) -> Matrix4f:
        """Matrix4f, camera space to clip space, crop window and principal point included."""
        film_w, film_h = self.film_size.width, self.film_size.height
        crop_w, crop_h, (crop_x, crop_y) = self.width, self.height, self.crop_offset
        # Position in the crop window in [0, 1] = (position in the film - crop offset) * film size / crop size.
        zoom = (film_w / crop_w, film_h / crop_h)
        aspect = self.pixel_aspect * film_w / film_h
        if self.kind == "perspective":
            scale = dr.rcp(dr.tan(mi.Float(self.x_fov) * (0.5 * math.pi / 180.0)))
        else:
            scale = mi.Float(1.0)
        sx, sy = -scale * zoom[0], -scale * (zoom[1] * aspect)
        # Film position 0.5 + 0.5 * ndc - principal point, then the crop, then back to [-1, 1].
        cx = zoom[0] * (1.0 - 2.0 * self.principal_point.x - 2.0 * crop_x / film_w) - 1.0
        cy = zoom[1] * (1.0 - 2.0 * self.principal_point.y - 2.0 * crop_y / film_h) - 1.0
        near = mi.Float(self.near)
        far = mi.Float(self.far) if self.kind == "perspective" else near + self.reach
        inverse_depth = dr.rcp(self.reach)
        if self.kind == "perspective":
            return mi.Matrix4f(
                [sx, 0, cx, 0],
                [0, sy, cy, 0],
                [0, 0, (far + near) * inverse_depth, -2.0 * far * near * inverse_depth],
                [0, 0, 1, 0],
            )
        return mi.Matrix4f(
            [sx, 0, 0, cx],
            [0, sy, 0, cy],
            [0, 0, 2.0 * inverse_depth, -(far + near) * inverse_depth],
            [0, 0, 0, 1],
        )

    @property
    def view_projection(self) -> Matrix4f:
        """Matrix4f, world space to clip space: pos_clip = view_projection @ (p_world, 1)."""
        return self.projection @ self.view

    def wi_world(self, p_world: Point3f) -> Vector3f:
        """Unit vector from p_world (Point3f) to the camera, world space."""
        if self.kind == "perspective":
            return dr.normalize(self.origin - p_world)
        return -self.direction

    def ray_direction(self, width: int | None = None, height: int | None = None) -> Vector3f:
        """Vector3f (H * W,), unit world-space directions through the pixel centres, row-major. Attached.

        ``width`` and ``height`` ask for another grid over the same window (supersampling).
        """
        width, height = width or self.width, height or self.height
        ndc_x, ndc_y = _pixel_centres(width, height)
        if self.kind == "orthographic":
            return dr.select(mi.Bool(True), self.direction, dr.zeros(mi.Vector3f, width * height))
        projection = self.projection
        x = (ndc_x - projection[0, 2]) / projection[0, 0]
        y = (ndc_y - projection[1, 2]) / projection[1, 1]
        linear = mi.Matrix3f(self.to_world.matrix)
        return dr.normalize(mi.Vector3f(linear @ mi.Vector3f(x, y, 1.0)))

    def pixel_rays(self, width: int, height: int, images: int = 1) -> tuple[Point3f, Vector3f, Float]:
        """Rays through the pixel centres of a ``width`` x ``height`` picture, row-major, and the height of a pixel.

        ``images``: number N of equal pictures, one after the other.

        Returns:
            origin: Point3f (N * H * W,), or of width 1 if all rays share it (perspective). World space, attached.
            direction: Vector3f (N * H * W,), or of width 1 if all rays share it (orthographic). World space, attached. Of unit
                length (orthographic), or with a unit component along the viewing axis (perspective).
            pixel: Float (1,), height of a pixel, world units, at unit distance along a perspective camera's axis. Detached.
        """
        ndc_x, ndc_y = _pixel_centres(width, height, images)
        projection, linear = self.projection, mi.Matrix3f(self.to_world.matrix)
        column = 2 if self.kind == "perspective" else 3
        across, down = linear @ mi.Vector3f(dr.rcp(projection[0, 0]), 0, 0), linear @ mi.Vector3f(0, dr.rcp(projection[1, 1]), 0)
        centre = -(across * projection[0, column] + down * projection[1, column])
        if self.kind == "perspective":
            centre += mi.Vector3f(linear @ mi.Vector3f(0, 0, 1))
            fixed = mi.Vector3f(self.origin)
        else:
            centre += self.origin
            fixed = self.direction
        # Twelve numbers that all pixels share: evaluated once, and one kernel sums their derivatives over the pixels.
        parts = (fixed, mi.Vector3f(centre), mi.Vector3f(across), mi.Vector3f(down))
        pixel = dr.norm(dr.detach(parts[3])) * float_input(backend(parts[3]), "height", 2.0 / height)
        dr.eval(parts, pixel)
        fixed, centre, across, down = broadcast_differentiable(parts, width * height * images)
        varying = dr.fma(across, ndc_x, dr.fma(down, ndc_y, centre))
        if self.kind == "perspective":
            return mi.Point3f(fixed), varying, pixel
        return mi.Point3f(varying), fixed, pixel


def _pixel_centres(width: int, height: int, images: int = 1) -> tuple[Float, Float]:
    """Normalized device coordinates (-1 to 1) of all pixel centres, row-major, row 0 at -1. ``images``: as of ``pixel_rays``."""
    index = dr.arange(mi.UInt32, width * height * images)
    module = backend(index)
    line, column = split(index, "width", width, height * images)
    _, row = split(line, "height", height, images)
    x, y = (mi.Float(place) + 0.5 for place in (column, row))
    return x * float_input(module, "width", 2.0 / width) - 1.0, y * float_input(module, "height", 2.0 / height) - 1.0


def lenses_of(sensor: mi.Sensor) -> list[str]:
    """Sentences (without full stops) about a ``mi.Sensor``, or cameras in a batch sensor, whose aperture is ignored."""
    if dr.flag(dr.JitFlag.FreezingScope):
        return []  # the aperture cannot be read now
    found = []
    for camera in (sensor, *_cameras_of(sensor)):
        if camera.class_name() != "ThinLensCamera":
            continue
        aperture = float(dr.detach(mi.Float(parameters(camera)["aperture_radius"]))[0])
        if aperture > _PINHOLE:
            found.append(
                f"sensor '{camera.id()}' is a thin lens with an aperture_radius of {aperture:g} and treated as a pinhole, "
                "so that everything is in focus"
            )
    return found


def _cameras_of(batch: mi.Sensor) -> list[mi.Sensor]:
    return [child for _, child in children(batch) if isinstance(child, mi.Sensor)]


def check_film(sensor: mi.Sensor) -> None:
    """Raise ShadowmapError if the film of a ``mi.Sensor`` has pixels that cannot be rendered.

    Once for each sensor is enough: a film never changes its format.
    """
    film = sensor.film()
    if film.base_channels_count() not in (1, 2, 3, 4):
        raise ShadowmapError(
            f"The film of sensor '{sensor.id()}' has {film.base_channels_count()} channels: use pixel_format luminance or rgb."
        )
    if "pixel_format = xyz" in str(film):
        raise ShadowmapError(f"The film of sensor '{sensor.id()}' stores XYZ, which is not supported: use pixel_format rgb.")


def sensors_of(sensor: mi.Sensor, name: str = "") -> tuple[Sensor, ...]:
    """Records of a ``mi.Sensor`` (see :func:`check_film`): one, or one for each camera of a batch sensor, left to right.

    ``name``: of one that has no id.
    """
    kind = sensor.class_name()
    if kind == "BatchSensor":
        cameras, film = _cameras_of(sensor), sensor.film()
        columns = int(film.crop_size()[0])
        if columns % len(cameras):
            raise ShadowmapError(
                f"The crop window of batch sensor '{sensor.id()}' has {columns} columns for {len(cameras)} cameras: "
                "choose a multiple of them."
            )
        share = ImageSize(columns // len(cameras), int(film.crop_size()[1]))
        return tuple(_squeezed(_sensor_of(camera, film, i * share.width), share) for i, camera in enumerate(cameras))
    return (_sensor_of(sensor, sensor.film(), 0, name),)


def _squeezed(camera: Sensor, size: ImageSize) -> Sensor:
    """A camera whose whole picture is squeezed into ``size``, as Mitsuba squeezes those of a batch sensor with a crop window."""
    film = camera.film_size
    aspect = (film.width * size.height) / (film.height * size.width)
    return replace(camera, film_size=size, crop_size=size, crop_offset=(0, 0), pixel_aspect=aspect)


def _sensor_of(sensor: mi.Sensor, film: mi.Film, film_column: int, name: str = "") -> Sensor:
    kind = _KINDS.get(sensor.class_name())
    if kind is None:
        raise ShadowmapError(
            f"Sensor '{sensor.id()}' ({sensor.class_name()}) is not supported: use perspective, orthographic or batch."
        )
    values = parameters(sensor)
    window = sensor.film()  # for a camera of a batch sensor its own film, not the common one
    width, height = _pair(window.crop_size())
    if width < 1 or height < 1:
        raise ShadowmapError(f"The film of sensor '{sensor.id()}' has {width} x {height} pixels: it needs at least one.")
    alpha = film.base_channels_count() in (2, 4)
    zero = mi.Float(0.0)
    return Sensor(
        name=sensor.id() or name,
        kind=kind,
        to_world=values["to_world"],
        x_fov=values.get("x_fov", mi.Float(90.0)),
        principal_point=mi.Point2f(values.get("principal_point_offset_x", zero), values.get("principal_point_offset_y", zero)),
        near=mi.Float(values["near_clip"]),
        far=mi.Float(values["far_clip"]),
        film_size=ImageSize(*_pair(window.size())),
        crop_size=ImageSize(width, height),
        crop_offset=_pair(window.crop_offset()),
        channels=int(film.base_channels_count()) - alpha,
        alpha=alpha,
        filter=Filter.read(film, sensor.id()),
        sample_border=bool(film.sample_border()),
        film_column=film_column,
    )


def _pair(size: Iterable[int]) -> tuple[int, int]:
    x, y = size
    return int(x), int(y)
