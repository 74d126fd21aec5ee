"""A record of a photographed picture's camera, in the conventions of OpenCV, and its forms in Mitsuba.

The record knows what calibrations know: two focal lengths, any principal point, distortion. Mitsuba's sensors have square pixels
and no distortion; :meth:`Camera.undistorted` is the camera of the picture that :func:`~shadowmap_dr.cameras.undistort` makes for
them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .distortion import Array, distorted

if TYPE_CHECKING:
    from ..scene.sensor import Sensor

# OpenCV's camera looks along +z and has x to the right and y down; Mitsuba's has x to the left and y up.
_FLIP = np.diag([-1.0, -1.0, 1.0])
# Numbers of coefficients that OpenCV understands. Those of a tilted chip (14) are not supported.
_COUNTS = {False: (0, 4, 5, 8, 12), True: (0, 4)}
# Pixels of this relative difference between their width and height count as square.
_SQUARE = 1e-6


@dataclass(frozen=True)
class Camera:
    """A perspective camera. Change it with ``dataclasses.replace``. Holds numbers only; no gradients flow.

    Attributes:
        width, height: of the picture, pixels.
        fx, fy: focal lengths, in pixels along x and y.
        cx, cy: principal point, pixels from the left and the upper *edge* of the picture: pixel centres lie at + 0.5. OpenCV's
            numbers are 0.5 less, see :attr:`K`.
        rotation: (3, 3), world to camera; the camera looks along +z, x points to the right, y down.
        translation: (3,), world to camera: ``x_camera = rotation @ x_world + translation``. World units.
        distortion: OpenCV's coefficients (k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]]), or those of a fisheye
            (k1, k2, k3, k4). Empty without distortion.
        fisheye: whether the lens is one of OpenCV's module ``fisheye`` (equidistant).
        name: of the picture.

    Raises:
        ShadowmapError: A number that no camera has, named with what to do.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: Array = field(default_factory=lambda: np.eye(3))
    translation: Array = field(default_factory=lambda: np.zeros(3))
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    name: str = "camera"

    def __post_init__(self) -> None:
        who = f"Camera {self.name!r}"
        for side in ("width", "height"):
            value = getattr(self, side)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= 65536:
                raise ShadowmapError(f"{who} has a {side} of {value!r}: give whole pixels from 1 to 65,536.")
        for focal in ("fx", "fy"):
            if not _number(getattr(self, focal), who, focal) > 0:
                raise ShadowmapError(f"{who} has {focal} = {getattr(self, focal):g}: give a positive number of pixels.")
        for centre in ("cx", "cy"):
            _number(getattr(self, centre), who, centre)
        rotation, translation = (
            _array(self.rotation, (3, 3), f"{who}: rotation"),
            _array(self.translation, (3,), f"{who}: translation"),
        )
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
            raise ShadowmapError(f"{who}: rotation is no rotation, as its rows are not perpendicular and of length 1.")
        if np.linalg.det(rotation) < 0:
            raise ShadowmapError(f"{who}: rotation mirrors (its determinant is -1): flip the axis that points the other way.")
        distortion = tuple(_number(value, who, "distortion") for value in np.ravel(np.asarray(self.distortion, object)))
        if not self.fisheye and len(distortion) == 14 and distortion[12:] == (0.0, 0.0):
            distortion = distortion[:12]
        if len(distortion) not in _COUNTS[self.fisheye]:
            counts = ", ".join(str(count) for count in _COUNTS[self.fisheye])
            raise ShadowmapError(f"{who} has {len(distortion)} coefficients of distortion: give one of {counts} of them.")
        values = {"rotation": rotation, "translation": translation, "distortion": distortion if any(distortion) else ()}
        for key, value in values.items():
            object.__setattr__(self, key, value)

    # ------------------------------------------------------------------------------------------------------------ OpenCV

    @property
    def K(self) -> Array:
        """OpenCV's matrix (3, 3) of intrinsics: pixel centres are whole numbers."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1]])

    @property
    def to_world(self) -> Array:
        """Camera to world, (4, 4), with Mitsuba's axes: x to the left, y up, +z forward."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation.T @ _FLIP, self.origin
        return matrix

    @property
    def origin(self) -> Array:
        """Centre of projection, (3,), world space."""
        return -self.rotation.T @ self.translation

    @property
    def is_square(self) -> bool:
        """True if Mitsuba has such a camera: square pixels, no distortion."""
        return abs(self.fx / self.fy - 1) <= _SQUARE and not self.distortion and not self.fisheye

    def project(self, points: npt.ArrayLike) -> Array:
        """Positions (N, 2) of points (N, 3, world space) in the picture, in pixels from its upper left corner.

        Pixel centres lie at + 0.5. Points behind the camera give NaN. A camera with distortion needs OpenCV.
        """
        world = _array(points, (None, 3), "points")
        seen = world @ self.rotation.T + self.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = seen[:, :2] / seen[:, 2:]
        if self.distortion or self.fisheye:
            positions = distorted(flat, self.K, self.distortion, self.fisheye) + 0.5
        else:
            positions = flat * [self.fx, self.fy] + [self.cx, self.cy]
        positions[seen[:, 2] <= 0] = np.nan
        return positions

    # ----------------------------------------------------------------------------------------------------------- pictures

    def resized(self, width: int) -> Camera:
        """The camera of the same picture, resized to ``width`` pixels; its height is rounded to whole pixels."""
        if isinstance(width, bool) or not isinstance(width, (int, np.integer)) or width < 1:
            raise ShadowmapError(
                f"A picture of camera {self.name!r} cannot be resized to a width of {width!r}: give whole pixels."
            )
        height = max(1, round(self.height * width / self.width))
        x, y = width / self.width, height / self.height
        return replace(self, width=int(width), height=height, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y)

    def undistorted(self) -> Camera:
        """The camera with square pixels and no distortion whose picture :func:`~shadowmap_dr.cameras.undistort` makes.

        It has the same place, width and fx. Its height follows fx / fy, so that it sees what the lens sees near the middle.
        """
        if self.is_square:
            return self
        height = max(1, round(self.height * self.fx / self.fy))
        cy = self.cy * self.fx / self.fy
        return replace(self, height=height, fy=self.fx, cy=cy, distortion=(), fisheye=False)

    # ------------------------------------------------------------------------------------------------------------- Mitsuba

    # Any: parameters of a film, of Mitsuba's types
    def sensor(self, near: float = 1e-2, far: float = 1e4, **film: Any) -> dict[str, Any]:
        """A sensor for ``mi.load_dict``, with a box filter.

        Args:
            near, far: clip distances, world units.
            film: further parameters of the film, or others in place of these.

        Raises:
            ShadowmapError: Pixels that are not square, or distortion: take ``undistorted()`` and the picture of
                :func:`~shadowmap_dr.cameras.undistort`. No variant is set.
        """
        import mitsuba as mi

        self._check_square()
        if mi.variant() is None:
            raise ShadowmapError("No variant of Mitsuba is set: call mi.set_variant('llvm_ad_rgb') first.")
        return {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(0.5 * self.width / self.fx)),
            "fov_axis": "x",
            "principal_point_offset_x": 0.5 - self.cx / self.width,
            "principal_point_offset_y": 0.5 - self.cy / self.height,
            "near_clip": near,
            "far_clip": far,
            "to_world": mi.ScalarTransform4f(self.to_world),
            "film": {"type": "hdrfilm", "width": self.width, "height": self.height, "rfilter": {"type": "box"}} | film,
        }

    def xml(self, id: str = "camera", near: float = 1e-2, far: float = 1e4) -> str:
        """The same sensor as text, an element ``<sensor>`` for a scene file of Mitsuba.

        Args:
            id: name of the sensor in the scene.
            near, far: clip distances, world units.

        Raises:
            ShadowmapError: as :meth:`sensor`, but for the variant.
        """
        self._check_square()
        sensor = Element("sensor", type="perspective", id=id)
        SubElement(sensor, "string", name="fov_axis", value="x")
        numbers = {
            "fov": math.degrees(2 * math.atan(0.5 * self.width / self.fx)),
            "principal_point_offset_x": 0.5 - self.cx / self.width,
            "principal_point_offset_y": 0.5 - self.cy / self.height,
            "near_clip": near,
            "far_clip": far,
        }
        for name, number in numbers.items():
            SubElement(sensor, "float", name=name, value=f"{number:.9g}")
        matrix = " ".join(f"{number:.9g}" for number in self.to_world.ravel().tolist())
        SubElement(SubElement(sensor, "transform", name="to_world"), "matrix", value=matrix)
        film = SubElement(sensor, "film", type="hdrfilm")
        for name, size in (("width", self.width), ("height", self.height)):
            SubElement(film, "integer", name=name, value=str(size))
        SubElement(film, "rfilter", type="box")
        indent(sensor, "    ")
        return tostring(sensor, encoding="unicode")

    def record(self, near: float = 1e-2, far: float = 1e4) -> Sensor:
        """A camera for ``Renderer.render(sensor=...)``, with a box filter. Keeps fx and fy: pixels need not be square.

        Gradients flow to the record's ``to_world``, ``x_fov`` and ``principal_point``.

        Raises:
            ShadowmapError: Distortion: take ``undistorted()`` and the picture of :func:`~shadowmap_dr.cameras.undistort`.
        """
        import mitsuba as mi

        from ..scene.pixel_filter import Filter
        from ..scene.sensor import ImageSize, Sensor

        if self.distortion or self.fisheye:
            self._check_square()
        size = ImageSize(self.width, self.height)
        return Sensor(
            name=self.name,
            kind="perspective",
            to_world=mi.Transform4f(self.to_world),
            x_fov=mi.Float(math.degrees(2 * math.atan(0.5 * self.width / self.fx))),
            principal_point=mi.Point2f(0.5 - self.cx / self.width, 0.5 - self.cy / self.height),
            near=mi.Float(near),
            far=mi.Float(far),
            film_size=size,
            crop_size=size,
            crop_offset=(0, 0),
            channels=3,
            alpha=False,
            filter=Filter("BoxFilter", 0.5, 0),
            pixel_aspect=self.fy / self.fx,
        )

    def _check_square(self) -> None:
        if self.is_square:
            return
        lens = "is distorted" if self.distortion or self.fisheye else f"has fx = {self.fx:g} and fy = {self.fy:g}"
        raise ShadowmapError(
            f"Camera {self.name!r} {lens}, which no sensor of Mitsuba's is: take camera.undistorted(), "
            "and for the picture cameras.undistort(picture, camera)."
        )


