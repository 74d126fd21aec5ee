"""The experiments on gradients: their scene, their measures, recovery from shadows, and small runs of each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_baselines.derivatives import agreement, central_difference
from mitsuba_baselines.projective import projective_derivative
from mitsuba_baselines.proxy import calibrate, with_proxy
from mitsuba_baselines.reference import path_traced
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.common.meshes import Mesh
from shadowmap_dr.experiments.gradients import convergence as gradients_convergence
from shadowmap_dr.experiments.gradients import jacobian as gradients_jacobian
from shadowmap_dr.experiments.gradients import plane as gradients_plane
from shadowmap_dr.experiments.gradients import report as gradients_report
from shadowmap_dr.experiments.gradients import scenes as gradients_scenes
from shadowmap_dr.experiments.gradients.convergence import ConvergenceOptions, run_convergence
from shadowmap_dr.experiments.gradients.fit import ShadowFit
from shadowmap_dr.experiments.gradients.images import (
    blurred_by_map,
    central_derivative,
    forward_derivative,
    reverse_error,
    texel_in_pixels,
)
from shadowmap_dr.experiments.gradients.jacobian import JacobianOptions, run_jacobian
from shadowmap_dr.experiments.gradients.plane import PlaneOptions, run_plane
from shadowmap_dr.experiments.gradients.scenes import MOTIONS
from shadowmap_dr.inverse import optimize
from shadowmap_dr.rendering.renderer import Renderer


def turned_square(degrees: float, half: float = 0.45, z: float = 0.0) -> Mesh:
    """A square that is parallel to the receiver, but not to the pixels."""
    mesh = gradients_scenes.plane(half, z)
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Mesh(np.c_[mesh.vertices[:, :2] @ turn.T, mesh.vertices[:, 2]].astype(np.float32), mesh.faces)


@pytest.mark.parametrize("camera", gradients_scenes.CAMERAS)
def test_images_are_visibilities_and_do_not_show_the_occluder(variant: str, camera: str) -> None:
    scene = gradients_scenes.build(gradients_scenes.plane(0.5, 1.0), 64, camera)
    image = path_traced(scene, spp=16).image
    assert image.shape == (64, 64, 1) and 0 <= image.min() and image.max() <= 1.001
    own = np.array(Renderer.from_scene(scene).render())
    assert agreement(own, image).cosine > 0.99 and agreement(own, image).scale == pytest.approx(1, abs=0.02)
    if camera != "perspective":  # the receiver fills the image, and the square casts a quarter of it into shadow
        assert image.mean() == pytest.approx(0.75, abs=0.005)


def test_pinhole_sees_what_the_orthographic_camera_sees(variant: str) -> None:
    mesh = turned_square(20)
    cameras = ("orthographic", "pinhole")
    first, second = (path_traced(gradients_scenes.build(mesh, 64, camera), spp=16).image for camera in cameras)
    np.testing.assert_allclose(first, second, atol=1e-4)


def test_ring() -> None:
    mesh = gradients_scenes.ring()
    assert len(mesh.faces) == 130_000
    assert np.abs(mesh.vertices[:, :2]).max() < 0.7  # its shadow, with the widest filter, lies inside the receiver
    assert mesh.vertices[:, 2].min() > gradients_scenes._BETWEEN_Z + 0.1
    for name in gradients_convergence.OCCLUDERS:
        occluder = gradients_convergence.occluder(name).vertices
        assert occluder[:, 2].min() > gradients_scenes._BESIDE[2] + 0.1
        assert np.abs(occluder[:, 0]).max() + gradients_convergence.MAX_DISPLACEMENT < 1.05


@pytest.mark.parametrize("name", MOTIONS)
def test_motions(name: str) -> None:
    mesh, motion = gradients_scenes.ring(600), MOTIONS[name]
    step = 1e-3
    low, high = (motion.moved(mesh, sign * step).vertices.astype(np.float64) for sign in (-1, 1))
    np.testing.assert_allclose((high - low) / (2 * step), motion.rate(mesh), atol=2e-4)
    step = motion.step(mesh, 512)
    distance = (motion.moved(mesh, step).vertices - motion.moved(mesh, -step).vertices)[:, : 3 if motion.along_light else 2]
    assert np.linalg.norm(distance, axis=1).max() == pytest.approx(2 / 512, rel=1e-3)
    assert motion.along_light == (name == "z")


@pytest.mark.parametrize("taps", [1, 5])
def test_blur_of_the_map(variant: str, taps: int) -> None:
    """The sharp derivative of a shadow, blurred with the map's kernel, is what the map gives. Its texels are oblong."""
    mesh = turned_square(17)
    mesh = Mesh(mesh.vertices * np.float32([1, 0.6, 1]), mesh.faces)
    scene = gradients_scenes.build(mesh, 128)
    renderer = gradients_jacobian.make_renderer(scene, "4 x 4 texels", 32, taps)
    texel = texel_in_pixels(renderer, 128)
    assert texel[0] > 1.3 * texel[1] > 2
    motion = MOTIONS["y"]
    _, derivative = forward_derivative(renderer, motion.rate(mesh))
    sharp = central_difference(lambda t: gradients_scenes.build(motion.moved(mesh, t), 128), motion.step(mesh, 128, 0.5), spp=400)
    # No blur beside that of the kernel but 5 pixels: the kernel itself is tested.
    found = agreement(derivative, blurred_by_map(sharp.image, renderer))
    assert found.cosine > 0.99 and found.scale == pytest.approx(1, abs=0.04)
    assert agreement(derivative, sharp.image).scale < found.scale - 0.08


