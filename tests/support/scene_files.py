"""Scene files, and comparisons of what Mitsuba reads from them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh
from PIL import Image

from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.scene_file import Written, write_fitted_scene
from shadowmap_dr.jit.threads import second_thread
from shadowmap_dr.scene.transforms import is_transform

SCENES = Path(__file__).resolve().parents[2] / "scenes"
FILM = '<film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film>'


def scene(folder: Path, body: str, name: str = "source.xml", version: str = "3.0.0") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<scene version="{version}">\n    <!-- kept -->\n    {body}\n</scene>\n', encoding="utf-8")
    return path


def write(file: Path, folder: Path, given: Mapping[str, str] | None = None, **changes: Any) -> Written:
    return write_fitted_scene(file, given or {}, Changes(**changes), folder / "out")


def numbers(value: Any) -> np.ndarray:
    found = np.array(value.matrix if is_transform(value) else value, np.float64)
    return found.reshape(found.shape[:2]) if is_transform(value) else found


def read(written: Written) -> mi.SceneParameters:
    with second_thread():
        return mi.traverse(mi.load_file(str(written.files[0]), optimize=False))


def turned(seed: int = 0) -> np.ndarray:
    """A rotation, a scale, and a translation."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * 1.3
    matrix[:3, :3] *= np.sign(np.linalg.det(matrix[:3, :3]))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


def perturbed(table: mi.SceneParameters, key: str) -> np.ndarray | None:
    """Another value of a parameter that a fit may change; None of others."""
    last = key.rpartition(".")[2]
    if table.flags(key) & (mi.ParamFlags.NonDifferentiable | mi.ParamFlags.ReadOnly) or last.startswith(("vertex_", "face_")):
        return None
    if last == "to_world":
        rotation = turned()
        rotation[:3, :3] /= 1.3
        return rotation @ numbers(table[key])
    value = numbers(table[key])
    return None if last == "to_uv" or value.dtype.kind != "f" else value * 0.9 + 0.01


def check_all(file: Path, folder: Path, given: Mapping[str, str] | None = None) -> Written:
    """Change every parameter that may be, and compare all with what Mitsuba reads from the written file."""
    table = mi.traverse(mi.load_file(str(file), optimize=False, **(given or {})))
    values = {key: value for key in table.keys() if (value := perturbed(table, key)) is not None}
    written = write_fitted_scene(file, given or {}, Changes(values=values), folder / "out", names=list(table.keys()))
    again = read(written)
    assert len(again) == len(table)
    for old, new in zip(table.keys(), again.keys(), strict=True):
        if any(old.replace("object", "") in note for note in written.notes):
            continue
        expected, found = values.get(old), again[new]
        if expected is None:
            if is_transform(table[old]) or np.array(table[old]).dtype.kind in "fiu":
                np.testing.assert_allclose(numbers(found), numbers(table[old]), rtol=1e-4, atol=1e-5, err_msg=old)
        elif old.endswith("to_world") and "<vector" in file.read_text(encoding="utf-8") and old.startswith(("sun", "sky")):
            forward = expected[:3, 2] / np.linalg.norm(expected[:3, 2])
            np.testing.assert_allclose(numbers(found)[:3, 2], forward, atol=1e-5, err_msg=old)
        elif old.endswith("sun_direction"):
            np.testing.assert_allclose(numbers(found).ravel(), expected.ravel() / np.linalg.norm(expected), atol=1e-5)
        else:
            found, expected = np.broadcast_arrays(numbers(found).ravel(), expected.ravel())
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4, err_msg=old)
    return written


def mesh_file(path: Path, **options: Any) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.vertices *= np.array([1, 2, 3])
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".obj":
        lines = [f"v {x} {y} {z}\nvt {x} {y}" for x, y, z in mesh.vertices]
        lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in mesh.faces]
        path.write_text("\n".join(lines))
    else:
        mesh.export(path, **options)
    return mesh


def picture(path: Path, mode: str = "RGB") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)).convert(mode).save(path)
    return path