def from_opencv(
    K: npt.ArrayLike,
    R: npt.ArrayLike,
    t: npt.ArrayLike,
    width: int,
    height: int,
    distortion: npt.ArrayLike = (),
    fisheye: bool = False,
    name: str = "camera",
) -> Camera:
    """A camera from OpenCV's numbers.

    Args:
        K: (3, 3), intrinsics, pixels; pixel centres are whole numbers. No skew.
        R: (3, 3) rotation from world to camera, or the rotation vector (3,) that ``cv2.solvePnP`` returns. Radians.
        t: (3,) translation from world to camera, world units.
        width, height: of the picture, pixels.
        distortion: coefficients in OpenCV's order.
        fisheye: whether they are those of ``cv2.fisheye``.
        name: of the picture.
    """
    matrix = _array(K, (3, 3), "K")
    lower = np.abs([matrix[1, 0], matrix[2, 0], matrix[2, 1], matrix[2, 2] - 1]).max()
    if lower > 1e-6 or abs(matrix[0, 1]) > 1e-6 * abs(matrix[0, 0]):
        raise ShadowmapError("K has skew, or is no matrix of intrinsics: give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].")
    turn = np.asarray(R, np.float64)
    rotation = rotation_from_vector(np.ravel(turn)) if turn.size == 3 else _array(R, (3, 3), "R")
    return Camera(
        width=width,
        height=height,
        fx=float(matrix[0, 0]),
        fy=float(matrix[1, 1]),
        cx=float(matrix[0, 2]) + 0.5,
        cy=float(matrix[1, 2]) + 0.5,
        rotation=rotation,
        translation=_array(np.ravel(np.asarray(t, np.float64)), (3,), "t"),
        distortion=tuple(np.ravel(np.asarray(distortion, np.float64)).tolist()),
        fisheye=fisheye,
        name=name,
    )