def test_derivative_images_and_reverse_mode(variant: str) -> None:
    mesh, motion = turned_square(17), MOTIONS["rotation"]
    renderer = gradients_jacobian.make_renderer(gradients_scenes.build(mesh, 96), "default", 64, 3)
    _, derivative = forward_derivative(renderer, motion.rate(mesh))
    found = agreement(derivative, central_derivative(renderer, mesh, motion, motion.step(mesh, 96)), 6)
    assert found.cosine > 0.98 and found.scale == pytest.approx(1, abs=0.03)
    assert reverse_error(renderer, motion.rate(mesh), derivative) < 1e-4
    assert reverse_error(renderer, 1.1 * motion.rate(mesh), derivative) > 1e-4  # of another motion it is not


def test_projective_derivative(variant: str) -> None:
    """Right in scale, not only in shape; and the scene is as it was afterwards."""
    mesh, motion = turned_square(17), MOTIONS["x"]
    scene = gradients_scenes.build(mesh, 32, "pinhole")
    proxy = calibrate(scene, receiver="receiver", casters=("occluder",), max_penumbra_px=8, uniformity=0.05)
    lit = with_proxy(scene, proxy)
    done: list[None] = []
    found = projective_derivative(lit, "occluder", motion.rate(mesh), sppi=1024, passes=2, on_pass=lambda: done.append(None))
    reference = central_difference(
        lambda t: with_proxy(gradients_scenes.build(motion.moved(mesh, t), 32, "pinhole"), proxy), motion.step(mesh, 32), spp=400
    )
    result = agreement(found.image, reference.image, 4)
    assert result.cosine > 0.9 and result.scale == pytest.approx(1, abs=0.2), result
    assert len(done) == 2 and 0 < found.settings["halves_cosine"] < 1
    np.testing.assert_array_equal(np.array(mi.traverse(lit)["occluder.vertex_positions"]), mesh.vertices.ravel())
    with pytest.raises(ShadowmapError, match="1 passes"):
        projective_derivative(lit, "occluder", motion.rate(mesh), sppi=1, passes=1)


def small_fit(**options: Any) -> ShadowFit:
    mesh = turned_square(17)
    renderer = Renderer.from_scene(gradients_scenes.build(mesh, 48), shadow_map_resolution=48)
    basis = np.zeros((2, 4, 3))
    basis[0, :, 0] = basis[1, :, 1] = 1
    return ShadowFit(renderer, mesh.vertices, basis, np.array(renderer.render()), step_size=0.02, **options)


