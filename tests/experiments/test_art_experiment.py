"""`shadowmap-dr art`: the loop, its files, killed runs, and what it says about bad input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from shadowmap_dr.cli import main
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.art import experiment as art
from shadowmap_dr.experiments.art import gallery as art_gallery
from shadowmap_dr.experiments.art import pictures as art_pictures
from shadowmap_dr.experiments.art.run import frame_steps, intersection_over_union, make
from shadowmap_dr.inverse import RemeshingSculptor, Sculptor, even_sphere, shadow_view
from shadowmap_dr.inverse.shadow_art import exports
from shadowmap_dr.io import meshes as io_meshes

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("cholespy")

SIZE = 48
TINY = {"picture_size": 32, "turns": 3}


class Killed(Exception):
    """An end of a run in the middle."""


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """A coarse sphere, and coarse maps for pictures."""
    monkeypatch.setattr(art, "even_sphere", lambda: even_sphere(10, 1.0))
    monkeypatch.setattr(art_pictures, "_MAP_RESOLUTION", 64)


def sculptor():
    views = [shadow_view(size=SIZE)]
    target = np.where(np.add.outer(np.abs(np.arange(SIZE) - 23.5), np.abs(np.arange(SIZE) - 23.5)) < 16, 0.0, 1.0)
    return Sculptor(*even_sphere(8, 1.0), views, [target], map_resolution=SIZE)


def test_overlap_counts_dark_pixels():
    image, target = np.ones((4, 4)), np.ones((4, 4))
    assert intersection_over_union(image, target) == 1
    image[:2], target[:, :2] = 0, 0
    assert intersection_over_union(image, target) == pytest.approx(4 / 12)
    seen = np.zeros((4, 4), bool)
    seen[:2] = True
    assert intersection_over_union(image, target, seen) == pytest.approx(4 / 8)


def test_frames_begin_and_end_the_run():
    steps = frame_steps(400)
    assert {0, 400} <= steps and len(steps) <= 48 and sum(step <= 100 for step in steps) > len(steps) / 3
    assert {0, 3} <= frame_steps(3) <= {0, 1, 2, 3}


def test_killed_runs_go_on_where_they_were(variant, tmp_path):
    whole = make(sculptor(), 70)
    checkpoint = tmp_path / "checkpoint.npz"

    def kill(done, note):
        if done == 60:
            raise Killed

    with pytest.raises(Killed):
        make(sculptor(), 70, checkpoint=checkpoint, fingerprint="a", on_step=kill)
    with pytest.raises(ShadowmapError, match="other settings"):
        make(sculptor(), 70, checkpoint=checkpoint, fingerprint="b")
    resumed, done = sculptor(), []
    trace = make(resumed, 70, checkpoint=checkpoint, fingerprint="a", on_step=lambda n, note: done.append(n))
    assert done[0] == 51 and trace.iterations == 70
    assert [frame.step for frame in trace.frames] == [frame.step for frame in whole.frames]
    assert {frame.step for frame in trace.frames} == frame_steps(70)
    np.testing.assert_array_equal(trace.frames[-1].vertices, resumed.vertices())
    np.testing.assert_allclose(trace.loss, whole.loss, rtol=0.02)
    assert trace.looks[-1][0] == 70 and trace.looks[-1][1][0] == pytest.approx(whole.looks[-1][1][0], abs=0.01)
    checkpoint.write_bytes(b"nonsense")
    with pytest.raises(ShadowmapError, match="delete it"):
        make(sculptor(), 70, checkpoint=checkpoint, fingerprint="a")


def test_a_piece_has_all_its_files(variant, tmp_path):
    options = art.ArtOptions(
        ("text:L", "text:I"), resolution=SIZE, iterations=150, smoothness=5, printable=True, out=tmp_path / "out", **TINY
    )
    record = art.run_art(options)
    assert json.loads((tmp_path / "out" / "art.json").read_text()) == record
    assert {"shadowmap_dr", "machine", "settings"} <= record.keys()
    assert str(tmp_path) not in json.dumps(record)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*record["files"], "art.json"}
    for view in record["views"]:
        assert view["iou"] > 0.85 and view["holes"] == 0 and view["iou_filled"] == view["iou"]
    assert record["mesh"]["watertight"] and record["mesh"]["inverted_triangles"] < 0.02
    meshes = [trimesh.load_mesh(tmp_path / "out" / f"mesh.{suffix}") for suffix in ("ply", "obj", "stl")]
    for mesh in meshes:
        assert mesh.is_watertight and len(mesh.faces) == 800
    assert meshes[0].volume == pytest.approx(record["mesh"]["volume"], rel=1e-3)
    assert meshes[2].extents.max() == pytest.approx(80, rel=1e-3) and meshes[2].volume > 0
    scene = trimesh.load_scene(tmp_path / "out" / "mesh.glb")
    assert len(scene.geometry) == 3
    colours = scene.geometry["object"].visual.vertex_colors
    assert len(np.unique(colours, axis=0)) > 50
    with Image.open(tmp_path / "out" / "turntable.webp") as animation:
        assert animation.n_frames == 3 and animation.size == (32, 32)
    with Image.open(tmp_path / "out" / "steps.webp") as animation:
        assert animation.n_frames > 10


def test_targets_of_two_views_are_equally_high(variant, tmp_path):
    options = art.ArtOptions(("text:W", "text:I"), resolution=64)
    targets = art.place([art.read_target(target) for target in options.targets], art.views_of(options))
    heights = [np.count_nonzero((target < 0.5).any(1)) for target in targets]
    assert abs(heights[0] - heights[1]) <= 1 and heights[0] > 30


def test_any_mesh_can_be_deformed(variant, tmp_path):
    box = trimesh.creation.box((3, 1, 2)).subdivide().subdivide().subdivide()
    box.apply_translation([5, 6, 7])
    box.export(tmp_path / "box.stl")  # whose triangles share no vertices
    vertices, faces = io_meshes.read_mesh(tmp_path / "box.stl")
    assert trimesh.Trimesh(vertices, faces, process=False).is_watertight
    np.testing.assert_allclose([vertices.min(0), vertices.max(0)], [[-1, -1 / 3, -2 / 3], [1, 1 / 3, 2 / 3]], atol=1e-6)
    options = art.ArtOptions(
        ("text:T",), mesh=str(tmp_path / "box.stl"), resolution=SIZE, iterations=150, smoothness=5, animate=None, receiver="wavy",
        camera="perspective", out=tmp_path / "out",
    )  # fmt: skip
    record = art.run_art(options)
    assert record["views"][0]["iou"] > 0.7 and record["iou_curve"]["iou"][0][0] < record["views"][0]["iou"]
    (tmp_path / "broken.ply").write_text("ply nonsense")
    with pytest.raises(ShadowmapError, match="broken.ply"):
        io_meshes.read_mesh(tmp_path / "broken.ply")


@pytest.mark.parametrize(
    ("face", "message"), [("0 1 7", "go from 0 to 7"), ("0 1 -1", "go from -1 to 1"), ("0 1 1", "two corners at the same place")]
)
def test_meshes_with_wrong_triangles_are_named(tmp_path, face, message):
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nelement face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    (tmp_path / "bad.ply").write_text(f"{head}0 0 0\n1 0 0\n0 1 0\n3 {face}\n")
    with pytest.raises(ShadowmapError, match=rf"bad\.ply.*{message}"):
        io_meshes.read_mesh(tmp_path / "bad.ply")


def test_recorded_collections_are_pieces_too(variant, tmp_path):
    options = art.ArtOptions(
        ("text:I",), collection="teapot", resolution=SIZE, iterations=20, interval=8, most=4, out=tmp_path / "out", **TINY
    )
    assert art.ArtOptions(("a",), collection="teapot").iterations == 1100 and art.ArtOptions(("a",)).iterations == 400
    record = art.run_art(options)
    assert record["mesh"]["faces"] == 4 * 992 and record["settings"]["collection"] == "teapot"
    assert record["iou_curve"]["step"] == [10, 20]
    with Image.open(tmp_path / "out" / "steps.webp") as animation:
        assert animation.n_frames > 10


def test_errors_are_red_where_the_shadow_is_missing_and_blue_where_it_is_too_much():
    shadow, lit = np.zeros((1, 1)), np.ones((1, 1))
    both, missing, much, none = (
        exports.error_picture(*pair)[0, 0] for pair in ((shadow, shadow), (lit, shadow), (shadow, lit), (lit, lit))
    )
    assert missing[0] > missing[1] + 0.5 and missing[0] > missing[2] + 0.5
    assert much[2] > much[0] + 0.5 and (none == 1).all() and np.ptp(both) == 0 and both[0] < 0.6


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "0 targets"),
        (["--text", "a", "--text", "b", "--text", "c"], "3 targets"),
        (["--target", "missing.png"], "missing.png"),
        (["--text", "a", "--receiver", "ball"], "ball"),
        (["--text", "a", "--camera", "fisheye"], "fisheye"),
        (["--text", "a", "--animate", "mp4"], "mp4"),
        (["--text", "a", "--iterations", "0"], "--iterations) is 0"),
        (["--text", "a", "--mesh", "spot", "--collection", "spot"], "one of the two"),
        (["--text", "a", "--remesh", "9", "--collection", "spot"], "one of the two"),
        (["--text", "a", "--mesh", "nothing"], "nothing"),
        (["--text", "a", "--resolution", "5"], "--resolution) is 5"),
    ],
)
def test_bad_arguments_are_one_line(variant, tmp_path, arguments, words):
    result = CliRunner().invoke(main.app, ["art", *arguments, "--out", str(tmp_path)])
    assert isinstance(result.exception, ShadowmapError) and words in str(result.exception)
    assert "\n" not in str(result.exception)


def test_recorded_sculptors_mesh_their_surface_anew(variant, tmp_path):
    pytest.importorskip("gpytoolbox")
    views, target = [shadow_view(size=SIZE)], sculptor().target(0)

    def maker():
        return RemeshingSculptor(*even_sphere(10, 1.0), views, [target], interval=30, smoothness=5, map_resolution=SIZE)

    one = maker()
    trace = make(one, 70)
    assert len({len(frame.faces) for frame in trace.frames}) > 1
    mesh = trimesh.Trimesh(one.vertices(), one.faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2 and mesh.edges_unique_length.max() < 3 * mesh.edges_unique_length.mean()
    assert trace.looks[-1][1][0] > 0.9 and trace.looks[-1][1][0] == intersection_over_union(one.visibility()[0], one.target(0))
    other = maker()
    other.load_state(one.state())
    assert float(np.array(other.step())[0]) == pytest.approx(float(np.array(one.step())[0]), rel=1e-3)
    np.testing.assert_array_equal(other.faces, one.faces)
    with pytest.raises(ShadowmapError, match="every 0 steps"):
        RemeshingSculptor(*even_sphere(4), views, [target], interval=0)


def test_without_the_package_remeshing_says_so(variant, monkeypatch):
    monkeypatch.setitem(sys.modules, "gpytoolbox", None)
    with pytest.raises(ShadowmapError, match="gpytoolbox"):
        RemeshingSculptor(*even_sphere(4), [shadow_view(size=SIZE)], [np.ones((SIZE, SIZE))])


def test_holes_of_targets_can_be_filled(variant):
    with_holes, without = (art.build(art.ArtOptions(("text:O",), resolution=SIZE, fill_holes=fill)).target(0) for fill in (0, 1))
    assert with_holes[SIZE // 2, SIZE // 2] == 1 and without[SIZE // 2, SIZE // 2] == 0
    assert (without <= with_holes + 1e-6).all()


def test_recorded_gallery_shows_pieces_and_their_numbers(variant, tmp_path, monkeypatch):
    quick = {"resolution": SIZE, "iterations": 10}
    pieces = (
        art_gallery.Piece("heart", "one view", {"targets": ("heart",), **quick}),
        art_gallery.Piece("two", "two views", {"targets": ("text:I", "text:O"), **quick}, "Two letters"),
        art_gallery.Piece("other", "one view", {"targets": ("missing.png",)}),
    )
    monkeypatch.setattr(art_gallery, "PIECES", pieces)
    monkeypatch.setattr(art_gallery, "_PICTURE_SIZE", 32)
    monkeypatch.setattr(art_gallery, "_TURNS", 2)
    folders = (tmp_path / "work", tmp_path / "out", tmp_path / "results" / "art.json")
    record = art_gallery.run_gallery(["heart", "two"], *folders)
    assert json.loads(folders[2].read_text()) == json.loads(json.dumps(record))
    assert {"shadowmap_dr", "machine", "settings"} <= record.keys()
    assert record["summary"]["one_view_mean"] == record["pieces"]["heart"]["views"][0]["iou"]
    assert record["summary"]["two_views_least"] == min(view["iou"] for view in record["pieces"]["two"]["views"])
    page, tables = (tmp_path / "out" / "gallery.md").read_text(), folders[2].with_suffix(".md").read_text()
    assert "shadowmap-dr art --text I --text O" in page and "Two letters" in page and "heart" not in page
    for name in ("two-turntable.webp", "two-steps.webp", "gallery.png"):
        assert (tmp_path / "out" / name).is_file() and (name in page or name == "gallery.png")
    assert f"{record['pieces']['heart']['views'][0]['iou']:.4f}" in tables and "## Two views" in tables
    monkeypatch.setattr(art_gallery, "run_art", None)  # finished pieces are kept
    assert art_gallery.run_gallery(["heart", "two"], *folders, resume=True) == record
    with pytest.raises(SystemExit, match="no piece 'nothing'"):
        art_gallery.main(["nothing"])


def test_one_thread_gives_the_same_bits_in_every_process(tmp_path):
    # As a script, with the kernels of tests, in two processes. The sphere is the usual one.
    program = "import quick_kernels; from shadowmap_dr.cli.main import main; main()"
    support = Path(__file__).parents[1] / "support"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(support), os.environ.get("PYTHONPATH", "")])}
    options = ["--target", "heart", "--target", "duck", "--iterations", "12", "--resolution", "64", "--animate", "none"]
    for name in ("a", "b"):
        command = [sys.executable, "-c", program, "art", *options, "--threads", "1", "--out", str(tmp_path / name)]
        result = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=300)
        assert result.returncode == 0, result.stderr
    one, other = (json.loads((tmp_path / name / "art.json").read_text()) for name in ("a", "b"))
    assert one["loss_curve"] == other["loss_curve"] and one["views"] == other["views"]
    for file in ("mesh.ply", "mesh.obj", "mesh.glb", "shadow-1.png", "shadow-2.png", "picture.png"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


@pytest.mark.parametrize("threads", [-1, 5000])
def test_impossible_numbers_of_threads_are_refused(threads):
    with pytest.raises(ShadowmapError, match=f"{threads} threads"):
        art.ArtOptions(targets=("heart",), threads=threads)
