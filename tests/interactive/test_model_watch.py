"""A mesh that follows an image file, however it is written."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from model_fakes import SIZE, FakeSculptor, FakeSession, eventually
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.interactive import Modeller, exports
from shadowmap_dr.interactive.file_session import follow, kept
from shadowmap_dr.interactive.watch import ImageWatch


def png(value, size=SIZE, kind="PNG"):
    buffer = io.BytesIO()
    noise = np.random.default_rng(1).integers(0, 30, (size, size))  # so that half of a file is half of the image
    Image.fromarray((value + noise).astype(np.uint8)).save(buffer, kind)
    return buffer.getvalue()


@pytest.fixture
def watch(tmp_path: Path) -> ImageWatch:
    (tmp_path / "shadow.png").write_bytes(png(200))
    watch = ImageWatch(tmp_path / "shadow.png", (SIZE, SIZE))
    watch.ignore()
    return watch


def polls(watch, count=4):
    return [image for image in (watch.poll() for _ in range(count)) if image is not None]


def test_news_come_once(watch, tmp_path):
    assert polls(watch) == []
    (tmp_path / "shadow.png").write_bytes(png(50))
    (image,) = polls(watch)
    np.testing.assert_allclose(image, np.asarray(Image.open(tmp_path / "shadow.png")) / 255, atol=1e-6)
    assert watch.problem is None and polls(watch) == []


@pytest.mark.parametrize("kind", ["PNG", "BMP", "JPEG"])
def test_half_written_files_are_waited_out(watch, tmp_path, kind):
    content = png(50, kind=kind)
    for share in (0.0, 0.02, 0.5, 0.9):
        (tmp_path / "shadow.png").write_bytes(content[: int(share * len(content))])
        assert polls(watch) == [] and "cannot be used yet" in watch.problem
    (tmp_path / "shadow.png").write_bytes(content)
    (image,) = polls(watch)
    assert image.mean() == pytest.approx((50 + 14.5) / 255, abs=0.01) and watch.problem is None


def test_files_that_are_being_written_are_not_read(watch, tmp_path):
    for value in range(60, 70):  # valid each time, but never the same twice
        (tmp_path / "shadow.png").write_bytes(png(value))
        os.utime(tmp_path / "shadow.png", ns=(value, value))
        assert watch.poll() is None
    assert len(polls(watch)) == 1


def test_files_may_be_replaced_and_vanish_meanwhile(watch, tmp_path):
    path = tmp_path / "shadow.png"
    path.unlink()
    assert polls(watch) == [] and "missing" in watch.problem
    (tmp_path / "other").write_bytes(png(50))
    (tmp_path / "other").replace(path)
    assert len(polls(watch)) == 1
    path.unlink()
    path.mkdir()
    assert polls(watch) == [] and "cannot be used yet" in watch.problem


def test_what_is_no_shadow_is_waited_out(watch, tmp_path):
    wide = io.BytesIO()
    Image.new("L", (64, 32)).save(wide, "PNG")
    svg = b"<svg xmlns='http://www.w3.org/2000/svg'/>"
    for content in (b"text", svg, wide.getvalue(), b"\0" * (exports.MOST_BYTES + 1), b"\x89PNG\r\n\x1a\n" + b"\xff" * 500):
        (tmp_path / "shadow.png").write_bytes(content)
        assert polls(watch) == [] and watch.problem
        assert "\n" not in watch.problem


def test_sizes_depths_and_transparency_of_shadows(tmp_path):
    large = Image.new("RGBA", (4 * SIZE, 4 * SIZE), (0, 0, 0, 0))
    large.paste((0, 0, 0, 255), (0, 0, 2 * SIZE, 4 * SIZE))
    buffer = io.BytesIO()
    large.save(buffer, "PNG")
    image = exports.read_shadow(buffer.getvalue(), (SIZE, SIZE))
    assert (image[:, : SIZE // 2] == 0).all() and (image[:, SIZE // 2 :] == 1).all()
    deep = io.BytesIO()
    Image.fromarray(np.full((SIZE, SIZE), 40_000, np.uint16)).save(deep, "PNG")
    assert exports.read_shadow(deep.getvalue(), (SIZE, SIZE)).mean() == pytest.approx(40_000 / 65_535, abs=0.005)


def test_written_shadows_are_read_as_they_were():
    shadow = np.arange(SIZE * SIZE).reshape(SIZE, SIZE).astype(np.uint8)
    np.testing.assert_array_equal(np.rint(255 * exports.read_shadow(exports.shadow_bytes(shadow), (SIZE, SIZE))), shadow)


def test_meshes_follow_files_until_told_to_stop(tmp_path):
    sculptor = FakeSculptor(start=0.5)
    image, saves, said = tmp_path / "shadow.png", [], []
    plan = iter([png(50)[:300], png(50), None])

    def stop():
        if sculptor.steps and len(saves) > 1:
            return True
        if image.exists() and len(said) in (1, 2) and time.monotonic() > stop.next:
            stop.next = time.monotonic() + 0.4
            content = next(plan)
            if content is not None:
                image.write_bytes(content)
        return False

    stop.next = 0.0
    follow(Modeller(sculptor), image, lambda v: saves.append(v[0, 0]), stop, said.append)
    assert saves[0] == 0 and saves[-1] == pytest.approx((50 + 14.5) / 255, abs=0.01)
    assert "edit it" in said[0] and "has changed" in said[1] and "at rest" in said[2]


def test_paintings_are_not_written_over(tmp_path):
    sculptor, said = FakeSculptor(), []
    content = png(50)
    (tmp_path / "shadow.png").write_bytes(content)
    follow(Modeller(sculptor), tmp_path / "shadow.png", lambda v: None, lambda: sculptor.steps > 2, said.append)
    assert (tmp_path / "shadow.png").read_bytes() == content and "follows it" in said[0]
    assert sculptor.vertices()[0, 0] == pytest.approx((50 + 14.5) / 255, abs=0.01)


def test_files_that_stay_unusable_are_mentioned_once(tmp_path, monkeypatch):
    monkeypatch.setattr("shadowmap_dr.interactive.file_session._PATIENCE", 0.2)
    (tmp_path / "shadow.png").write_bytes(b"text")
    said, end = [], time.monotonic() + 1.2
    follow(Modeller(FakeSculptor()), tmp_path / "shadow.png", lambda v: None, lambda: time.monotonic() > end, said.append)
    assert len(said) == 2 and "cannot be used yet" in said[1]


def test_the_program_saves_the_mesh_when_interrupted(tmp_path):
    import trimesh

    trimesh.creation.icosphere(3, 5.0).apply_translation([10, 0, 0]).export(tmp_path / "ball.obj")
    command = [sys.executable, "-c", "from shadowmap_dr.cli.main import main; main()", "model", "ball.obj", "--resolution", "48"]
    process = subprocess.Popen(
        [*command, "--image", "s.png", "-o", "out.ply"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        eventually(lambda: (tmp_path / "out.ply").exists() or process.poll() is not None, 120)
        shadow = np.array(Image.open(tmp_path / "s.png"))
        assert shadow.shape == (48, 48) and 0.15 < (shadow < 128).mean() < 0.25  # a disk of half the image's width
        shadow[20:28, 24:42] = 0
        Image.fromarray(shadow).save(tmp_path / "s.png")
        # Meshes are saved while they grow: how long that takes is up to the machine.
        eventually(lambda: trimesh.load_mesh(tmp_path / "out.ply").bounds[1, 0] > 16 or process.poll() is not None, 120)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert out == "Mesh: out.ply\n" and "Traceback" not in err and "s.png has changed." in err
    mesh = trimesh.load_mesh(tmp_path / "out.ply")
    # In the file's own place and size: a ball of radius 5 around x = 10, with a nose.
    assert mesh.is_watertight and mesh.bounds[1, 0] > 16 and mesh.bounds[:, 1] == pytest.approx([-5, 5], abs=0.4)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.obj", "out.ply", "s.png"]


def test_a_sessions_mesh_is_saved_while_it_moves(monkeypatch):
    monkeypatch.setattr("shadowmap_dr.interactive.file_session.SAVE_INTERVAL", 0.01)
    fake, saved = FakeSession(), []

    def save(snapshot):
        saved.append(snapshot.vertices[0, 0])
        if len(saved) == 1:
            raise ShadowmapError("the disk is full")

    fake.session.start()
    with kept(fake.session, save):
        for version, value in enumerate((0.25, 0.75), 1):
            fake.session.set_target(np.full((SIZE, SIZE), value, np.float32), version)
            eventually(lambda value=value: saved and saved[-1] == pytest.approx(value))
        count = len(saved)
        time.sleep(0.1)
        assert len(saved) == count  # what does not change is not saved again
    fake.session.close()
