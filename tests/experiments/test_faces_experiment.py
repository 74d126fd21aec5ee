"""Heads from profile shadows: the fit, distances, silhouettes, what a shadow tells, and the commands."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from face_models import egg
from PIL import Image

from shadowmap_dr.cli import main
from shadowmap_dr.errors import ShadowmapError, install_hint
from shadowmap_dr.experiments.faces.experiment import FaceOptions, run_faces
from shadowmap_dr.experiments.faces.information import contrasts, image_derivatives, posterior_covariance
from shadowmap_dr.experiments.faces.metrics import distances, surface_distance
from shadowmap_dr.experiments.faces.problem import FaceScene, artificial_weights, default_model
from shadowmap_dr.experiments.faces.silhouette import Placement, place, read_silhouette, resample
from shadowmap_dr.inverse import MorphFit, optimize
from shadowmap_dr.inverse.faces.morphable import save_model
from shadowmap_dr.io.images import write_image

TRUE = np.array([0.9, -1.1, 0.8, 1.2])


def egg_fit(lights: int = 1, **options: Any) -> tuple[FaceScene, MorphFit]:
    scene = FaceScene.build(egg(), lights, height=64, map_resolution=96)
    return scene, scene.fit("identity", scene.shadow(scene.model.vertices(TRUE)), **options)


def test_weights_are_found_from_shadows(variant: str) -> None:
    """One profile shows depth, height and nose, but no width; the prior leaves that at zero. Three shadows show all four."""
    _, fit = egg_fit(prior=1e-6)
    one = optimize(fit, np.zeros(4), 150).final
    np.testing.assert_allclose(one[[0, 1, 3]], TRUE[[0, 1, 3]], atol=0.1)
    assert abs(one[2]) < 0.3
    assert fit.recordings() <= 2
    _, fit = egg_fit(3, prior=1e-6)
    np.testing.assert_allclose(optimize(fit, np.zeros(4), 150).final, TRUE, atol=0.15)


def test_place_is_found_with_the_weights(variant: str) -> None:
    scene, _ = egg_fit()
    moved = scene.model.vertices(TRUE) + np.float32([0.06, -0.04, 0])
    fit = scene.fit("identity", scene.shadow(moved), prior=1e-6, translate=True)
    final = optimize(fit, np.zeros(6), 200).final
    np.testing.assert_allclose(fit.vertices(final)[:, 0].max(), moved[:, 0].max(), atol=0.01)
    np.testing.assert_allclose(final[4:], [0.06, -0.04], atol=0.02)


def test_gradient_against_central_differences(variant: str) -> None:
    scene, fit = egg_fit(3, translate=True, prior=1e-3)
    at = np.array([0.2, -0.3, 0.1, 0.4, 0.03, 0.02])
    target = np.array(fit.reference)

    def loss(parameters: np.ndarray) -> float:
        image = fit.render(parameters)[..., 0].astype(np.float64)
        return float(np.mean((image - target) ** 2) + 1e-3 * np.mean(parameters[:4] ** 2))

    step = np.diag([0.1] * 4 + [0.01] * 2)
    numeric = [(loss(at + h) - loss(at - h)) / (2 * h.sum()) for h in step]
    np.testing.assert_allclose(fit.gradient(at), numeric, rtol=0.05, atol=2e-5)


def test_a_killed_fit_goes_on_where_it_was(variant: str, tmp_path: Path) -> None:
    _, fit = egg_fit(translate=True, prior=1e-4)
    whole = optimize(fit, np.zeros(6), 30)
    optimize(fit, np.zeros(6), 20, checkpoint=tmp_path / "c.npz")
    _, other = egg_fit(translate=True, prior=1e-4)
    resumed = optimize(other, np.zeros(6), 30, checkpoint=tmp_path / "c.npz")
    np.testing.assert_allclose(resumed.parameters, whole.parameters, atol=1e-3)


def test_bad_fits(variant: str) -> None:
    scene, fit = egg_fit()
    for change, message in (
        ({"prior": -1.0}, "a prior of -1.0"),
        ({"reference": np.zeros((3, 3))}, r"a reference of shape \(3, 3\)"),
        ({"basis": np.zeros((2, 5, 3))}, r"a basis of shape \(2, 5, 3\)"),
    ):
        good: dict[str, Any] = {"rest": scene.model.mean, "basis": scene.model.identity, "reference": fit.reference}
        with pytest.raises(ShadowmapError, match=message):
            MorphFit(scene.shadows, **(good | change))
    with pytest.raises(ShadowmapError, match="2 parameters: give 4"):
        fit.render([0.0, 0.0])
    with pytest.raises(ShadowmapError, match="2 shadows: choose 1 or 3"):
        FaceScene.build(egg(), 2)


def test_distances_are_exact() -> None:
    """Against all triangles one by one."""
    head, other = egg(2), egg(2).vertices([1.5, -1, 2, 1], [1, 0, 0])
    triangles = head.mean[head.faces].astype(float)
    points = np.random.default_rng(0).normal(size=(40, 3))
    for queries in (points, other[::7].astype(np.float64)):
        closest = [trimesh.triangles.closest_point(triangles, np.tile(p, (len(triangles), 1))) for p in queries]
        expected = [np.linalg.norm(c - p, axis=1).min() for c, p in zip(closest, queries, strict=True)]
        np.testing.assert_allclose(distances(queries, head.mean, head.faces), expected, atol=1e-6)


def test_mean_and_hausdorff_distance() -> None:
    """A sphere with another radius, and one with a single vertex drawn out: the largest distance is one-sided."""
    sphere = trimesh.creation.icosphere(4)
    v, f, mask = np.array(sphere.vertices), sphere.faces, np.ones(len(sphere.vertices), bool)
    grown = surface_distance(v, 1.1 * v, f, mask, samples=2000)
    assert abs(grown.mean - 0.1) < 1e-3 and abs(grown.hausdorff - 0.1) < 1e-3
    spike = v.copy()
    spike[0] *= 1.5
    drawn = surface_distance(v, spike, f, mask, samples=2000)
    assert abs(drawn.hausdorff - 0.5) < 1e-3 and drawn.mean < 0.01
    # Not where the mask says that there is no head.
    mask[np.linalg.norm(v - v[0], axis=1) < 0.3] = False
    assert surface_distance(v, spike, f, mask, samples=2000).hausdorff < 1e-6


def test_derivative_images_and_what_they_leave(variant: str) -> None:
    scene, fit = egg_fit()
    derivatives = image_derivatives(fit, np.zeros(4))
    for k, h in enumerate(0.2 * np.eye(4)):
        numeric = (fit.render(h) - fit.render(-h)).ravel() / 0.4
        if k == 2:  # the width
            assert np.abs(derivatives[:, k]).max() < 0.05 * np.abs(derivatives[:, 0]).max()
        else:
            cosine = numeric @ derivatives[:, k] / np.linalg.norm(numeric) / np.linalg.norm(derivatives[:, k])
            assert cosine > 0.97 and abs(derivatives[:, k] @ numeric / (numeric @ numeric) - 1) < 0.06
    left = np.sqrt(np.diag(posterior_covariance(derivatives, 1e-5)))
    assert left[2] > 0.9 and left[[0, 1, 3]].max() < 0.2
    with pytest.raises(ShadowmapError, match="without a prior"):
        posterior_covariance(derivatives, 0.0)


def test_information_of_a_single_pixel() -> None:
    """Two weights that one pixel sees the sum of: known is half of what there was, along the sum."""
    prior = 1e-2  # with one pixel and two weights, errors of the pixel have the variance prior / 2
    covariance = posterior_covariance(np.array([[1.0, 1.0]]), prior)
    s = prior / 2
    np.testing.assert_allclose(np.array([1, 1]) @ covariance @ [1, 1] / 2, s / (s + 2), rtol=1e-9)
    np.testing.assert_allclose(np.array([1, -1]) @ covariance @ [1, -1] / 2, 1, rtol=1e-9)


def test_left_and_right_become_sum_and_difference() -> None:
    found = {c.name: c.vector for c in contrasts(("cheekLeft", "jaw", "cheekRight", "brow_L", "soloLeft"))}
    assert set(found) == {"cheek, both sides", "cheek, left against right", "jaw", "brow_L", "soloLeft"}
    np.testing.assert_allclose(found["cheek, both sides"], np.array([1, 0, 1, 0, 0]) / np.sqrt(2))
    np.testing.assert_allclose(sum(np.outer(v, v) for v in found.values()), np.eye(5), atol=1e-12)


@pytest.mark.parametrize(("mirrored", "inverted"), [(False, False), (True, True)])
def test_silhouettes_are_laid_over_the_shadow(variant: str, mirrored: bool, inverted: bool, tmp_path: Path) -> None:
    """Another size, another place, facing left, white on black: all is undone."""
    scene, _ = egg_fit()
    model = scene.model
    # The head with more of its neck: what lies below the window belongs to the image, too.
    shadow = scene.shadow(model.mean)
    tall = np.concatenate([shadow, np.tile(shadow[-1:], (16, 1))])
    picture = Image.fromarray(np.round(tall * 255).astype(np.uint8)).resize((300, 320), Image.Resampling.BICUBIC)
    values = np.pad(np.asarray(picture, np.float32) / 255, ((40, 0), (90, 30)), mode="edge")
    values = values[:, ::-1] if mirrored else values
    Image.fromarray(np.round((1 - values if inverted else values) * 255).astype(np.uint8)).save(tmp_path / "s.png")
    silhouette = read_silhouette(tmp_path / "s.png")
    placement = place(silhouette, shadow)
    assert placement.mirrored == mirrored
    laid = resample(silhouette, shadow.shape, placement)
    assert np.mean((laid - shadow) ** 2) < 2e-3
    aside = Placement(placement.scale, placement.x + 20, placement.y, mirrored)
    assert np.mean((resample(silhouette, shadow.shape, aside) - shadow) ** 2) > 5e-3


def test_transparency_is_background(tmp_path: Path) -> None:
    pixels = np.zeros((40, 40, 4), np.uint8)
    pixels[10:, 12:28, 3] = 255
    Image.fromarray(pixels).save(tmp_path / "t.png")
    values = read_silhouette(tmp_path / "t.png")
    assert values[0, 0] == 1 and values[20, 20] == 0


def test_exr_files_are_silhouettes_too(tmp_path: Path) -> None:
    pixels = np.ones((40, 30, 1), np.float32)
    pixels[15:, 8:20] = 0.02
    write_image(tmp_path / "s.exr", pixels)
    values = read_silhouette(tmp_path / "s.exr")
    assert values.shape == (40, 30) and values[0, 0] == 1 and values[30, 12] == 0


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ShadowmapError, match=re.escape(f"needs scipy: {install_hint('faces')}.")):
        run_faces(FaceOptions(out=tmp_path))


def image(tmp_path: Path, pixels: np.ndarray) -> str:
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "image.png")
    return str(tmp_path / "image.png")


BAD_IMAGES = {
    "white": (lambda: np.full((50, 50), 255), "image.png is of one colour"),
    "black": (lambda: np.zeros((50, 50)), "image.png is of one colour"),
    "tiny": (lambda: np.eye(5) * 255, "5 x 5 pixels: give at least 16 x 16"),
    "speck": (lambda: np.pad(np.zeros((2, 2)), 30, constant_values=255), "the silhouette covers 0.1%"),
    "full": (lambda: np.pad(np.zeros((60, 60)), ((1, 0), (1, 0)), constant_values=255)[:, ::-1], "the silhouette covers"),
}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    def call(*arguments: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["shadowmap-dr", *arguments])
        with pytest.raises(SystemExit) as stop:
            main.main()
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out + captured.err

    return call


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_bad_images_are_one_clear_line(run: Any, tmp_path: Path, name: str) -> None:
    make, message = BAD_IMAGES[name]
    status, text = run("face", "--image", image(tmp_path, make()), "--out", str(tmp_path / "out"))
    assert status == 1 and message in text and text.startswith("error: ") and text.count("\n") == 1
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--image", "none.png"), "no image 'none.png'"),
        (("--image", __file__), "it is no image, or it is damaged"),
        (("--model", "none.npz"), "no morphable model 'none.npz'"),
        (("--model", __file__), "it is no .npz file"),
        (("--shadows", "2"), "no number of shadows 2: choose from 1, 3"),
        (("--mode", "smile"), "no mode 'smile'"),
        (("--prior", "-1"), "--prior) is -1.0"),
        (("--iterations", "0"), "--iterations) is 0"),
        (("--head", "-3"), "--head) is -3"),
        (("--head", "1", "--head", "1"), "the head 1 is given twice"),
        (("--image", "a.png", "--mode", "expression"), "choose identity or both"),
        (("--image", "a.png", "--head", "1"), "leave it out with --image"),
        (("convert", "none", "out.npz"), "give a folder of OBJ files"),
        (("convert", __file__, "out.npz"), "an .npz file of plain arrays"),
        (("convert", ".", "out.npz", "--facing", "up"), "a head facing 'up'"),
        (("convert", ".", "out.obj"), "the suffix '.obj' is not one of .npz"),
    ],
)
def test_bad_arguments_are_one_clear_line(
    run: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    status, text = run("face", *arguments)
    assert status == 1 and message in " ".join(text.split()) and text.count("\n") == 1


def test_commands_from_a_folder_to_a_head(run: Any, tmp_path: Path) -> None:
    """A converted model, its artificial heads, a silhouette; a second call keeps what the first has done."""
    model, folder = egg(2), tmp_path / "source"
    folder.mkdir()
    meshes = {"generic_neutral_mesh": model.mean, "jawOpen": model.mean + model.expression[0]}
    meshes |= {f"identity{k:03d}": model.mean + basis for k, basis in enumerate(model.identity)}
    for name, vertices in meshes.items():
        trimesh.Trimesh(vertices, model.faces, process=False).export(folder / f"{name}.obj")
    converted, out = str(tmp_path / "egg.npz"), tmp_path / "out"
    assert run("face", "convert", str(folder), converted, "--facing", "+x", "--neck", "-0.8")[0] == 0
    arguments = [
        "face",
        "--model",
        converted,
        "--head",
        "5",
        "--iterations",
        "40",
        "--height",
        "48",
        "--map-resolution",
        "64",
        "--mode",
        "identity",
        "--mode",
        "expression",
        "--out",
        str(out),
    ]
    status, text = run(*arguments)
    assert status == 0 and "Identity: distances" in text
    record = json.loads((out / "faces.json").read_text())
    assert {"shadowmap_dr", "machine", "settings"} <= record.keys()
    assert set(record["runs"]) == {f"{mode} | {lights} | 5" for mode in ("identity", "expression") for lights in (1, 3)}
    for entry in record["runs"].values():
        assert entry["distance"]["mean"] < 0.7 * entry["start_distance"]["mean"]
    assert record["runs"]["expression | 1 | 5"]["recovery"][0]["name"] == "jawOpen"
    for name in ("faces.md", "identity-profiles-1.png", "identity-profiles-3.png", "identity-errors.png", "convergence.png"):
        assert (out / name).stat().st_size > 100
    assert str(tmp_path) not in (out / "faces.json").read_text()
    finals = {key: entry["final"] for key, entry in record["runs"].items()}
    assert run(*arguments, "--resume")[0] == 0
    assert {key: e["final"] for key, e in json.loads((out / "faces.json").read_text())["runs"].items()} == finals
    status, text = run(*arguments, "--resume", "--prior", "0.5")
    assert status == 1 and "run with other settings" in text

    mi.set_variant("llvm_ad_rgb")
    scene = FaceScene.build(egg(2), 1, height=96)
    shadow = scene.shadow(scene.model.vertices([1, -1, 0, 1.5]))
    picture = image(tmp_path, 255 * shadow[:, ::-1])
    arguments = ["face", "--model", converted, "--image", picture, "--iterations", "60", "--height", "64", "--out", str(out)]
    assert run(*arguments)[0] == 0
    record = json.loads((out / "image-face.json").read_text())
    assert {"shadowmap_dr", "machine", "settings"} <= record.keys()
    assert record["settings"]["placement"]["mirrored"]
    assert record["image_error"] < 0.7 * record["image_error_start"]


def test_a_head_of_the_package_is_found(variant: str, tmp_path: Path) -> None:
    """A short run on the real thing: three shadows leave less than half of the error."""
    record = run_faces(FaceOptions(seeds=(6,), lights=(3,), iterations=120, height=96, samples=2000, out=tmp_path))
    entry = record["runs"]["identity | 3 | 6"]
    assert entry["start_distance"]["mean"] > 0.02
    assert entry["distance"]["mean"] < 0.5 * entry["start_distance"]["mean"]


def test_path_traced_shadows_do_as_well(variant: str, tmp_path: Path) -> None:
    save_model(tmp_path / "egg.npz", egg(2))
    common: dict[str, Any] = {"seeds": (5,), "lights": (1,), "iterations": 60, "height": 48, "samples": 500, "spp": 64}
    found = {}
    for reference in ("own", "mitsuba"):
        options = FaceOptions(**common, model=tmp_path / "egg.npz", reference=reference, out=tmp_path / reference)
        found[reference] = run_faces(options)["runs"]["identity | 1 | 5"]["distance"]["mean"]
    assert abs(found["own"] - found["mitsuba"]) < 0.01


def test_artificial_heads_follow_from_their_seed() -> None:
    model = default_model()
    identity, expression = artificial_weights(model, 6, "both")
    np.testing.assert_array_equal(identity, artificial_weights(model, 6, "identity")[0])
    np.testing.assert_array_equal(identity, np.random.default_rng(6).standard_normal(80))
    assert (expression >= 0).all() and expression.std() > 0.3
    assert not artificial_weights(model, 6, "identity")[1].any()


def test_step_is_recorded_once(variant: str) -> None:
    _, fit = egg_fit(3, translate=True)
    for _ in range(8):
        fit.step()
    dr.sync_thread()
    assert fit.recordings() <= 2
