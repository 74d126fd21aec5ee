"""The command `shadowmap-dr fit`: its files, its list, and what it refuses, in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.fitting.result import read_fit
from shadowmap_dr.io.images import to_srgb

ROOM = """<scene version="3.0.0">
    <!-- A box on a floor. -->
    <default name="height" value="36"/>
    <integrator type="direct"/>
    <sensor type="perspective" id="camera">
        <float name="fov" value="45"/>
        <transform name="to_world"><lookat origin="2, -3, 4" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="48"/>
            <integer name="height" value="$height"/>
            <rfilter type="box"/>
            <string name="pixel_format" value="rgb"/>
        </film>
    </sensor>
    <emitter type="directional" id="sun">
        <vector name="direction" x="0.4" y="0.3" z="-1"/>
        <rgb name="irradiance" value="2.0, 1.5, 1.0"/>
    </emitter>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf>
    </shape>
    <shape type="cube" id="box">
        <transform name="to_world">
            <scale x="0.45" y="0.3" z="0.4"/><rotate x="1" angle="20"/><translate x="X" z="0.5"/>
        </transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.5, 0.3"/></bsdf>
    </shape>
</scene>
"""
SHORT = ("--starts", "2", "--spp", "1", "--resolution", "32")
FILES = {"fit.json", "fit.toml", "film.webp", "report.html", "scene.glb", "scene.xml"}


def rendered(path: Path) -> np.ndarray:
    mi.set_variant("llvm_ad_rgb")
    scene = mi.load_file(str(path))
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=32))[..., :3]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a photograph of the box 0.25 beside its place, and a mask of its lower half."""
    folder = tmp_path_factory.mktemp("pictures")
    (folder / "true.xml").write_text(ROOM.replace("X", "0.25"))
    image = rendered(folder / "true.xml")
    Image.fromarray(np.round(255 * to_srgb(image)).astype(np.uint8)).save(folder / "photo.png")
    mask = np.zeros(image.shape[:2], np.uint8)
    mask[18:] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    return folder


@pytest.fixture(autouse=True)
def room(tmp_path: Path, pictures: Path) -> None:
    """The scene, with its box in the wrong place, and the pictures, in the folder in which the program runs."""
    (tmp_path / "room.xml").write_text(ROOM.replace("X", "0"))
    for name in ("photo.png", "mask.png"):
        (tmp_path / name).write_bytes((pictures / name).read_bytes())


def test_a_fit_writes_its_files(run: Any, tmp_path: Path) -> None:
    """And the fitted scene is nearer to the picture; fit.toml is the same fit again."""
    result = run("fit", "room.xml", "--target", "photo.png", "--vary", "box:translation:x", *SHORT, "--out", "results")
    assert result.status == 0, result.err
    assert "box:translation:x" in result.out and "Found, in " in result.out
    out = tmp_path / "results"
    assert {path.name for path in out.iterdir()} == FILES
    assert all((out / name).stat().st_size > 100 for name in FILES)
    found = read_fit(out / "fit.json")
    assert found.found and found.estimates[0].values == pytest.approx([0.25], abs=0.02)
    assert found.command.startswith("shadowmap-dr fit room.xml --target photo.png")
    target = rendered(tmp_path / "room.xml")
    true = np.asarray(Image.open("photo.png"))
    start, end = (np.abs(to_srgb(image) - true / 255).mean() for image in (target, rendered(out / "scene.xml")))
    assert end < 0.2 * start
    assert "<!-- A box on a floor. -->" in (out / "scene.xml").read_text()
    assert (out / "scene.glb").read_bytes()[:4] == b"glTF" and (out / "film.webp").read_bytes()[8:12] == b"WEBP"
    assert "box:translation:x" in (out / "report.html").read_text()
    again = run("fit", "results/fit.toml", "--out", "again")
    assert again.status == 0, again.err
    second = read_fit(tmp_path / "again" / "fit.json")
    np.testing.assert_allclose(second.estimates[0].values, found.estimates[0].values, atol=2e-3)
    assert json.dumps(second.settings["vary"]) == json.dumps(found.settings["vary"])


def test_options_come_before_those_of_a_file(run: Any, tmp_path: Path) -> None:
    """Masks, pictures of numbered sensors, parameters of the scene."""
    (tmp_path / "fit.toml").write_text(
        'scene = "room.xml"\nvary = ["box:translation:x"]\nstarts = 1\nspp = 1\nresolution = 32\n'
        '[[target]]\nfile = "photo.png"\nmask = "mask.png"\n[parameters]\nheight = 30\n'
    )
    result = run("fit", "fit.toml", "--vary", "sun:brightness", "-D", "height=36", "--exposure")
    assert result.status == 0, result.err
    found = read_fit(tmp_path / "fit" / "fit.json")
    assert [each.kind for each in found.estimates] == ["value", "exposure"] and found.estimates[0].name == "sun:brightness"
    assert found.settings["parameters"] == {"height": "36"} and found.settings["exposure"] and found.settings["starts"] == 1
    assert found.settings["target"][0]["mask"].endswith("mask.png")
    # There is no other light.
    assert "cannot be told apart" in result.out