def look_at(
    origin: Sequence[float],
    target: Sequence[float],
    up: Sequence[float] = (0, 1, 0),
    *,
    fov: float,
    width: int,
    height: int,
    name: str = "camera",
) -> Camera:
    """A camera at ``origin`` that looks at ``target``, with ``up`` upwards in its picture.

    Args:
        origin, target, up: (3,), world space.
        fov: degrees, horizontal angle of the picture.
        width, height: of the picture, pixels.
        name: of the picture.
    """
    place = _array(origin, (3,), "origin")
    forward = _array(target, (3,), "target") - place
    right = np.cross(forward, _array(up, (3,), "up"))
    if not np.linalg.norm(forward) or np.linalg.norm(right) <= 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise ShadowmapError("origin and target of a camera coincide, or up is parallel to its view: move one of them.")
    if not 0 < _number(fov, "A camera", "fov") < 180:
        raise ShadowmapError(f"fov is {fov:g}: give degrees between 0 and 180.")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    focal = 0.5 * width / math.tan(math.radians(0.5 * fov))
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, rotation, -rotation @ place, name=name)


def from_sensor(sensor: Any) -> Camera:  # Any: a sensor of any variant, or a record
    """The camera of a perspective ``mi.Sensor`` or of a record ``Sensor``; crop windows become pictures of their own.

    Raises:
        ShadowmapError: Another kind of sensor; a transformation that scales or mirrors.
    """
    from ..scene.sensor import Sensor, check_film, sensors_of

    if isinstance(sensor, Sensor):
        records: tuple[Sensor, ...] = (sensor,)
    else:
        records = sensors_of(sensor)
        check_film(sensor)
    record = records[0]
    if len(records) > 1 or record.kind != "perspective":
        raise ShadowmapError(f"Sensor {record.name!r} is no single perspective camera: K, R and t describe only those.")
    import drjit as dr

    film, (left, top) = record.film_size, record.crop_offset
    fov, *offset = (float(np.array(dr.detach(value)).ravel()[0]) for value in (record.x_fov, *record.principal_point))
    matrix = np.array(dr.detach(record.to_world.matrix), np.float64).reshape(4, 4)
    focal = 0.5 * film.width / math.tan(math.radians(0.5 * fov))
    rotation = (matrix[:3, :3] @ _FLIP).T
    return Camera(
        width=record.width,
        height=record.height,
        fx=focal,
        fy=focal * record.pixel_aspect,
        cx=(0.5 - offset[0]) * film.width - left,
        cy=(0.5 - offset[1]) * film.height - top,
        rotation=rotation,
        translation=-rotation @ matrix[:3, 3],
        name=record.name or "camera",
    )


