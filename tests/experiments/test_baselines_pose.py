"""The area light in place of a directional one, and pose estimation with Mitsuba's projective integrator."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_baselines import fair_settings, proxy, reference
from mitsuba_baselines.fair_settings import fair_setting, is_fair
from mitsuba_baselines.pose import MitsubaPose, ProjectiveSetting, pose_start
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.pose.methods import METHODS, usual_methods
from shadowmap_dr.io import assets

RESOLUTION = 32


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def scene() -> mi.Scene:
    mi.set_variant("llvm_ad_rgb")
    return mi.load_file(str(assets.scene("pose")), optimize=False, resolution=RESOLUTION)


@pytest.fixture
def target(scene: mi.Scene) -> np.ndarray:
    return reference.path_traced(scene, spp=256).image


def fit(target: np.ndarray, setting: ProjectiveSetting | None = None, **options: object) -> MitsubaPose:
    setting = setting or ProjectiveSetting(1, 1, 4)
    return MitsubaPose(assets.scene("pose"), assets.mesh("spot"), RESOLUTION, setting, target, **options)


def test_proxy_keeps_its_promises(scene: mi.Scene) -> None:
    light = proxy.calibrate(scene)
    assert light.penumbra_px <= 0.5 + 1e-9 and light.parallax_px <= 0.25 + 1e-9
    assert light.irradiance_residual <= 0.005
    assert light.image_residual < 0.02
    np.testing.assert_allclose(light.direction, [0, 0, -1], atol=1e-6)
    area = np.pi * light.diameter**2 / 4
    np.testing.assert_allclose(light.radiance, np.pi * light.distance**2 / area, rtol=1e-5)
    json.dumps(light.record())


def test_proxy_of_tilted_light_and_finer_image() -> None:
    def build(resolution: int) -> mi.Scene:
        scene = mi.load_file(str(assets.scene("pose")), optimize=False, resolution=resolution)
        params = mi.traverse(scene)
        params["light.to_world"] = mi.Transform4f().look_at([0, 0, 0], [0.3, -0.2, -1], [0, 1, 0])
        params.update()
        return scene

    coarse, fine = proxy.calibrate(build(32)), proxy.calibrate(build(64))
    assert coarse.irradiance_residual <= 0.005 and fine.irradiance_residual <= 0.005
    np.testing.assert_allclose(coarse.direction, np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1]), atol=1e-5)
    # Half the pixel, half the light's angle.
    ratio = (fine.diameter / fine.distance) / (coarse.diameter / coarse.distance)
    assert 0.4 < ratio < 0.6


def test_proxy_errors_name_the_offender(scene: mi.Scene) -> None:
    with pytest.raises(ShadowmapError, match="no emitter 'lamp'"):
        proxy.calibrate(scene, light="lamp")
    with pytest.raises(ShadowmapError, match="no shape 'floor'"):
        proxy.calibrate(scene, receiver="floor")
    still_life = mi.load_file(str(assets.scene("still_life")), optimize=False, resolution=16)
    with pytest.raises(ShadowmapError, match="'bulb' is not directional"):
        proxy.calibrate(still_life, light="bulb", receiver="table", casters=("vase",))


def test_gradient_agrees_with_finite_differences(scene: mi.Scene, target: np.ndarray) -> None:
    # A large light, whose shadow boundaries samples find often. The derivatives agree only roughly: probably because Mitsuba
    # leaves out the edges between flat-shaded faces.
    light = proxy.calibrate(scene, max_penumbra_px=1.5, uniformity=0.02)
    pose = fit(target, ProjectiveSetting(16, 16, 64), proxy=light)
    at = np.array([-0.35, 0.05, 0.2])
    step = 0.02

    def loss(parameters: np.ndarray) -> float:
        return float(np.mean((pose.render(parameters, spp=256) - target) ** 2))

    expected = [(loss(at + step * axis) - loss(at - step * axis)) / (2 * step) for axis in np.eye(3)]
    value, _ = pose.loss_and_gradient(at)
    gradients = []
    for seed in range(8):
        pose.seed = seed
        gradients.append(pose.loss_and_gradient(at)[1])
    gradient = np.mean(gradients, axis=0)
    cosine = gradient @ expected / np.linalg.norm(gradient) / np.linalg.norm(expected)
    assert value == pytest.approx(loss(at), rel=0.05)
    assert cosine > 0.9, (gradient, expected)
    assert 0.6 < np.linalg.norm(gradient) / np.linalg.norm(expected) < 1.5


def test_continues_exactly_from_a_state(target: np.ndarray) -> None:
    first = fit(target)
    first.reset(pose_start(1))
    for _ in range(3):
        first.step()
    state = {name: np.array(value) for name, value in first.state().items()}
    losses = [first.step() for _ in range(2)]
    second = fit(target)
    second.load_state(state)
    np.testing.assert_allclose([second.step() for _ in range(2)], losses, rtol=1e-5)
    np.testing.assert_allclose(second.parameters(), first.parameters(), rtol=1e-4, atol=1e-6)


def test_interface(target: np.ndarray) -> None:
    pose = fit(target, step_size=0.02, seed=5)
    np.testing.assert_array_equal(pose.parameters(), np.zeros(3))
    image = pose.render(np.zeros(3))
    assert image.shape == target.shape and image.dtype == np.float32
    assert np.sqrt(np.mean((image - target) ** 2) / np.mean(target**2)) < 0.05
    before = pose.parameters()
    assert isinstance(pose.step(), float)
    # Adam's first step has the length of its step size, but for its epsilon where the gradient is tiny.
    np.testing.assert_allclose(np.abs(pose.parameters() - before), 0.02, rtol=0.1)
    record = json.loads(json.dumps(pose.describe()))
    assert record["proxy"]["penumbra_px"] <= 0.5 and record["guiding"] == "none" and record["step_size"] == 0.02


def test_starts_follow_the_protocol() -> None:
    rng = np.random.default_rng(7)
    x, y, degrees = rng.uniform(-0.25, 0.25), rng.uniform(-0.25, 0.25), rng.uniform(-30, 30)
    np.testing.assert_allclose(pose_start(3, seed=4), [np.radians(degrees), x, y])


def test_errors(target: np.ndarray) -> None:
    with pytest.raises(ShadowmapError, match="'tree'"):
        ProjectiveSetting(1, 1, 1, "tree")
    with pytest.raises(ShadowmapError, match="1/0/1"):
        ProjectiveSetting(1, 0, 1)
    with pytest.raises(ShadowmapError, match=r"\(8, 8, 3\)"):
        fit(np.zeros((8, 8, 3)))
    with pytest.raises(ShadowmapError, match=r"\(2,\)"):
        fit(target).reset([0, 0])


def test_fair_setting_is_stored() -> None:
    setting = fair_setting(128)
    assert setting.guiding != "octree"
    assert is_fair(setting, 128)
    assert not is_fair(setting, 100)  # not searched there
    # Half the width, twice the resolution: as many samples in all, and at least one for each pixel.
    coarse, fine = fair_setting(64), fair_setting(1 << 12)
    assert (coarse.sppc, coarse.sppi) == (4 * setting.sppc, 4 * setting.sppi)
    assert (fine.sppc, fine.sppi) == (1, 1) and not is_fair(fine, 1 << 12)
    assert not is_fair(ProjectiveSetting(1, 1, 1), 128)
    assert not is_fair(setting, 128, mesh="bunny")  # nor with this object


def test_searches_keep_what_others_write_meanwhile(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    store = tmp_path / "fair.json"
    store.write_text("{}")

    def search(resolution: int, *, save: Any, candidates: Any, earlier: Any, **_: Any) -> dict[str, Any]:
        assert earlier is None and len(candidates) == 1
        store.write_text(json.dumps({**json.loads(store.read_text()), "16": {"setting": None}}))
        save({"resolution": resolution, "setting": None})
        return {"setting": None}

    monkeypatch.setattr(fair_settings, "find_fair_setting", search)
    monkeypatch.setattr(sys, "argv", ["pose", "--search", "32", "--output", str(store), "--candidates", "1/1/1", "1/1/1"])
    fair_settings.main()
    assert set(json.loads(store.read_text())) == {"16", "32"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--search", "0"], "a resolution of 0 pixels"),
        (["--search", "99999999"], "a resolution of 99999999 pixels"),
        (["--search", "16", "--candidates", "0/1/1"], "sample counts 0/1/1"),
        (["--search", "16", "--candidates", "a/b"], "give C/P/I"),
        (["--search", "16", "--mesh", "damaged.ply"], "cannot load"),
        (["--search", "16", "--output", "list.json"], "list.json holds no searches"),
    ],
)
def test_searches_name_bad_input(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "damaged.ply").write_text("ply\nnothing")
    (tmp_path / "list.json").write_text("[]")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["pose", "--output", "new.json", *arguments])
    with pytest.raises(SystemExit) as ended:
        fair_settings.main()
    assert str(ended.value).startswith("error: ") and message in str(ended.value) and "\n" not in str(ended.value)


def test_fair_settings_are_kept_by_kind_of_normals(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    store = tmp_path / "fair.json"
    monkeypatch.setattr(fair_settings, "STORE", store)
    flat, smooth = ProjectiveSetting(4, 4, 64), ProjectiveSetting(4, 4, 16)
    entries = {"128": {"resolution": 128, "setting": asdict(flat)}}
    store.write_text(json.dumps(entries))
    with pytest.raises(ShadowmapError, match="--normals vertex"):
        fair_setting(128, "vertex")
    assert usual_methods() == METHODS and usual_methods(normals="vertex") == usual_methods(shadow_only=True) == METHODS[:2]
    entries["128 vertex normals"] = {"resolution": 128, "normals": "vertex", "setting": asdict(smooth)}
    store.write_text(json.dumps(entries))
    assert usual_methods(normals="vertex") == METHODS
    assert fair_setting(128) == flat and fair_setting(128, "vertex") == smooth
    assert is_fair(smooth, 128, "vertex") and not is_fair(smooth, 128) and not is_fair(flat, 128, "vertex")


def test_search_goes_on_within_a_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[tuple[str, int]] = []

    def measure(method: MitsubaPose, run: int, iterations: int) -> dict[str, float]:
        measured.append((str(method.setting), run))
        lost = method.setting.sppi == 1 and run == 1
        return {"run": run, "mean_error_deg_last_20": 5.0 if lost else 0.01, "offset_x100": 0.1, "seconds_per_iteration": 1.0}

    def search(earlier: dict | None = None, stop_after: int = 99) -> tuple[dict, list[dict]]:
        saved: list[dict] = []

        def save(record: dict) -> None:
            saved.append(json.loads(json.dumps(record)))
            if len(saved) >= stop_after:
                raise KeyboardInterrupt

        try:
            return fair_settings.find_fair_setting(16, candidates=(bad, good), earlier=earlier, save=save), saved
        except KeyboardInterrupt:
            return {}, saved

    bad, good = ProjectiveSetting(1, 1, 1, spp=1), ProjectiveSetting(1, 1, 4, spp=1)
    monkeypatch.setattr(fair_settings, "_measure", measure)
    monkeypatch.setattr(fair_settings, "_timed", lambda step: 0.1)
    whole, _ = search()
    assert measured == [(str(bad), 0), (str(bad), 1), (str(good), 0), (str(good), 1), (str(good), 2)]
    assert whole["setting"]["sppi"] == 4 and not whole["untried"]

    measured.clear()
    # The costs of the two, two runs and the candidate, then two runs of the other one.
    _, saved = search(stop_after=7)
    resumed, _ = search(saved[-1])
    assert measured == [(str(bad), 0), (str(bad), 1), (str(good), 0), (str(good), 1), (str(good), 2)]
    assert resumed["setting"] == whole["setting"]
    assert [len(entry["runs"]) for entry in resumed["measurements"]] == [2, 3]


@pytest.mark.parametrize(
    "changes",
    [{"mesh": "bunny"}, {"resolution": 32}, {"normals": "vertex"}, {"starts": 4}, {"iterations": 9}, {"threshold_deg": 1}],
)
def test_searches_of_something_else_are_not_continued(changes: dict) -> None:
    earlier = {"resolution": 16, "mesh": "spot", "starts": 3, "iterations": 150, "threshold_deg": 0.1, "measurements": []}
    with pytest.raises(ShadowmapError, match=next(iter(changes))):
        fair_settings.find_fair_setting(**{"resolution": 16, "candidates": (), "earlier": earlier, **changes})


@pytest.mark.parametrize("normals", ["face", "vertex"])
def test_searches_begin_without_an_earlier_one(normals: str) -> None:
    found = fair_settings.find_fair_setting(16, normals=normals, candidates=())
    assert found["normals"] == normals and found["setting"] is None and found["measurements"] == []
    again = fair_settings.find_fair_setting(16, normals=normals, candidates=(), earlier=json.loads(json.dumps(found)))
    assert again.keys() == found.keys()


def test_search_skips_what_costs_more_than_a_known_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[str] = []

    def measure(method: MitsubaPose, run: int, iterations: int) -> dict[str, float]:
        measured.append(str(method.setting))
        return {"run": run, "mean_error_deg_last_20": 0.01, "offset_x100": 0.1, "seconds_per_iteration": method.setting.sppi}

    monkeypatch.setattr(fair_settings, "_measure", measure)
    monkeypatch.setattr(fair_settings, "_timed", lambda step: 0.1 * step.__self__.setting.sppi)
    known, cheap, dear = (ProjectiveSetting(1, 1, count, spp=1) for count in (4, 2, 9))
    earlier = fair_settings.find_fair_setting(16, candidates=(known,))
    measured.clear()
    found = fair_settings.find_fair_setting(16, candidates=(dear,), earlier=earlier)
    assert not measured and found["setting"] == asdict(known) and found["untried"] == {str(dear): pytest.approx(0.9)}
    found = fair_settings.find_fair_setting(16, candidates=(dear, cheap), earlier=earlier)
    assert set(measured) == {str(cheap)} and found["setting"] == asdict(cheap)
