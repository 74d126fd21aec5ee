"""Records of a model: meshes with materials, cameras and lights, in world space with Mitsuba's axes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
#: (H, W, C) bytes, row 0 on top.
Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Material:
    """A material of metal and roughness, as glTF has it.

    Attributes:
        name: of the material.
        colour: (3,) linear; factor of the texture, if there is one.
        picture: (H, W, 3) sRGB, or None.
        opacity: (H, W) bytes or a number; 1 for a whole surface.
        cutoff: opacity from which on a surface is whole, where it is either whole or not there; None where it is translucent.
        roughness, metallic: numbers or (H, W) bytes, 0 to 1.
        normals: (H, W, 3), a normal map whose green points upwards in the picture, or None.
        emission: (3,) linear radiance; factor of ``emission_picture``.
        emission_picture: (H, W, 3) sRGB, or None.
    """

    name: str
    colour: Array = field(default_factory=lambda: np.full(3, 0.5))
    picture: Picture | None = None
    opacity: Picture | float = 1.0
    cutoff: float | None = None
    roughness: Picture | float = 1.0
    metallic: Picture | float = 0.0
    normals: Picture | None = None
    emission: Array = field(default_factory=lambda: np.zeros(3))
    emission_picture: Picture | None = None


@dataclass(frozen=True)
class Part:
    """A mesh in world space.

    Attributes:
        name: of the node or object.
        vertices: (V, 3).
        faces: (F, 3) indices.
        normals: (V, 3) unit normals of the vertices, or None.
        texcoords: (V, 2), v downwards from the top of pictures, or None.
        colours: (V, 3) linear colours of the vertices, which replace the material's, or None.
        material: its material, or None.
        smooth: whether Mitsuba is to compute normals of the vertices where there are none; otherwise facets are flat.
    """

    name: str
    vertices: Array
    faces: npt.NDArray[np.int64]
    normals: Array | None = None
    texcoords: Array | None = None
    colours: Array | None = None
    material: Material | None = None
    smooth: bool = False


@dataclass(frozen=True)
class PlacedCamera:
    """A camera: ``to_world`` (4, 4) with Mitsuba's axes, the angle of view in degrees across its height, width over height.

    ``height`` (world units) instead of ``fov`` makes it orthographic.
    """

    name: str
    to_world: Array
    fov: float | None
    aspect: float
    height: float | None = None


@dataclass(frozen=True)
class PlacedLight:
    """A light: ``kind`` is directional, point or spot.

    ``colour`` (3,) is irradiance (directional) or intensity. ``place`` and ``direction`` (3,): world space. ``cone`` has the
    angles of a spot, inner and outer, in degrees.
    """

    name: str
    kind: str
    colour: Array
    place: Array
    direction: Array
    cone: tuple[float, float] = (0.0, 45.0)


@dataclass(frozen=True)
class Model:
    """All that a file has. ``notes`` are sentences about what is left out or was changed."""

    parts: tuple[Part, ...]
    cameras: tuple[PlacedCamera, ...] = ()
    lights: tuple[PlacedLight, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def bounds(self) -> tuple[Array, Array]:
        """(lowest, highest) corner (3,) of all meshes."""
        low = np.min([part.vertices.min(0) for part in self.parts], axis=0)
        return low, np.max([part.vertices.max(0) for part in self.parts], axis=0)