def rotation_from_vector(vector: npt.ArrayLike) -> Array:
    """The rotation (3, 3) about a vector (3,) by its length in radians (Rodrigues' formula; ``cv2.Rodrigues``)."""
    from trimesh.transformations import rotation_matrix

    axis = _array(vector, (3,), "A rotation vector")
    angle = float(np.linalg.norm(axis))
    return np.eye(3) if angle == 0 else np.array(rotation_matrix(angle, axis)[:3, :3])


def rotation_from_quaternion(quaternion: npt.ArrayLike) -> Array:
    """The rotation (3, 3) of a quaternion (w, x, y, z) of any length but 0."""
    from trimesh.transformations import quaternion_matrix

    values = _array(quaternion, (4,), "A quaternion")
    if not values.any():
        raise ShadowmapError("A quaternion is zero, which is no rotation.")
    return np.array(quaternion_matrix(values / np.linalg.norm(values))[:3, :3])


def _number(value: Any, who: str, what: str) -> float:  # Any: a number of any library, or none
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ShadowmapError(f"{who}: {what} is {value!r}: give a number.") from None
    if not math.isfinite(number):
        raise ShadowmapError(f"{who}: {what} is {value!r}: give a finite number.")
    return number


def _array(values: npt.ArrayLike, shape: tuple[int | None, ...], what: str) -> Array:
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise ShadowmapError(f"{what} is no array of numbers.") from None
    if array.ndim != len(shape) or any(need not in (None, have) for need, have in zip(shape, array.shape, strict=False)):
        wanted = " x ".join("N" if side is None else str(side) for side in shape)
        raise ShadowmapError(f"{what} has the shape {array.shape}: give {wanted} numbers.")
    if not np.isfinite(array).all():
        raise ShadowmapError(f"{what} has a number that is not finite.")
    return array
