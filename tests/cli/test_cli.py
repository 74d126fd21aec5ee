"""The command line program: what it prints and writes, and one clear line with a non-zero status on bad input."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from pose_runs import build

from shadowmap_dr import __version__
from shadowmap_dr.cli import gradients, lights, main, maps, soft
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.pose import experiment
from shadowmap_dr.io import images
from shadowmap_dr.rendering.film.aovs import AOVS


def program(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    code = "from shadowmap_dr.cli.main import main; main()"
    return subprocess.run([sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True, **options)


def test_info(run: Any) -> None:
    result = run("info")
    assert result.status == 0
    for entry in ("shadowmap_dr", "mitsuba", "drjit", "LLVM version", "LLVM library", "llvm_ad_rgb", "threads", "GPU"):
        assert entry in result.out


def test_help_names_the_commands(run: Any) -> None:
    result = run("--help")
    assert result.status == 0
    for command in ("info", "render", "pose", "bench", "soft", "art"):
        assert command in result.out
    assert run().status == 2


def test_commands_come_in_the_order_of_their_use(run: Any) -> None:
    listed = [line.split()[0] for line in run("-h").out.partition("Commands:")[2].splitlines() if line.strip()]
    assert listed == "render import fit pose lights art face model soft maps gradients bench lights-times info".split()
    assert list(main.COMMANDS) == listed


@pytest.mark.parametrize(
    "arguments", [(), ("pose",), ("render",), ("gradients",), ("gradients", "jacobian"), ("face", "convert")]
)
def test_short_help(run: Any, arguments: tuple[str, ...]) -> None:
    short, long = run(*arguments, "-h"), run(*arguments, "--help")
    assert short.status == 0 and short.out == long.out and "-h, --help" in short.out and "--quiet" in short.out
    assert "<list[" not in short.out


def test_version(run: Any) -> None:
    result = run("--version")
    assert result.status == 0 and result.out == f"shadowmap-dr {__version__}\n"


@pytest.mark.parametrize(
    ("arguments", "error", "command"),
    [
        (["poes"], "No such command 'poes'. Did you mean 'pose'?", "shadowmap-dr"),
        (["grad"], "No such command 'grad'. Did you mean 'gradients'?", "shadowmap-dr"),
        (["zzz"], "No such command 'zzz'.", "shadowmap-dr"),
        (["gradients", "jacobain"], "No such command 'jacobain'. Did you mean 'jacobian'?", "shadowmap-dr gradients"),
        (["pose", "--resolutoin", "3"], "No such option '--resolutoin'. Did you mean '--resolution'?", "shadowmap-dr pose"),
        (["--verison"], "No such option '--verison'. Did you mean '--version'?", "shadowmap-dr"),
    ],
)
def test_wrong_usage_names_the_nearest_word(run: Any, arguments: list[str], error: str, command: str) -> None:
    result = run(*arguments)
    assert result.status == 2
    usage, message, hint = result.err.splitlines()
    assert usage.startswith(f"Usage: {command} [OPTIONS]")
    assert message == f"error: {error}" and hint == f"Try '{command} --help' for help."


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (["soft", "--scene", "dsk"], "dusk"),
        (["pose", "--method", "shadow"], "shadows"),
        (["pose", "--object", "spt"], "spot"),
        (["pose", "--variant", "llvm_ad_rbg"], "llvm_ad_rgb"),
        (["maps", "--method", "vms"], "vsm"),
        (["bench", "--only", "step"], "steps"),
        (["art", "--target", "hart"], "heart"),
        (["art", "--text", "A", "--camera", "ortho"], "orthographic"),
        (["face", "--mode", "ident"], "identity"),
        (["gradients", "convergence", "--occluder", "rings"], "ring"),
        (["model", "sphere", "--view", "frnt"], "front"),
        (["render", "psoe", "-o", "a.png"], "pose"),
        (["render", "pose", "-o", "a.exr", "--aovs", "dept"], "depth"),
    ],
)
def test_values_out_of_a_list_name_the_nearest(run: Any, arguments: list[str], found: str) -> None:
    result = run(*arguments)
    assert result.status == 1 and result.err.count("\n") == 1 and f"Did you mean '{found}'?" in result.err, result.err


def test_without_words_the_help_is_shown(run: Any) -> None:
    for arguments in ((), ("gradients",)):
        result = run(*arguments)
        assert result.status == 2 and result.err.startswith("Usage: shadowmap-dr") and "error:" not in result.err
        assert "Commands:" in result.err


def warns(*_: Any, **__: Any) -> None:
    warnings.warn("the film is small", stacklevel=1)
    mi.Log(mi.LogLevel.Warn, "the sampler is slow")
    raise ShadowmapError("no film.")


@pytest.mark.parametrize("place", ["before", "after"])
@pytest.mark.parametrize("level", ["--quiet", "", "--verbose"])
def test_amounts_of_text(run: Any, monkeypatch: pytest.MonkeyPatch, level: str, place: str) -> None:
    """Warnings are lines without files of libraries; --verbose adds versions, origins and a traceback, --quiet leaves errors."""
    monkeypatch.setattr(experiment, "run_pose", warns)
    words = [level] if level else []
    result = run(*words, "pose") if place == "before" else run("pose", *words)
    lines = result.err.splitlines()
    assert result.status == 1 and result.out == "" and lines[-1] == "error: no film."
    if level == "--quiet":
        assert len(lines) == 1
    elif not level:
        assert lines == ["warning: the film is small", "warning: Mitsuba: warns(): the sampler is slow", lines[-1]]
    else:
        assert lines[0].startswith(f"shadowmap-dr {__version__}, mitsuba {mi.__version__}, drjit ")
        assert lines[1].startswith("warning: the film is small (UserWarning, ") and "test_cli.py" in lines[1]
        assert "Traceback (most recent call last):" in lines


def test_verbose_commands_tell_their_time(run: Any) -> None:
    assert run("info", "-v").err.splitlines()[-1].endswith(" seconds")
    assert run("info").err == run("info", "-q").err == ""


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cow.ply", "cow.ply is a model, and no scene of Mitsuba's: .*: shadowmap-dr import cow.ply -o cow.xml"),
        ("cow.obj", "cow.obj is a model, .*: shadowmap-dr import cow.obj -o cow.xml"),
        ("cow.glb", "cow.glb is a model, .*: shadowmap-dr import cow.glb -o cow.xml"),
        ("cow.fbx", "cow.fbx is a model, .*: convert it to .glb or .ply"),
        ("cow.png", "cow.png is a picture: give a Mitsuba scene"),
        ("notes.txt", "notes.txt is no XML: give a Mitsuba scene"),
        ("folder", "no scene 'folder': it is a folder; give a file in it .room.xml."),
        ("folder/rom.xml", "no scene 'folder/rom.xml': there is no such file. Did you mean 'folder/room.xml'?"),
        ("zzz.xml", "no scene 'zzz.xml': give a file that exists, or one of curtain, gallery"),
    ],
)
def test_what_is_no_scene(run: Any, tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "folder").mkdir()
    for written in ("cow.ply", "cow.obj", "cow.glb", "cow.fbx", "cow.png", "notes.txt", "folder/room.xml"):
        (tmp_path / written).write_text("what it is")
    result = run("render", name, "-o", "a.png")
    assert result.status == 1 and result.err.count("\n") == 1 and re.search(message, result.err), result.err
    assert not (tmp_path / "a.png").exists()


def test_channels_are_listed_in_the_help(run: Any) -> None:
    words = " ".join(run("render", "--help").out.split())
    assert ", ".join(AOVS) in words and "d:depth,n:sh_normal" in words


def test_render_exr_equals_mitsuba(run: Any, tmp_path: Path) -> None:
    result = run("render", "pose", "-o", "a.exr", "-D", "resolution=24", "--integrator", "direct", "--spp", "4", "--seed", "3")
    assert result.status == 0, result.err
    channels, metadata = images.read_exr("a.exr")
    assert list(channels) == ["B", "G", "R"] and metadata["shadowmap_dr:integrator"] == "direct"
    from shadowmap_dr.io import assets

    scene = mi.load_file(str(assets.scene("pose")), resolution="24")
    expected = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=4, seed=3))
    np.testing.assert_allclose(images.read_image("a.exr"), expected, atol=1e-6)
    assert os.listdir(tmp_path) == ["a.exr"]


def test_render_with_shadow_maps_and_further_channels(run: Any) -> None:
    aovs = "depth,position,normal,shape_index,prim_index,visibility"
    result = run("render", "pose", "-o", "a.exr", "--size", "24x16", "--aovs", aovs)
    assert result.status == 0, result.err
    channels, metadata = images.read_exr("a.exr")
    assert {"R", "G", "B", "depth", "position.X", "normal.Z", "shape_index", "visibility.light"} <= set(channels)
    assert all(pixels.shape == (16, 24) for pixels in channels.values())
    assert metadata["shadowmap_dr:integrator"] == "shadowmap"


def test_render_png_in_another_size(run: Any) -> None:
    result = run("render", "pose", "-o", "sub/a.png", "--size", "30x20", "--integrator", "scene", "--spp", "1")
    assert result.status == 0, result.err
    assert Image.open("sub/a.png").size == (30, 20)


def test_render_further_channels(run: Any) -> None:
    arguments = ("render", "pose", "-D", "resolution=8", "--integrator", "scene", "--aovs", "d:depth,n:sh_normal", "--spp", "1")
    assert run(*arguments, "-o", "a.exr").status == 0
    channels, _ = images.read_exr("a.exr")
    assert set(channels) == {"R", "G", "B", "d.T", "n.X", "n.Y", "n.Z"}
    result = run(*arguments, "-o", "a.png")
    assert result.status == 1 and ".exr" in result.err


RENDER = ["render", "pose", "-D", "resolution=8", "--integrator", "direct", "--spp", "1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "nowhere.xml", "-o", "a.exr"], "nowhere.xml"),
        (["render", ".", "-o", "a.exr"], "no scene '.'"),
        (["render", "broken.xml", "-o", "a.exr"], "broken.xml"),
        (["render", "bsdf.xml", "-o", "a.exr"], "bsdf.xml"),
        (["render", "pose"], "--output"),
        (["render", "pose", "-o", "a.jpg"], "'.jpg'"),
        (["render", "pose", "-o", "a"], ".exr, .png"),
        (["render", "pose", "-o", "broken.xml/a.exr"], "broken.xml/a.exr"),
        (["render", "pose", "-o", "/proc/nowhere/a.exr"], "/proc/nowhere/a.exr"),
        ([*RENDER, "-o", "a.exr", "-D", "resolution"], "NAME=VALUE"),
        ([*RENDER, "-o", "a.exr", "-D", "=3"], "NAME=VALUE"),
        ([*RENDER, "-o", "a.exr", "-D", "resolution=9"], "has a value already"),
        ([*RENDER, "-o", "a.exr", "-D", "height=9"], "height"),
        ([*RENDER, "-o", "a.exr", "-D", "height=nan"], "finite"),
        (["render", "pose", "-o", "a.exr", "-D", "resolution=0", "--integrator", "direct"], "0 x 0 pixels"),
        (["render", "pose", "-o", "a.exr", "-D", "resolution=x"], "x"),
        (["render", "pose", "-o", "a.exr", "-D", "object=nowhere.ply"], "nowhere.ply"),
        ([*RENDER, "-o", "a.exr", "--size", "0x8"], "0x8"),
        ([*RENDER, "-o", "a.exr", "--size", "8"], "WxH"),
        ([*RENDER, "-o", "a.exr", "--size", "-8x8"], "WxH"),
        ([*RENDER, "-o", "a.exr", "--spp", "0"], "--spp"),
        ([*RENDER, "-o", "a.exr", "--integrator", "magic"], "--integrator magic: there is no such plug-in"),
        ([*RENDER, "-o", "a.exr", "--integrator", "volpth"], "no such plug-in. Did you mean 'volpath'?"),
        ([*RENDER, "-o", "a.exr", "--aovs", "depth"], "NAME:TYPE"),
        ([*RENDER, "-o", "a.exr", "--aovs", "d:magic"], "magic"),
        ([*RENDER, "-o", "a.exr", "--variant", "magic"], "magic"),
        (["render", "pose", "-o", "a.exr", "--aovs", "magic"], "error: --integrator shadowmap: There is no AOV 'magic'"),
        (["render", "pose", "-o", "a.exr", "--variant", "llvm_ad_spectral"], "llvm_ad_spectral"),
        (["render", "pose", "-o", "a.exr", "--size", "5000x10"], "4096"),
        (["render", "empty.xml", "-o", "a.exr"], "nothing to render in the scene: it has no shapes"),
        (["render", "bad_light.xml", "-o", "a.exr", "--integrator", "direct"], "not finite"),
        (["pose", "--object", "cow"], "cow"),
        (["pose", "--resolution", "0"], "0"),
        (["pose", "--resolution", "x"], "--resolution"),
        (["pose", "--runs", "0"], "--runs) is 0"),
        (["pose", "--iterations", "0"], "--iterations) is 0"),
        (["pose", "--seed", "-1"], "-1"),
        (["pose", "--method", "magic"], "magic"),
        (["pose", "--reference", "photo"], "photo"),
        (["pose", "--out", "broken.xml"], "broken.xml"),
        (["bench", "--only", "magic"], "magic"),
        (["bench", "--out", "bench.txt"], "'.txt'"),
        (["bench", "--out", "broken.xml/b.json"], "broken.xml/b.json"),
        (["bench", "--out", "list.json"], "list.json is no record of a benchmark"),
        (["bench", "--mitsuba-seconds", "0"], "--mitsuba-seconds 0"),
        (["bench", "--mitsuba-seconds", "x"], "--mitsuba-seconds"),
        (["bench", "--variant", "magic"], "magic"),
        (["soft", "--scene", "moon"], "moon"),
        (["soft", "--samples", "64"], "--samples 64"),
        (["soft", "--resolution", "0"], "from 8 to"),
        (["soft", "--reference-spp", "0"], "from 16 to"),
        (["soft", "--variant", "llvm_ad_mono"], "choose one of llvm_ad_rgb"),
        (["maps", "--variant", "llvm_ad_spectral"], "choose one of llvm_ad_rgb"),
        (["art", "--text", "A", "--map-resolution", "0"], "--map-resolution) is 0"),
        (["art", "--text", "A", "--variant", "scalar_rgb"], "scalar_rgb"),
        (["face", "--variant", "llvm_ad_mono"], "llvm_ad_mono"),
        (["gradients", "jacobian", "--spp", "0"], "from 2 to"),
        (["lights", "--runs", "0"], "--runs) is 0"),
        (["lights", "--filter-size", "0"], "--filter-size is 0"),
        (["lights", "--filter-size", "5", "--no-shadows"], "--no-shadows"),
        (["lights", "--variant", "scalar_rgb"], "choose one of llvm_ad_rgb, llvm_ad_mono"),
        (["lights-times", "--out", "broken.xml/x"], "broken.xml"),
        (["pose", "--threads", "-3"], "-3 threads"),
        (["magic"], "magic"),
        (["info", "--magic"], "--magic"),
    ],
)
def test_bad_input_is_one_clear_line(run: Any, tmp_path: Path, arguments: list[str], message: str) -> None:
    (tmp_path / "broken.xml").write_text("<scene")
    (tmp_path / "list.json").write_text("[]")
    (tmp_path / "bsdf.xml").write_text('<bsdf version="3.0.0" type="diffuse"/>')
    (tmp_path / "bad_light.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>'
        '<integer name="height" value="4"/></film></sensor>'
        '<emitter type="constant"><rgb name="radiance" value="nan"/></emitter></scene>'
    )
    (tmp_path / "empty.xml").write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm"><integer name="width" value="4"/>'
        '<integer name="height" value="4"/></film></sensor></scene>'
    )
    result = run(*arguments)
    assert result.status in (1, 2)
    lines = result.err.strip().splitlines()
    if result.status == 2:  # wrong usage: the error stands between the usage and the way to the help
        assert len(lines) == 3 and lines[0].startswith("Usage: shadowmap-dr ") and lines[2].startswith("Try 'shadowmap-dr ")
        lines = lines[1:2]
    assert len(lines) == 1 and lines[0].startswith("error: ") and message in lines[0]
    assert not (tmp_path / "a.exr").exists()


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_full_disk_behind_the_standard_output(unbuffered: str) -> None:
    with open("/dev/full", "w") as full:
        result = program("info", stdout=full, env={**os.environ, "PYTHONUNBUFFERED": unbuffered})
    assert result.returncode == 1
    assert result.stderr.strip().splitlines() == ["error: [Errno 28] No space left on device"]


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_has_gone(unbuffered: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as pipe:
        result = program("info", stdout=pipe, env={**os.environ, "PYTHONUNBUFFERED": unbuffered})
    assert result.returncode == 1 and result.stderr == ""


def test_interrupts_within_recordings_are_interrupts(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Dr.Jit makes an error of its own of Ctrl-C."""

    def interrupted(*_: Any, **__: Any) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise RuntimeError("FlatVariables::...") from error

    monkeypatch.setattr(experiment, "run_pose", interrupted)
    result = run("pose", "--out", "o")
    assert result.status == 130 and result.err == "error: interrupted\n"


