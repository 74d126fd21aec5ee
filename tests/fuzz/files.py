"""Files of meshes, models, arrays and JSON, most of them damaged, given to their readers."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np

from shadowmap_dr.inverse.faces.convert import ConvertOptions, convert
from shadowmap_dr.inverse.faces.morphable import load_model, save_model
from shadowmap_dr.io import files as io_files
from shadowmap_dr.io import records
from shadowmap_dr.io.meshes import read_placed_mesh

from . import mesh_files
from .commands import run_command
from .outcome import check
from .values import chance, changed_arrays, mutated, npz, pick


def run(rng: np.random.Generator, folder: Path) -> str:
    """Give a file to its reader."""
    chosen = (*[_mesh] * 12, _headers, _headers, _basel, _basel, _faces, _model, _arrays, _json, _mesh_command)
    return pick(rng, chosen)(rng, folder)


def _mesh(rng: np.random.Generator, folder: Path) -> str:
    name = pick(rng, tuple(mesh_files.files()))
    suffix, data = mesh_files.files()[name]
    sound = chance(rng, 0.1)
    if chance(rng, 0.03):
        suffix = pick(rng, tuple(s for s, _ in mesh_files.files().values()))
        sound = False
    path = folder / f"mesh{suffix}"
    path.write_bytes(data if sound else mutated(rng, data))
    return _read(path, sound)


def _read(path: Path, sound: bool) -> str:
    vertices, faces, (middle, scale) = read_placed_mesh(path)
    check(
        vertices.dtype == np.float32 and vertices.ndim == 2 and vertices.shape[1] == 3,
        f"vertices {vertices.dtype} {vertices.shape}",
    )
    check(
        faces.dtype == np.uint32 and faces.ndim == 2 and faces.shape[1] == 3 and len(faces), f"faces {faces.dtype} {faces.shape}"
    )
    check(faces.max() < len(vertices), f"index {faces.max()} of {len(vertices)} vertices")
    check(np.isfinite(vertices).all() and np.isfinite([*middle, scale]).all(), "vertices are not finite")
    check(np.abs(vertices).max() <= 1 + 1e-5, f"coordinates up to {np.abs(vertices).max()}")
    if sound:
        check(mesh_files.is_cube(vertices, faces), "the mesh is not the cube of the file")
    return f"{path.suffix}: {len(vertices)} vertices, {len(faces)} triangles"


def _headers(rng: np.random.Generator, folder: Path) -> str:
    """PLY files with headers made of random lines."""
    types = (
        "float",
        "double",
        "uchar",
        "int",
        "uint",
        "short",
        "list",
        "list uchar int",
        "list int float",
        "list float int",
        "quad",
        "",
    )
    names = ("x", "y", "z", "vertex_indices", "vertex_index", "red", "", "nx")
    counts = ("8", "0", "-1", "3", "1000000000", "99999999999999999999", "x", "")
    form = pick(rng, ("ascii", "binary_little_endian", "binary_big_endian", "binary", ""))
    lines = ["ply", f"format {form} 1.0"]
    for element in ("vertex", "face", pick(rng, ("edge", "vertex", "face", ""))):
        lines.append(f"element {element} {pick(rng, counts[:4] if chance(rng, 0.7) else counts)}")
        lines += [f"property {pick(rng, types)} {pick(rng, names)}" for _ in range(int(rng.integers(5)))]
        if element == "vertex" and chance(rng, 0.7):
            lines += [f"property float {axis}" for axis in "xyz"]
        if element == "face" and chance(rng, 0.7):
            lines += ["property list uchar int vertex_indices"]
    body = (
        rng.bytes(int(rng.integers(400))) if form.startswith("binary") else " ".join(map(str, rng.integers(-1, 9, 100))).encode()
    )
    path = folder / "mesh.ply"
    path.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body)
    return _read(path, False)


def _mesh_command(rng: np.random.Generator, folder: Path) -> str:
    """A damaged mesh in a command, which refuses it before anything is rendered, or gets to its broken option."""
    name = pick(rng, tuple(mesh_files.files()))
    suffix, data = mesh_files.files()[name]
    path = folder / f"mesh{suffix}"
    path.write_bytes(mutated(rng, data))
    return run_command(
        ["art", "--target", "none.png", "--mesh", str(path), "--resolution", "16", "--iterations", "1", "--out", "out"]
    )


@functools.cache
def _basel_arrays() -> dict[str, np.ndarray]:
    """A head of eight vertices with two components, as the Basel Face Model has it."""
    rng = np.random.default_rng(0)
    mean = np.array(mesh_files.CORNERS, np.float32)
    return {
        "shape_mean": mean.ravel(),
        "shape_basis": rng.normal(size=(24, 2)).astype(np.float32),
        "shape_std": np.ones(2, np.float32),
        "triangles": np.array(mesh_files.TRIANGLES),
        "expression_basis": rng.normal(size=(24, 1)),
        "expression_variance": np.ones(1),
    }


def _basel(rng: np.random.Generator, folder: Path) -> str:
    path = folder / "model.npz"
    data = npz(changed_arrays(rng, _basel_arrays()) if chance(rng, 0.8) else _basel_arrays())
    path.write_bytes(mutated(rng, data) if chance(rng, 0.2) else data)
    model = convert(path, ConvertOptions())
    check(np.isfinite(model.mean).all() and model.faces.max() < len(model.mean), "a model with bad vertices or faces")
    save_model(folder / "again.npz", model)
    again = load_model(folder / "again.npz")
    check(
        np.array_equal(again.mean, model.mean) and np.array_equal(again.faces, model.faces), "another model was read than written"
    )
    return model.describe()


def _faces(rng: np.random.Generator, folder: Path) -> str:
    """A folder of OBJ files."""
    source = folder / "faces"
    source.mkdir()
    _, data = mesh_files.files()["obj of quads"]
    for name in ("generic_neutral_mesh", "identity000", "identity001", "smile"):
        if chance(rng, 0.95):
            (source / f"{name}.obj").write_bytes(mutated(rng, data) if chance(rng, 0.3) else data)
    return run_command(["face", "convert", str(source), "model.npz"])


@functools.cache
def _model_arrays() -> dict[str, np.ndarray]:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "basel.npz")
        path.write_bytes(npz(_basel_arrays()))
        save_model(Path(folder, "model.npz"), convert(path, ConvertOptions()))
        return io_files.read_arrays(Path(folder, "model.npz"))


def _model(rng: np.random.Generator, folder: Path) -> str:
    path = folder / "model.npz"
    data = npz(changed_arrays(rng, _model_arrays()))
    path.write_bytes(mutated(rng, data) if chance(rng, 0.2) else data)
    model = load_model(path)
    vertices = model.vertices(np.ones(len(model.identity)))
    check(np.isfinite(vertices).all() and model.faces.max() < len(vertices), "a model with bad vertices or faces")
    return model.describe()


def _arrays(rng: np.random.Generator, folder: Path) -> str:
    path = folder / "arrays.npz"
    path.write_bytes(mutated(rng, npz({"a": np.arange(12.0).reshape(3, 4), "b": np.array("text"), "c": np.ones(0)})))
    arrays = io_files.read_arrays(path)
    check(all(isinstance(array, np.ndarray) for array in arrays.values()), "something else than arrays")
    return ", ".join(arrays)


def _json(rng: np.random.Generator, folder: Path) -> str:
    path = folder / "record.json"
    content = json.dumps({"settings": {"a": 1, "b": [1, 2.5, None]}, "runs": {"x": {"loss": 1.0}}}).encode()
    path.write_bytes(pick(rng, (b"[" * 10**5, b'"\xff"', b"1" * 10**5, mutated(rng, content), mutated(rng, content))))
    return type(records.read_json(path)).__name__