def test_shadow_fit_frozen_recovers_an_offset(variant: str) -> None:
    fit = small_fit(decay=(0.01, 80))
    history = optimize(fit, (0.1, -0.05), 80)
    assert np.abs(history.final).max() < 1e-3 and history.loss[-1] < 1e-4 * history.loss[0]
    np.testing.assert_allclose(fit.render((0, 0)), np.array(fit._reference), atol=0.03)  # the map covers another part by now
    assert fit.describe()["decay"] == (0.01, 80)


def test_shadow_fit_frozen_goes_on_from_its_state(variant: str) -> None:
    fit = small_fit()
    fit.reset((0.1, -0.05))
    for _ in range(4):
        fit.step()
    state = fit.state()
    expected = [np.array(fit.parameters()) for _ in range(3) if fit.step() is not None]
    other = small_fit()
    other.load_state(state)
    found = [np.array(other.parameters()) for _ in range(3) if other.step() is not None]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(found[-1] - state["parameters"]).max() > 0.01


@pytest.mark.parametrize(
    ("basis", "reference", "word"),
    [
        (np.zeros((2, 3, 3)), np.zeros((4, 4, 1)), "basis"),
        (np.zeros((1, 4, 3)), np.zeros((4, 4)), "reference"),
        (np.zeros((1, 4, 3)), np.full((4, 4, 1), np.nan), "reference"),
    ],
)
def test_shadow_fit_names_bad_input(variant: str, basis: np.ndarray, reference: np.ndarray, word: str) -> None:
    renderer = Renderer.from_scene(gradients_scenes.build(turned_square(0), 16))
    with pytest.raises(ShadowmapError, match=word):
        ShadowFit(renderer, turned_square(0).vertices, basis, reference, step_size=0.1)
    with pytest.raises(ShadowmapError, match="2 numbers"):
        small_fit().reset((0.0, 0.0, 0.0))


SMALL = {"resolution": 96, "faces": 600, "spp": 32, "mitsuba_passes": 0, "motions": ("x", "z"), "map_resolutions": (64,)}