def test_full_disk_behind_the_image(tmp_path: Path) -> None:
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))\nfrom shadowmap_dr.cli.main import main; main()"
    )
    arguments = ["render", "pose", "-o", str(tmp_path / "a.exr"), "--integrator", "direct", "--spp", "4"]
    result = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert result.returncode == 1 and result.stderr.splitlines()[-1].startswith("error: cannot write")
    assert os.listdir(tmp_path) == []


def test_pose_prints_a_table_and_writes_records(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_with_fakes(options: Any) -> Any:
        return original(options, build=build)

    original = experiment.run_pose
    monkeypatch.setattr(experiment, "run_pose", run_with_fakes)
    monkeypatch.setenv("COLUMNS", "120")
    arguments = ("pose", "--resolution", "8", "--method", "shadows", "--iterations", "2", "--reference", "own", "--out", "o")
    result = run(*arguments)
    assert result.status == 0, result.err
    assert "spot" in result.out and "shadows" in result.out
    assert len(json.loads(Path("o/pose.json").read_text())["runs"]) == 1
    assert result.out.splitlines()[-1] == "Picture: o/spot-8-vertex-normals/pose.png, record: o/pose.json"
    assert Path("o/spot-8-vertex-normals/pose.png").is_file()


def test_bench_prints_a_table_and_writes_a_record(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from bench_sizes import TINY

    from shadowmap_dr.experiments.bench import common as bench_common

    monkeypatch.setattr(bench_common, "QUICK", TINY)
    result = run("bench", "--quick", "--only", "breakdown", "--out", "o/b.json")
    assert result.status == 0, result.err
    assert "frozen" in result.out and result.out.splitlines()[-1] == "Picture: o/b.png, record: o/b.json"
    assert list(json.loads(Path("o/b.json").read_text())["sections"]) == ["breakdown"]
    assert Path("o/b.png").exists()


def test_gradients(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options reach the experiments; the tables and the reading are shown."""
    seen: list[Any] = []

    def fake(name: str, record: Any) -> Any:
        def call(options: Any) -> Any:
            seen.append(options)
            options.out.mkdir(exist_ok=True)
            (options.out / f"{name}.md").write_text("# Title\n\n| a |\n|---|\n\nWhat it says.\n")
            return record

        return call

    monkeypatch.setattr(gradients.jacobian_experiment, "run_jacobian", fake("jacobian", {"entries": {}}))
    monkeypatch.setattr(gradients.convergence_experiment, "run_convergence", fake("convergence", {"runs": {}}))
    monkeypatch.setattr(gradients.plane_experiment, "run_plane", fake("minimal-plane", {"runs": []}))
    for arguments in (
        ("jacobian", "--motion", "x", "--filter-size", "5", "--out", "here", "--resume"),
        ("jacobian", "--full", "--map-resolution", "64"),
        ("convergence", "--displacement", "0.2", "--camera", "perspective", "--candidate", "msm"),
        ("minimal-plane", "--iterations", "7"),
    ):
        result = run("gradients", *arguments)
        assert result.status == 0 and "What it says." in result.out and "Title" not in result.out, result.err
    first, full, convergence, plane = seen
    assert first.motions == ("x",) and first.filter_sizes == (5,) and first.out == Path("here") and first.resume
    assert len(full.candidates) > 3 and full.map_resolutions == (64,) and full.spp > first.spp
    assert convergence.displacements == (0.2,) and convergence.cameras == ("perspective",)
    assert convergence.candidates == ("msm",)
    assert plane.iterations == 7
    result = run("gradients", "convergence", "--occluder", "moon")
    assert result.status == 1 and "moon" in result.err


def test_times_of_lights_are_a_record(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    times = {"seconds": {"batch of 2": {"median": 0.5}}, "ratio_of_medians": {}}
    monkeypatch.setattr(lights.lights_speed, "measure", lambda problem, sizes: times)
    result = run("lights-times", "--batch", "2", "--no-workers", "--out", "t")
    assert result.status == 0 and result.out.splitlines()[-1] == "Record: t/times.json", result.err
    record = json.loads(Path("t/times.json").read_text())
    assert record.keys() == {"shadowmap_dr", "machine", "settings", "steps"} and record["steps"] == times


def test_the_last_line_names_what_to_look_at(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(maps.maps_experiment, "run_maps", lambda options: {"scenes": {}})
    assert run("maps", "--out", "m").out.splitlines()[-1] == "Picture: m/maps.png, record: m/maps.json"
    monkeypatch.setattr(soft.soft_experiment, "run_soft", lambda options: {"scenes": {}, "settings": {"samples": []}})
    assert run("soft", "--out", "s").out.splitlines()[-1] == "Picture: s/soft.png, record: s/soft.json"
    monkeypatch.setattr(lights.lights_experiment, "run_lights", lambda options, variant: [])
    assert run("lights", "--out", "l").out.splitlines()[-1] == "Picture: l/lights.png, record: l/lights.json"
