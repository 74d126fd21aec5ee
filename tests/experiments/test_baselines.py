"""The references that everything else is compared with."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from references import cases

from mitsuba_baselines import derivatives, reference, unshadowed
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io import assets

SCENES = cases.SCENES


def load(name: str, resolution: int = 48) -> mi.Scene:
    return mi.load_file(str(assets.scene(name)), optimize=False, resolution=resolution)


def one_object(shape: dict, bsdf: dict | None = None, filter_type: str = "box") -> mi.Scene:
    """A convex object, so that nothing but its own horizon casts shadows, under three kinds of light."""
    T = mi.ScalarTransform4f
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 35,
                "to_world": T().look_at([0, 1, 5], [0, 0, 0], [0, 1, 0]),
                "film": {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": filter_type}, "pixel_format": "rgb"},
            },
            "object": {**shape, "bsdf": bsdf or {"type": "diffuse"}},
            "sun": {"type": "directional", "direction": [1, -1, -1], "irradiance": 2.0},
            "bulb": {"type": "point", "position": [-3, 2, 0.4], "intensity": 6.0},
            "spot": {"type": "spot", "to_world": T().look_at([2, 3, 3], [0, 0, 0], [0, 1, 0]), "intensity": 9.0},
        }
    )


def relative_rms(image: np.ndarray, target: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image - target) ** 2) / np.mean(target**2)))


@pytest.mark.parametrize("name", SCENES)
def test_scene_has_light_and_shadow(variant: str, name: str) -> None:
    scene = load(name)
    shadowed = reference.path_traced(scene, spp=16)
    lit = unshadowed.unshadowed(scene, spp=16)
    assert shadowed.image.shape == (48, 48, 3) and shadowed.image.dtype == np.float32
    assert np.isfinite(shadowed.image).all() and np.isfinite(lit.image).all()
    darker = (shadowed.image < 0.8 * lit.image).all(-1).mean()
    assert darker > 0.015, f"only {darker:.1%} of the pixels lie in shadow"
    # Shadow rays only ever take light away; silhouette pixels differ by noise.
    brighter = (shadowed.image > 1.05 * lit.image + 0.05 * lit.image.mean()).any(-1).mean()
    assert brighter < 0.04


def test_no_shadow_ray_and_shadow_ray_agree_where_nothing_is_shadowed(variant: str) -> None:
    scene = one_object({"type": "sphere"})
    error = relative_rms(unshadowed.unshadowed(scene, spp=256).image, reference.path_traced(scene, spp=256).image)
    assert error < 0.01


def test_geometric_gate_does_what_the_own_surface_does_to_a_shadow_ray(variant: str) -> None:
    # A cube whose vertex normals are those of a sphere: shading and geometric horizon lie far apart.
    cube = mi.load_dict({"type": "cube"})
    params = mi.traverse(cube)
    positions = np.array(params["vertex_positions"]).reshape(-1, 3)
    params["vertex_normals"] = (positions / np.linalg.norm(positions, axis=1, keepdims=True)).ravel()
    params.update()
    scene = one_object({"type": "sphere"})
    description = {"type": "scene", "sensor": scene.sensors()[0], "object": cube}
    for light in scene.emitters():
        description[light.id()] = light
    scene = mi.load_dict(description)
    traced = reference.path_traced(scene, spp=256).image
    gated = relative_rms(unshadowed.unshadowed(scene, spp=256).image, traced)
    ungated = relative_rms(unshadowed.unshadowed(scene, spp=256, geometric_gate=False).image, traced)
    assert gated < 0.02  # noise of the silhouettes
    assert ungated > 5 * gated


@pytest.mark.parametrize(
    "bsdf",
    [
        {"type": "twosided", "bsdf": {"type": "roughplastic"}},
        {"type": "roughconductor", "alpha": 0.4},
        {"type": "principled", "roughness": 0.4, "base_color": {"type": "rgb", "value": [0.5, 0.3, 0.2]}},
    ],
    ids=lambda bsdf: bsdf["type"],
)
def test_materials(variant: str, bsdf: dict) -> None:
    scene = one_object({"type": "sphere"}, bsdf)
    error = relative_rms(unshadowed.unshadowed(scene, spp=256).image, reference.path_traced(scene, spp=256).image)
    assert error < 0.02


def test_masks_are_looked_through(variant: str) -> None:
    scene = one_object({"type": "rectangle"}, {"type": "mask", "opacity": 0.25, "bsdf": {"type": "diffuse"}})
    whole = one_object({"type": "rectangle"})
    assert reference.has_masks(scene) and not reference.has_masks(whole)
    masked, full = unshadowed.unshadowed(scene, spp=16).image, unshadowed.unshadowed(whole, spp=16).image
    np.testing.assert_allclose(masked, 0.25 * full, rtol=1e-4, atol=1e-5)
    assert reference.path_traced(scene, spp=16).settings["integrator"] == "volpath"


def test_same_seed_same_image_and_error_estimate(variant: str) -> None:
    scene = load("gallery")
    first, again = (reference.path_traced(scene, spp=64, seed=3) for _ in range(2))
    other = reference.path_traced(scene, spp=64, seed=4)
    np.testing.assert_array_equal(first.image, again.image)
    difference = np.sqrt(np.mean((first.image - other.image) ** 2)) / first.image.mean()
    estimate = first.settings["relative_standard_error"] * np.sqrt(2)
    assert 0.7 < difference / estimate < 1.4


def test_lights_one_by_one_is_the_same_integral(variant: str) -> None:
    scene = load("pavilion", 32)
    summed = reference.path_traced(scene, spp=256)
    assert summed.settings["lights"] == "summed"
    whole = np.array(mi.render(scene, spp=4096, integrator=mi.load_dict({"type": "direct"})))
    assert abs(summed.image.mean() - whole.mean()) < 2e-3 * whole.mean()
    # The scene is left as it was found.
    assert all(value == 1.0 for key, value in mi.traverse(scene) if key.endswith(".sampling_weight"))


@pytest.mark.parametrize("half", [False, True])
def test_save_and_load(variant: str, tmp_path: Path, half: bool) -> None:
    made = reference.path_traced(load("pose", 16), spp=4)
    reference.save(tmp_path / "sub" / "image.exr", made, half=half)
    read = reference.load(tmp_path / "sub" / "image.exr")
    np.testing.assert_allclose(read.image, made.image, rtol=5e-4 if half else 0)
    assert read.settings == made.settings
    assert [path.name for path in (tmp_path / "sub").iterdir()] == ["image.exr"]


def test_files_need_no_second_thread(tmp_path: Path) -> None:
    """Mitsuba's own reading and writing waits forever where Dr.Jit has a single one."""
    code = (
        "import sys, shadowmap_dr, drjit as dr, mitsuba as mi, numpy as np; mi.set_variant('llvm_ad_rgb')\n"
        "dr.set_thread_count(1)\n"
        "from mitsuba_baselines import reference\n"
        "reference.save(sys.argv[1], reference.Reference(np.ones((4, 5, 3), np.float32), {'spp': 7}))\n"
        "found = reference.load(sys.argv[1])\n"
        "assert found.image.shape == (4, 5, 3) and (found.image == 1).all() and found.settings == {'spp': 7}\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.exr")], check=True, timeout=120)


