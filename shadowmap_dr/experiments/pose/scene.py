"""Inputs of pose estimation: the object, the scene around it, the reference image, the start poses."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io import assets, images, meshes
from ...scene.mitsuba_meshes import set_positions
from ..common.objects import load_mesh, occluder, positions

ReferenceKind = Literal["mitsuba", "own"]
NormalKind = Literal["face", "vertex"]

REFERENCE_SPP = 512
MAX_OFFSET = 0.25
MAX_ROTATION_DEG = 30.0
# In the shadow-only case the object is shifted along the light, behind the camera, which leaves its shadow in place.
SHADOW_ONLY_SHIFT = 10.0
MAX_RESOLUTION = 4096

_REFERENCE_KEY = "shadowmap_dr:reference"


@dataclass(frozen=True)
class PoseProblem:
    """One object at one resolution.

    Attributes:
        name: the object's name in records.
        mesh: PLY file of the object in its target pose (rotation and offset zero).
        p_rest: (V, 3) float32 vertex positions, in [-1, 1]^3.
        resolution: width and height of the image in pixels.
        shadow_only: the camera sees the object's shadow, but not the object.
        normals: flat shading with face normals, or smooth shading with vertex normals.
        scene: Mitsuba scene with the object in its target pose, as `scenes/pose.xml` describes it.
    """

    name: str
    mesh: Path
    p_rest: npt.NDArray[np.float32]
    resolution: int
    shadow_only: bool
    normals: NormalKind
    scene: mi.Scene

    @property
    def shift_z(self) -> float:
        """Offset of the object towards the light (in z), in scene units."""
        return SHADOW_ONLY_SHIFT if self.shadow_only else 0.0

    @property
    def digest(self) -> str:
        """Short hash of the object's vertices, which tells objects with the same name apart."""
        return hashlib.sha256(self.p_rest.tobytes()).hexdigest()[:12]

    @property
    def folder(self) -> str:
        """Name of the folder for this problem's results."""
        return folder_name(self.name, self.resolution, self.shadow_only, self.normals)


def folder_name(name: str, resolution: int, shadow_only: bool, normals: NormalKind) -> str:
    """Name of the folder for the results of a problem."""
    smooth = "-vertex-normals" if normals == "vertex" else ""
    return f"{name}-{resolution}" + ("-shadow-only" if shadow_only else "") + smooth


def make_problem(
    name: str,
    resolution: int,
    *,
    shadow_only: bool = False,
    normals: NormalKind = "face",
    work: Path,
    scaled: Path | None = None,
) -> PoseProblem:
    """Load an object and build the scene around it.

    Args:
        name: name of a mesh of this package, or a mesh file, which is centred and scaled into [-1, 1]^3.
        resolution: 1 to 4096 pixels.
        shadow_only, normals: see PoseProblem.
        work: folder for the scaled copy of a mesh file.
        scaled: an existing scaled copy; `name` is then only its name in records.
    """
    if not 1 <= resolution <= MAX_RESOLUTION:
        raise ShadowmapError(f"a resolution of {resolution} pixels: give 1 to {MAX_RESOLUTION}.")
    if scaled is not None:
        label, mesh = name, scaled
    else:
        label, mesh = (name, assets.mesh(name)) if name in assets.mesh_names() else _import_mesh(assets.mesh(name), work)
    plain = load_mesh(mesh)
    p_rest = positions(plain)
    problem = PoseProblem(label, mesh, p_rest, resolution, shadow_only, normals, None)
    if shadow_only:
        # A shifted mesh file: Mitsuba's directional light reads the extent of the scene only when the scene is loaded.
        mesh = work / f"{label}-shadow-only.ply"
        _write_mesh(plain, p_rest + np.array([0, 0, problem.shift_z], np.float32), mesh)
    flat = "true" if normals == "face" else "false"
    try:
        scene = mi.load_file(
            str(assets.scene("pose")), object=str(mesh), resolution=str(resolution), face_normals=flat, optimize=False
        )
    except RuntimeError as error:
        raise ShadowmapError(f"cannot load the object {name}: {' '.join(str(error).split())}") from error
    return replace(problem, scene=scene)


def start_pose(seed: int, run: int) -> npt.NDArray[np.float64]:
    """Start of a run, (3,): rotation in radians within +-30 degrees, x and y within +-0.25."""
    generator = np.random.default_rng(seed + run)
    x, y = generator.uniform(-MAX_OFFSET, MAX_OFFSET, 2)
    rotation = math.radians(generator.uniform(-MAX_ROTATION_DEG, MAX_ROTATION_DEG))
    return np.array([rotation, x, y])


def pose_errors(parameters: npt.ArrayLike) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Errors of poses (..., 3) against the target zero: |rotation| in degrees, 100 x length of the offset."""
    poses = np.asarray(parameters, np.float64)
    return np.abs(np.degrees(poses[..., 0])), 100 * np.hypot(poses[..., 1], poses[..., 2])


def path_traced_reference(problem: PoseProblem, path: Path) -> npt.NDArray[np.float32]:
    """The path-traced image of the target pose under the true directional light, (H, W, 3), stored in the file `path`."""
    from mitsuba_baselines.reference import path_traced

    settings = {
        "object": problem.digest,
        "resolution": problem.resolution,
        "shadow_only": problem.shadow_only,
        "normals": problem.normals,
        "spp": REFERENCE_SPP,
        "mitsuba": mi.__version__,
    }
    if path.exists():
        try:
            _, metadata = images.read_exr(path)
            image = images.read_image(path)
            colours = 1 if "mono" in mi.variant() else 3
            if json.loads(metadata.get(_REFERENCE_KEY, "{}")) == settings and image.shape[2] == colours:
                return image
        except (ShadowmapError, json.JSONDecodeError):
            pass  # an unreadable file is made again
    image = np.asarray(path_traced(problem.scene, spp=REFERENCE_SPP).image, np.float32)
    images.write_image(path, image, {_REFERENCE_KEY: json.dumps(settings)})
    return image


def _import_mesh(path: Path, work: Path) -> tuple[str, Path]:
    """Name and scaled PLY copy, in [-1, 1]^3, of a user's mesh file."""
    vertices, faces = meshes.read_mesh(path)
    target = work / f"{path.stem}.ply"
    meshes.write_ply(target, occluder(path.stem, vertices, faces))
    return path.stem, target


def _write_mesh(mesh: mi.Mesh, positions: npt.NDArray[Any], path: Path) -> None:
    parameters = mi.traverse(mesh)
    set_positions(parameters, mi.Float(positions.astype(np.float32).ravel()))
    parameters.update()
    meshes.write_ply(path, mesh)
