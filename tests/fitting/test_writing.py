"""Files of results that were computed in Python."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import OPTIONS, box, camera, rgb, scene_of

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import FitResult, Own, SceneChange, fit, make_target, read_fit, write_fit
from shadowmap_dr.jit.types import Float

FILM = {"width": 24, "height": 18}
FILES = {"fit.json", "report.html", "film.webp", "scene.xml", "scene.glb"}
XML = """<scene version="3.0.0">
    <!-- The box is small. -->
    <default name="fov" value="45"/>
    <sensor type="perspective" id="camera">
        <float name="fov" value="$fov"/>
        <transform name="to_world"><lookat origin="2, -3, 4" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="24"/><integer name="height" value="18"/></film>
    </sensor>
    <shape type="cube" id="box"><transform name="to_world"><scale value="0.4"/><translate z="0.5"/></transform></shape>
    <shape type="rectangle" id="floor"><transform name="to_world"><scale value="4"/></transform></shape>
    <emitter type="directional" id="sun"><vector name="direction" value="0.4, 0.3, -1"/></emitter>
</scene>
"""


@pytest.fixture(autouse=True)
def one_backend() -> None:
    mi.set_variant("llvm_ad_rgb")


def rail(numbers: list[Float], change: SceneChange) -> None:
    (way,) = numbers
    change.move(["box"], mi.Matrix4f([1, 0, 0, way], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]))


def quick(scene: Any, vary: Any, **options: Any) -> FitResult:
    picture = Renderer.from_file(SCENE[0]).render(transforms={"box": mi.Transform4f().translate([0.3, 0, 0])}, spp=16)
    return fit(scene, np.array(picture), vary, starts=1, **options)


SCENE: list[Path] = []


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "box.xml"
    path.write_text(XML)
    SCENE[:] = [path]
    return path


def test_a_fit_of_a_file_is_written_as_a_scene(scene_file: Path, tmp_path: Path) -> None:
    """Of poses, and of a parametrisation of the user's."""
    for k, vary in enumerate(["box:translation:x", Own("rail", rail, [0.0], 0.4)]):
        out = tmp_path / f"out{k}"
        result = quick(scene_file, vary)
        written = write_fit(result, out)
        assert FILES <= {path.name for path in written} and all(path.is_file() for path in written)
        assert read_fit(out / "fit.json").found == result.found
        assert "<!-- The box is small. -->" in (out / "scene.xml").read_text()
        loaded = mi.load_file(str(out / "scene.xml"), optimize=False)
        moved = np.array(mi.traverse(loaded)["box.vertex_positions"]).reshape(-1, 3).mean(0)
        np.testing.assert_allclose(moved, [result.estimates[0].values[0], 0, 0.5], atol=1e-4)
        assert result.estimates[0].values[0] == pytest.approx(0.3, abs=0.02)


def test_renderers_know_their_file_or_dictionary(scene_file: Path, tmp_path: Path) -> None:
    """And the file its parameters."""
    result = quick(Renderer.from_file(scene_file, {"fov": "50"}, **OPTIONS), "box:translation:x")
    assert FILES <= {path.name for path in write_fit(result, tmp_path / "file")}
    loaded = mi.load_file(str(tmp_path / "file" / "scene.xml"))
    assert mi.traverse(loaded.sensors()[0])["x_fov"][0] == pytest.approx(50)
    described = {
        "type": "scene",
        "camera": camera(film=FILM),
        "box": box(0),
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": rgb(2, 1.5, 1)},
    }
    result = quick(Renderer.from_dict(described, **OPTIONS), "sun:brightness")
    write_fit(result, tmp_path / "dictionary")
    loaded = mi.load_file(str(tmp_path / "dictionary" / "scene.xml"), optimize=False)
    factor = result.estimates[0].values[0]
    irradiance = np.array(mi.traverse(loaded)["sun.irradiance.value"]).ravel()
    np.testing.assert_allclose(irradiance, factor * np.array([2, 1.5, 1]), rtol=1e-4)


def test_the_file_of_a_scene_that_was_given_must_be_named(scene_file: Path, tmp_path: Path) -> None:
    result = quick(mi.load_file(str(scene_file), optimize=False), "box:translation:x")
    with pytest.warns(UserWarning, match="give it as scene="):
        written = {path.name for path in write_fit(result, tmp_path / "without")}
    assert written == {"fit.json", "report.html", "film.webp"}
    assert FILES <= {path.name for path in write_fit(result, tmp_path / "with", scene_file)}


def test_a_result_that_was_read_has_no_scene(scene_file: Path, tmp_path: Path) -> None:
    write_fit(quick(scene_file, "box:translation:x"), tmp_path / "first")
    with pytest.warns(UserWarning, match="the fitted scene was not written"):
        written = write_fit(read_fit(tmp_path / "first" / "fit.json"), tmp_path / "second")
    assert {path.name for path in written} == {"fit.json", "report.html"}


def test_pictures_carry_known_exposures(scene_file: Path, tmp_path: Path) -> None:
    image = np.array(Renderer.from_file(scene_file).render(spp=16))
    brighter = fit(scene_file, [make_target(2 * image, exposure=2)], "sun:brightness", starts=1)
    np.testing.assert_allclose(brighter.estimates[0].values, 1, rtol=0.02)
    for exposure in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(ShadowmapError, match="the target: exposure is .*; give a positive number"):
            make_target(image, exposure=exposure)


def test_scenes_of_fits_are_those_of_the_pictures() -> None:
    """A scene has no file: the result holds the changes."""
    result = fit(scene_of(camera=camera(film=FILM)), np.full((18, 24, 3), 0.3), "sun:brightness", starts=1, resolution=16)
    assert (
        result.scene is not None and result.scene.source is None and list(result.scene.changes.values) == ["sun.irradiance.value"]
    )