def test_errors_name_the_offender(variant: str, tmp_path: Path) -> None:
    with pytest.raises(ShadowmapError, match="[Gg]aussian"):
        reference.path_traced(one_object({"type": "sphere"}, filter_type="gaussian"), spp=1)
    with pytest.raises(ShadowmapError, match="spp is 0"):
        reference.path_traced(load("pose", 8), spp=0)
    with pytest.raises(ShadowmapError, match="path_of_glory"):
        reference.path_traced(load("pose", 8), integrator="path_of_glory")
    with pytest.raises(ShadowmapError, match="none.exr"):
        reference.load(tmp_path / "none.exr")


def test_integrator_follows_the_variant() -> None:
    for name in ("llvm_ad_mono", "llvm_ad_rgb"):
        if name in mi.variants():
            mi.set_variant(name)
            assert "direct_unshadowed" in str(mi.load_dict({"type": "direct_unshadowed"}))


def test_stored_scene_references_can_be_made_again(variant: str) -> None:
    scene = load("pose", cases.RESOLUTION)
    for kind, made in (("direct", reference.path_traced(scene, spp=512)), ("unshadowed", unshadowed.unshadowed(scene, spp=256))):
        stored = reference.load(cases.FOLDER / f"pose_{kind}.exr")
        assert relative_rms(made.image, stored.image) < 0.01
        assert abs(made.image.mean() / stored.image.mean() - 1) < 5e-4