def test_the_list_names_all_that_can_vary(run: Any, tmp_path: Path) -> None:
    """Also shapes of one material, which Mitsuba would merge."""
    posts = "".join(
        f'<shape type="cube" id="{name}"><ref id="stone"/><transform name="to_world"><scale value="0.2"/>'
        f'<translate x="{x}" y="1" z="0.2"/></transform></shape>'
        for name, x in (("left_post", -1), ("right_post", 1))
    )
    more = f'<bsdf type="diffuse" id="stone"/>{posts}</scene>'
    (tmp_path / "room.xml").write_text(ROOM.replace("X", "0").replace("</scene>", more))
    result = run("fit", "room.xml", "--list")
    assert result.status == 0, result.err
    words = " ".join(result.out.split())
    names = ("box", "floor", "left_post", "right_post", "sun", "camera", "sun.irradiance.value", "box.bsdf.reflectance.value")
    for name in (*names, "pose, rotation, translation, scale, vertices", "direction", "%"):
        assert name in words, name
    assert not (tmp_path / "fit").exists()


def test_the_list_has_chosen_entries_alone(run: Any, tmp_path: Path) -> None:
    (tmp_path / "room.xml").write_text(ROOM.replace("X", "0"))
    result = run("fit", "room.xml", "--list", "--vary", "box:translation:x", "--vary", "sun.irradiance")
    assert result.status == 0, result.err
    words = " ".join(result.out.split())
    assert "box translation" in words and "sun.irradiance.value value" in words and words.count("%") >= 2
    assert "reflectance" not in words and "floor" not in words
    wrong = run("fit", "room.xml", "--list", "--vary", "bix:pose")
    assert wrong.status != 0 and "bix" in wrong.err and not wrong.out


