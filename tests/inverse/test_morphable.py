"""Morphable models: the file format and its checks, the head of the package, other people's models."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from face_models import egg

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.faces.problem import default_model
from shadowmap_dr.inverse.faces.convert import ConvertOptions, convert
from shadowmap_dr.inverse.faces.morphable import MorphableModel, load_model, save_model
from shadowmap_dr.io.assets import scenes_dir


def make_head() -> Any:
    """The script that builds the head of the package, as a module."""
    spec = importlib.util.spec_from_file_location("make_head", scenes_dir() / "make_head.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def arrays_of(model: MorphableModel) -> dict[str, Any]:
    return {name: np.array(value) for name, value in vars(model).items()}


def test_model_survives_a_file(tmp_path: Path) -> None:
    model = egg()
    save_model(tmp_path / "a.npz", model)
    again = load_model(tmp_path / "a.npz")
    for name, value in vars(model).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    save_model(tmp_path / "half.npz", model, half=True)
    np.testing.assert_allclose(load_model(tmp_path / "half.npz").identity, model.identity, rtol=5e-4, atol=1e-6)


def test_vertices_are_the_weighted_sum() -> None:
    model = egg()
    expected = model.mean + 2 * model.identity[1] - 0.5 * model.expression[2]
    np.testing.assert_allclose(model.vertices([0, 2], [0, 0, -0.5]), expected, atol=1e-6)
    with pytest.raises(ShadowmapError, match="9 identity weights for a model with 4"):
        model.vertices(np.zeros(9))


def broken(**changes: Any) -> dict[str, Any]:
    return arrays_of(egg(1)) | changes


NAN = egg(1).identity.copy()
NAN[1, 2, 0] = np.nan
FAR = egg(1).faces.copy()
FAR[3, 1] = 42

BROKEN = {
    "mean": (broken(mean=np.zeros((42, 2))), r"mean of shape \(42, 2\)"),
    "point": (broken(mean=np.zeros((42, 3))), "all vertices in one place"),
    "nan": (broken(identity=NAN), "identity has 1 numbers that are not finite"),
    "basis": (broken(identity=np.zeros((4, 41, 3))), r"identity basis of shape \(4, 41, 3\)"),
    "no basis": (broken(identity=np.zeros((0, 42, 3)), identity_names=np.array([], str)), "without identity components"),
    "expression": (broken(expression=np.zeros((42, 3))), r"expression basis of shape \(42, 3\)"),
    "faces": (broken(faces=FAR), "name vertices 0 to 42, but they go from 0 to 41"),
    "real faces": (broken(faces=np.zeros((4, 3))), "type float64: give integers"),
    "mask": (broken(mask=np.ones(41, bool)), r"mask of shape \(41,\)"),
    "empty mask": (broken(mask=np.zeros(42, bool)), "mask holds no triangle"),
    "names": (broken(identity_names=np.array(["a"])), "4 identity components, but 1 names"),
    "words": (broken(mean=np.full((42, 3), "x")), "instead of numbers"),
    "huge": (broken(identity=np.full((4, 42, 3), 1e300)), "beyond single precision"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_models_are_refused_in_one_line(name: str, tmp_path: Path) -> None:
    arrays, message = BROKEN[name]
    np.savez(tmp_path / "broken.npz", **arrays)
    with pytest.raises(ShadowmapError, match=message) as error:
        load_model(tmp_path / "broken.npz")
    assert "broken.npz" in str(error.value) and "\n" not in str(error.value)


def test_files_that_are_no_models(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="does not exist"):
        load_model(tmp_path / "none.npz")
    (tmp_path / "text.npz").write_text("no zip file")
    with pytest.raises(ShadowmapError, match="no .npz file, or it is damaged"):
        load_model(tmp_path / "text.npz")
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(ShadowmapError, match="no .npz file"):
        load_model(tmp_path / "single.npy")
    np.savez(tmp_path / "objects.npz", mean=np.array([{}], dtype=object))
    with pytest.raises(ShadowmapError, match="objects are not read"):
        load_model(tmp_path / "objects.npz")
    np.savez(tmp_path / "part.npz", mean=np.zeros((3, 3)))
    with pytest.raises(ShadowmapError, match="no array faces, identity"):
        load_model(tmp_path / "part.npz")


def test_head_of_the_package() -> None:
    model = default_model()
    assert len(model.identity) >= 80 and len(model.expression) == 51
    assert "jawOpen" in model.expression_names
    original = model.mean[: len(model.mean) - 48]  # without the continued neck
    np.testing.assert_allclose([original.min(), original.max()], [-1, 1], atol=1e-3)
    # Faces +x: the tip of the nose is the foremost point, in the middle.
    nose = model.mean[model.mean[:, 0].argmax()]
    assert abs(nose[2]) < 0.02 and 0.7 < nose[0] < 0.9
    assert 0.7 < model.mask.mean() < 1


def test_head_of_the_package_explains_new_heads() -> None:
    """Heads drawn with another seed: the components hold 98 % of their variance, and weights are standard normal."""
    script, model = make_head(), default_model()
    with np.load(scenes_dir() / "heads" / "makehuman.npz") as file:
        source = {name: file[name] for name in file.files}
    base, shapes, rng = source["v"].astype(np.float64), script.Shapes(source), np.random.default_rng(77)
    heads = np.stack([base + shapes.draw(rng) for _ in range(120)])
    heads -= heads[:, base[:, 1] > script.NECK].mean(1, keepdims=True)
    heads = script.turned(heads)
    mean = model.mean[: len(base)].astype(np.float64)
    centred = heads.mean(0) - heads.mean((0, 1))
    scale = np.sum(centred * (mean - mean.mean(0))) / np.sum(centred**2)
    offsets = (heads - heads.mean((0, 1))) * scale + mean.mean(0) - mean
    offsets = offsets.reshape(len(heads), -1)
    basis = model.identity[:, : len(base)].reshape(len(model.identity), -1).astype(np.float64)
    weights = np.linalg.lstsq(basis.T, offsets.T, rcond=None)[0]
    assert np.sum((offsets.T - basis.T @ weights) ** 2) < 0.02 * np.sum((offsets - offsets.mean(0)) ** 2)
    assert 0.85 < np.sqrt(np.mean(weights[:20] ** 2)) < 1.15
    assert np.abs(weights[:20].mean(1)).max() < 0.4


def write_obj(path: Path, vertices: np.ndarray, quads: bool = True) -> None:
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
    lines += ["f 1/1/1 2/2/2 3/3/3 4/4/4", "f 2 1 5", "f -4 -3 -1", "f 3 4 5", "f 4 1 5"] if quads else ["f 1 2 3"]
    path.write_text("# a pyramid\n" + "\n".join(lines) + "\n")


PYRAMID = np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2], [0, 5, 0]], float)


def test_folder_of_obj_files(tmp_path: Path) -> None:
    """As ICT-FaceKit: facing +z, quads, identities and expressions as whole meshes."""
    write_obj(tmp_path / "generic_neutral_mesh.obj", PYRAMID)
    write_obj(tmp_path / "identity000.obj", PYRAMID + [0, 0, 1])
    write_obj(tmp_path / "identity001.obj", PYRAMID + [1, 0, 0])
    write_obj(tmp_path / "jawOpen.obj", PYRAMID + [0, -2, 0])
    model = convert(tmp_path, ConvertOptions())
    assert model.identity_names == ("identity000", "identity001") and model.expression_names == ("jawOpen",)
    assert model.faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 0, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    scale = 2 / 5  # the largest extent becomes 2
    np.testing.assert_allclose(model.mean[4], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(model.mean[0], [-2 * scale, -1, 2 * scale], atol=1e-6)  # +z turns to +x, so +x to -z
    np.testing.assert_allclose(model.identity[0], np.tile([scale, 0, 0], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(model.identity[1], np.tile([0, 0, -scale], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(model.expression[0], np.tile([0, -0.5 * 2 * scale, 0], (5, 1)), atol=1e-6)
    assert convert(tmp_path, ConvertOptions(components=1)).identity_names == ("identity000",)


def test_bad_folders(tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="has no generic_neutral_mesh.obj"):
        convert(tmp_path, ConvertOptions())
    write_obj(tmp_path / "generic_neutral_mesh.obj", PYRAMID)
    with pytest.raises(ShadowmapError, match="no identity000.obj"):
        convert(tmp_path, ConvertOptions())
    write_obj(tmp_path / "identity000.obj", PYRAMID[:4], quads=False)
    with pytest.raises(ShadowmapError, match="identity000.obj has 4 vertices, the mean 5"):
        convert(tmp_path, ConvertOptions())
    for line in ("v 1 2 x", "f 1 2 99999999999", "v 1 2 3\nf"):
        (tmp_path / "identity000.obj").write_text(f"{line}\n")
        with pytest.raises(ShadowmapError, match=r"identity000.obj"):
            convert(tmp_path, ConvertOptions())


def test_basel_like_arrays(tmp_path: Path) -> None:
    """Flat arrays, unit vectors with variances, triangles (3, F) that count from 1."""
    model, rng = egg(), np.random.default_rng(0)
    flat = {kind: model.basis(kind).reshape(-1, model.mean.size).T.astype(np.float64) for kind in ("identity", "expression")}
    lengths = {kind: np.linalg.norm(basis, axis=0) for kind, basis in flat.items()}
    arrays = {
        "shape_mean": model.mean.ravel() * 80,
        "shape_basis": flat["identity"] / lengths["identity"],
        "shape_variance": (80 * lengths["identity"]) ** 2,
        "expression_mean": np.zeros(model.mean.size),
        "expression_basis": flat["expression"] * 80 / lengths["expression"],
        "expression_std": lengths["expression"],
        "triangles": (model.faces + 1).T,
    }
    np.savez(tmp_path / "basel.npz", **arrays)
    found = convert(tmp_path / "basel.npz", ConvertOptions(facing="+x", expression_scale=1.0))
    scale = 2 / np.ptp(model.mean, axis=0).max()
    np.testing.assert_array_equal(found.faces, model.faces)
    for w in rng.normal(size=(3, 4)):
        shape = (model.vertices(w) - model.vertices(-w)) * scale
        np.testing.assert_allclose(found.vertices(w) - found.vertices(-w), shape, atol=1e-5)
    np.testing.assert_allclose(found.expression, model.expression * scale, atol=1e-6)
    neck = convert(tmp_path / "basel.npz", ConvertOptions(facing="+x", neck=0.0))
    np.testing.assert_array_equal(neck.mask, model.mean[:, 1] > 0)
    with pytest.raises(ShadowmapError, match="no vertex lies above 500"):
        convert(tmp_path / "basel.npz", ConvertOptions(neck=500.0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shape_basis": np.zeros((12, 4))}, r"shape_basis of shape \(12, 4\) for 42 vertices"),
        ({"shape_std": np.ones(3)}, "4 components, but there are 3 deviations"),
        ({"shape_mean": np.ones(7)}, "shape_mean has 7 numbers"),
        ({"triangles": np.zeros((5, 4), int)}, r"triangles of shape \(5, 4\)"),
        ({"triangles": np.full((5, 3), 0.5)}, "no whole numbers"),
        ({"triangles": np.full((5, 3), np.nan)}, "no whole numbers"),
        ({"triangles": np.full((5, 3), 1e30)}, "no whole numbers up to"),
        ({"shape_mean": np.full(126, np.inf)}, "no finite extent"),
        ({"shape_variance": -np.ones(4)}, "deviations or variances of shape_basis are negative or not finite"),
        ({"shape_std": np.full(4, np.nan)}, "deviations or variances of shape_basis are negative or not finite"),
        ({"shape_mean": np.ones(42, complex)}, "shape_mean holds complex128"),
        ({"shape_std": np.array(["a"] * 4)}, "shape_std holds <U1"),
    ],
)
def test_bad_arrays(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    model = egg(1)
    arrays = {"shape_mean": model.mean.ravel(), "shape_basis": model.identity.reshape(4, -1).T, "triangles": model.faces}
    np.savez(tmp_path / "basel.npz", **(arrays | changes))
    with warnings.catch_warnings(), pytest.raises(ShadowmapError, match=message):
        warnings.simplefilter("error")
        convert(tmp_path / "basel.npz", ConvertOptions())