@pytest.mark.parametrize("name", SCENES)
def test_stored_scene_references_are_complete(name: str) -> None:
    mi.set_variant("llvm_ad_rgb")
    for kind in ("direct", "unshadowed"):
        stored = reference.load(cases.FOLDER / f"{name}_{kind}.exr")
        assert stored.image.shape == (cases.RESOLUTION, cases.RESOLUTION, 3)
        assert stored.settings["spp"] >= 512 and stored.settings["filter"] == "box"
        assert stored.settings["relative_standard_error"] < 0.005


@pytest.mark.parametrize("traced", cases.TRACED, ids=lambda traced: traced.name)
def test_stored_derivatives_are_complete(traced: cases.Traced) -> None:
    mi.set_variant("llvm_ad_rgb")
    stored = reference.load(traced.path)
    width, height = traced.build(0.0).sensors()[0].film().size()
    assert stored.image.shape == (height, width, 3)
    assert stored.settings["independent_cosine"] >= 0.995
    assert stored.settings["step"] == traced.changed.step and stored.settings["parameter"] == traced.changed.key


def test_stored_derivatives_are_of_cases_that_exist() -> None:
    assert {traced.path for traced in cases.TRACED} == set(cases.FOLDER.glob("derivative_*.exr"))


@pytest.mark.parametrize(
    "name", ["sun_cow_light_direction", "spot_cow_spot_cone", "orthographic_cow_camera_shift", "standing_box_caster_translation"]
)
def test_stored_derivatives_can_be_made_again(variant: str, name: str) -> None:
    (traced,) = (traced for traced in cases.TRACED if traced.name == name)
    made = derivatives.central_difference(traced.build, traced.changed.step, spp=256, seed=7)
    result = derivatives.agreement(made.image, reference.load(traced.path).image)
    assert result.cosine > 0.995 and abs(result.scale - 1) < 0.02


def test_agreement_measures_direction_and_scale() -> None:
    rng = np.random.default_rng(0)
    image = rng.normal(size=(20, 30, 3))
    assert derivatives.agreement(image, image).cosine == pytest.approx(1)
    half = derivatives.agreement(0.5 * image, image)
    assert half.cosine == pytest.approx(1) and half.scale == pytest.approx(0.5)
    assert derivatives.agreement(-image, image).cosine == pytest.approx(-1)
    # A boundary seen half a pixel away agrees after the blur, one that is ten pixels away does not.
    line = np.zeros((40, 40, 1))
    line[:, 20] = 1
    assert derivatives.agreement(np.roll(line, 1, axis=1), line).cosine > 0.75
    assert derivatives.agreement(np.roll(line, 10, axis=1), line).cosine == pytest.approx(0)
    assert derivatives.agreement(np.roll(line, 10, axis=1), line, filter_footprint=10).cosine > 0.4
    with pytest.raises(ShadowmapError, match="zero everywhere"):
        derivatives.agreement(image, 0 * image)
    with pytest.raises(ShadowmapError, match="shapes"):
        derivatives.agreement(image, image[:5])