TARGET, LONG = ("--target", "photo.png"), 5000 * "x"
BAD: list[tuple[tuple[str, ...], str]] = [
    (("room.xml", *TARGET), "nothing varies: name something by --vary; --list lists all"),
    (("room.xml", "--vary", "sun"), "there is no picture to fit to: give one by --target"),
    (("room.xml", "--vary", "sun", "--target", "none.png"), "none.png"),
    (("room.xml", "--vary", "sun", "--target", "folder"), "no image 'folder': it is a folder; give a file"),
    (("room.xml", "--vary", "sun", "--target", "room.xml"), "room.xml"),
    (("room.xml", "--vary", "sun", "--target", "square.png"), "square.png has 40 x 40 pixels, sensor 0 has 48 x 36"),
    (("room.xml", "--vary", "sun", "--target", "1=photo.png"), "is of sensor 1, but the scene has 1, counted from 0"),
    (("room.xml", "--vary", "sun", "--target", ""), "--target '': write FILE or N=FILE"),
    (("room.xml", "--vary", "sun", *TARGET, "--mask", "none.png"), "none.png"),
    (("room.xml", "--vary", "sun", *TARGET, "--mask", "square.png"), "square.png has 40 x 40 pixels"),
    (("room.xml", "--vary", "sun", *TARGET, "--mask", "1=mask.png"), "there is no --target of sensor 1"),
    (("room.xml", "--vary", "sun", *TARGET, "--mask", "mask.png", "--mask", "mask.png"), "sensor 0 has a mask already"),
    (("room.xml", "--vary", "snu", *TARGET), "no object or value 'snu'; --list lists all. Did you mean 'sun'?"),
    (("room.xml", "--vary", "sun:fov", *TARGET), "'sun' is a DirectionalLight and has the kinds direction, brightness"),
    (("room.xml", "--vary", "sun:directoin", *TARGET), "Did you mean 'direction'?"),
    (("room.xml", "--vary", "sun,min=x", *TARGET), "min is 'x'; give a number"),
    (("room.xml", "--vary", "sun", "--vary", "sun", *TARGET), "vary sun is given twice"),
    (("room.xml", "--vary", "sun", *TARGET, "--exposure", "--white-balance"), "leave exposure out"),
    (("room.xml", "--vary", "sun", *TARGET, "--starts", "0"), "starts"),
    (("room.xml", "--vary", "sun", *TARGET, "--delta", "0"), "delta of the loss is 0.0: give a positive number"),
    (("room.xml", "--vary", "sun", *TARGET, "--loss", "hubr"), "Did you mean 'huber'?"),
    (("room.xml", "--vary", "sun", *TARGET, "-D", "height"), "-D height: write it as NAME=VALUE"),
    (("none.xml", "--vary", "sun", *TARGET), "none.xml"),
    (("photo.png", "--vary", "sun", *TARGET), "photo.png is a picture: give a Mitsuba scene"),
    (("none.toml", "--vary", "sun", *TARGET), "none.toml"),
    (("bad.toml",), "bad.toml: there is no key 'strats'. Did you mean 'starts'?"),
    (
        ("room.xml", "--vary", "sun", *TARGET, "--out", "photo.png"),
        "cannot write into photo.png: photo.png is a file; give another folder",
    ),
    (("room.xml", "--vary", "sun", *TARGET, "-D", "height=0"), "The film of sensor 'camera' has 48 x 0 pixels"),
    (("room.xml", "--vary", "sun", "--target", f"{5000 * '9'}=photo.png"), "no scene has so many sensors"),
    (("room.xml", "--vary", "box:scale,max=-1", *TARGET), "vary box:scale: the bounds leave nothing between 0 and -1"),
    (("room.xml", "--vary", "box:scale,spread=1e9", *TARGET), "spread is 1e+09, a factor here: give one from 1 to 1e+06"),
    (("room.xml", "--vary", "box:vertices,min=0", *TARGET), "vary box:vertices: vertices have no min: leave it out"),
    (("room.xml", "--vary", LONG, *TARGET), "the scene has no object or value 'x"),
    (("room.xml", "--vary", f"sun:{LONG}", *TARGET), "choose from pose"),
    (("room.xml", "--vary", "sun", "--target", LONG), "the file does not exist"),
    (("room.xml", "--vary", "sun", "--target", "/".join(LONG)), "the file does not exist"),
    (("room.xml", "--vary", "sun", *TARGET, "--mask", LONG), "the file does not exist"),
    (("room.xml", "--vary", "sun", *TARGET, "--mask", "mask.png", "--mask", LONG), "sensor 0 has a mask already"),
    (("room.xml", "--vary", "sun", *TARGET, "--loss", LONG), "choose huber, l2 or l1"),
    (("room.xml", "--vary", "sun", *TARGET, "-D", LONG), "write it as NAME=VALUE"),
    (("room.xml", "--vary", "sun", *TARGET, "-D", f"{LONG}=1"), "unused parameters"),
    (("room.xml", "--vary", "sun", *TARGET, "--out", LONG), "File name too long"),
    (("room.xml", "--vary", "sun", *TARGET, "--variant", LONG), "no variant 'x"),
    ((LONG, "--vary", "sun", *TARGET), "give a file that exists"),
    ((f"{LONG}.toml",), "no file 'x"),
    (("folder.toml",), "no file 'folder.toml': it is a folder"),
    (("long.toml",), "long.toml: there is no key 'x"),
]


@pytest.mark.parametrize("arguments", [(f"--{LONG}",), (LONG,), ("--starts", LONG), (f"--no-{LONG}",), ("--exposure=" + LONG,)])
def test_wrong_usage_is_one_short_line(run: Any, arguments: tuple[str, ...]) -> None:
    result = run("fit", "room.xml", *arguments)
    (line,) = (line for line in result.err.splitlines() if line.startswith("error: "))
    assert result.status == 2 and len(line) <= 600


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=lambda value: " ".join(value)[:80] if isinstance(value, tuple) else "")
def test_bad_input_is_one_line(run: Any, tmp_path: Path, arguments: tuple[str, ...], words: str) -> None:
    for name in ("folder", "folder.toml"):
        (tmp_path / name).mkdir()
    (tmp_path / "bad.toml").write_text("scene = 'room.xml'\nstrats = 3")
    (tmp_path / "long.toml").write_text(f"scene = 'room.xml'\n{LONG} = 3")
    Image.fromarray(np.full((40, 40, 3), 128, np.uint8)).save(tmp_path / "square.png")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    result = run("fit", *arguments)
    assert result.status == 1 and result.err.count("\n") == 1 and result.err.startswith("error: "), result.err
    assert words in result.err and len(result.err) <= 402, result.err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert not (tmp_path / "fit").exists()


def test_damaged_states_end_in_one_line(run: Any, tmp_path: Path) -> None:
    (tmp_path / "fit").mkdir()
    (tmp_path / "fit" / "fit.npz").write_bytes(b"PK")
    result = run("fit", "room.xml", *TARGET, "--vary", "sun:direction", *SHORT, "--resume")
    assert result.status == 1 and result.err.count("\n") == 1, result.err
    assert "cannot read the checkpoint fit/fit.npz" in result.err
    assert [path.name for path in (tmp_path / "fit").iterdir()] == ["fit.npz"]
    assert (tmp_path / "fit" / "fit.npz").read_bytes() == b"PK"