def test_small_jacobian(variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = run_jacobian(JacobianOptions(**SMALL, filter_sizes=(3,), out=tmp_path))
    entry = first["entries"]["default | x | 64 | 3"]
    assert min(entry["own"]["cosine"], entry["traced_blurred"]["cosine"]) > 0.98
    assert entry["own"]["scale"] == pytest.approx(1, abs=0.05) and entry["reverse_error"] < 1e-4
    # What is missing against path tracing is what a faultless map's blur takes away.
    assert entry["blur"]["scale"] < 0.97 and entry["traced"]["scale"] == pytest.approx(entry["blur"]["scale"], abs=0.04)
    along = first["entries"]["default | z | 64 | 3"]
    assert along["relative_norm"] < 0.1 and "own" not in along
    assert first["references"]["z"]["norm"] == 0 < first["references"]["x"]["norm"]
    assert first["tessellation"]["x"]["gradient_change"] < 0.02 and first["tessellation"]["x"]["divided_faces"] > 100_000
    assert (tmp_path / "jacobian.png").stat().st_size > 1000 and (tmp_path / "jacobian-agreement.png").exists()
    reading = (tmp_path / "jacobian.md").read_text()
    assert "1 of 1 reach" in reading and "moves no shadow" in reading

    # A later run keeps what there is, and adds to it.
    measured = []
    measure = gradients_jacobian._measure
    monkeypatch.setattr(gradients_jacobian, "_measure", lambda *args: measured.append(args[1:5]) or measure(*args))
    damaged = tmp_path / "references" / "x.exr"
    damaged.write_bytes(damaged.read_bytes()[:500])  # made again
    wider = JacobianOptions(**SMALL, filter_sizes=(1, 3), candidates=("default", "no anti-aliasing"), out=tmp_path, resume=True)
    second = run_jacobian(wider)
    assert ("default", "x", 64, 3) not in measured and ("default", "x", 64, 1) in measured
    assert {"shadowmap_dr", "machine", "settings"} <= second.keys()
    assert second["entries"]["default | x | 64 | 3"] == json.loads(json.dumps(entry))
    assert second["entries"]["no anti-aliasing | x | 64 | 3"]["own"]["cosine"] < 0.8
    with pytest.raises(ShadowmapError, match="leave out --resume"):
        run_jacobian(JacobianOptions(**{**SMALL, "spp": 8}, filter_sizes=(3,), out=tmp_path, resume=True))


def test_reading_tells_what_is_not_reached() -> None:
    good = {"cosine": 0.999, "scale": 1.0}
    entry = {
        "candidate": "default",
        "motion": "x",
        "map": 64,
        "filter": 3,
        "reverse_error": 1e-6,
        "own": good,
        "traced": good,
        "traced_blurred": good,
    }
    bad = {**entry, "motion": "scale", "filter": 9, "traced": {"cosine": 0.99, "scale": 0.8}, "reverse_error": 1e-3}
    record = {
        "settings": {"faces": 1, "resolution": 2, "spp": 3},
        "entries": {"a": entry, "b": bad},
        "references": {},
        "mitsuba": {},
        "tessellation": {"x": {"gradient_change": 0.03, "image_change": 0.1}},
    }
    text = gradients_report.read_jacobian(record)
    assert "against path-traced differences 1 of 2 reach" in text and "worst scale at 64 texels, filter 9: 0.990, 0.800" in text
    assert "against own differences 2 of 2 reach" in text and "with the map's blur" not in text
    assert text.count("not reached") == 2  # tessellation and reverse mode
    worse = {**bad, "filter": 15, "traced": {"cosine": 0.99, "scale": 0.94}, "blur": {"cosine": 0.99, "scale": 0.96}}
    bad["blur"] = {"cosine": 0.99, "scale": 0.79}
    text = gradients_report.read_jacobian(record | {"entries": {"a": entry, "b": bad, "c": worse}})
    assert "Of the 2 that miss path-traced differences, path-traced images with the map's blur miss them in 1, too" in text
    assert "nearer to 1 than theirs by up to 0.010, farther from it by up to 0.020" in text
    _, rows = gradients_report.jacobian_rows(record)
    assert rows[1][1:] == ["0.999", "1.000", "0.990", "0.800", "0.999", "1.000", "1e-03"]


def test_small_convergence(variant: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = {
        "occluders": ("ring",),
        "cameras": ("perspective",),
        "filter_sizes": (3,),
        "map_resolution": 64,
        "resolution": 96,
        "iterations": 120,
        "spp": 32,
        "out": tmp_path,
    }
    first = run_convergence(ConvergenceOptions(**options, displacements=(0.1,)))
    run = first["runs"]["ring | perspective | 3 | 0.1"]
    assert run["recovered"] and run["error_texels"] < 0.3
    assert run["error_curve_texels"][0] == pytest.approx(0.1 / run["texel"], rel=1e-4) and len(run["loss_curve"]) == 120
    assert "1 of 1 runs recover" in (tmp_path / "convergence.md").read_text()
    assert all((tmp_path / f"{name}.png").exists() for name in ("convergence", "convergence-errors", "convergence-images"))

    starts = []
    monkeypatch.setattr(gradients_convergence, "optimize", lambda m, s, n: starts.append(s) or optimize(m, s, n))
    second = run_convergence(ConvergenceOptions(**options, displacements=(0.1, 0.2), resume=True))
    assert starts == [(0.2,)] and second["runs"]["ring | perspective | 3 | 0.1"] == run
    with pytest.raises(ShadowmapError, match="leave out --resume"):
        run_convergence(ConvergenceOptions(**{**options, "spp": 8}, displacements=(0.1,), resume=True))

    # A record from before there were candidates.
    old = json.loads((tmp_path / "convergence.json").read_text())
    assert {"shadowmap_dr", "machine", "settings"} <= old.keys()
    del old["checks"]
    for run in old["runs"].values():
        del run["candidate"]
    (tmp_path / "convergence.json").write_text(json.dumps(old))
    assert run_convergence(ConvergenceOptions(**options, displacements=(0.1, 0.2), resume=True))["runs"] == second["runs"]


def test_outlines_that_are_not_parallel_to_texels_are_placed_exactly(variant: str, tmp_path: Path) -> None:
    """All of a parallel one lies at the same place within its texels, and ends up to a fifth of one away."""
    options = {
        "cameras": ("orthographic",),
        "filter_sizes": (3,),
        "displacements": (0.1, 0.3),
        "map_resolution": 96,
        "resolution": 128,
        "iterations": 170,
        "spp": 128,
    }
    occluders, candidates = ("plane", "turned plane"), ("default", "no anti-aliasing")
    runs = run_convergence(ConvergenceOptions(**options, occluders=occluders, candidates=candidates, out=tmp_path))["runs"]
    turned = [runs[f"turned plane | orthographic | 3 | {d}"]["error_texels"] for d in (0.1, 0.3)]
    assert max(turned) < 0.02
    for d in (0.1, 0.3):
        assert runs[f"plane | orthographic | 3 | {d}"]["error_texels"] < 0.25
        for name in occluders:
            stays = runs[f"no anti-aliasing | {name} | orthographic | 3 | {d}"]
            assert stays["candidate"] == "no anti-aliasing" and not stays["recovered"]
    text = (tmp_path / "convergence.md").read_text()
    assert "| turned plane, orthographic, 3 | 2/2 | 0.3 |" in text
    assert "| plane, orthographic, 3, no anti-aliasing | 0/2 | - | - |" in text


def test_largest_recovered() -> None:
    runs = [{"displacement": d, "recovered": found} for d, found in ((0.3, False), (0.1, True), (0.2, True), (0.4, True))]
    assert gradients_convergence.largest_recovered(runs) == 0.2
    assert gradients_convergence.largest_recovered(runs[:1]) == 0


def test_small_minimal_plane(variant: str, tmp_path: Path) -> None:
    record = run_plane(PlaneOptions(resolution=192, spp=64, out=tmp_path))
    for run in record["runs"]:
        assert run["recovered"] == run["antialiased"], run["error"]
        assert run["error_curve"][0] == pytest.approx(0.375 * np.sqrt(2), rel=1e-5)
    assert {run["camera"] for run in record["runs"]} == {"orthographic", "perspective"}
    reading = (tmp_path / "minimal-plane.md").read_text()
    assert "With anti-aliased moments 2 of 2" in reading and "there is no gradient" in reading
    assert json.loads((tmp_path / "minimal-plane.json").read_text()) == record
    assert {"shadowmap_dr", "machine", "settings"} <= record.keys()
    assert gradients_plane.plane_table(record).row_count == 4 and (tmp_path / "minimal-plane-images.png").exists()


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: JacobianOptions(motions=("sideways",)), "sideways"),
        (lambda: JacobianOptions(candidates=()), "candidate"),
        (lambda: JacobianOptions(filter_sizes=(4,)), "4"),
        (lambda: JacobianOptions(map_resolutions=(8,), filter_sizes=(9,)), "too large"),
        (lambda: JacobianOptions(mitsuba_passes=1), "1 passes"),
        (lambda: JacobianOptions(resolution=4), "resolution"),
        (lambda: ConvergenceOptions(occluders=("moon",)), "moon"),
        (lambda: ConvergenceOptions(displacements=(0.9,)), "0.9"),
        (lambda: ConvergenceOptions(displacements=(0.0,)), "0.0"),
        (lambda: ConvergenceOptions(filter_sizes=()), "filter size"),
        (lambda: PlaneOptions(cameras=("fisheye",)), "fisheye"),
        (lambda: PlaneOptions(filter_size=2), "2"),
        (lambda: PlaneOptions(iterations=0), "iterations"),
    ],
)
def test_bad_options_are_named(make: Any, word: str) -> None:
    with pytest.raises(ShadowmapError, match=word):
        make()
