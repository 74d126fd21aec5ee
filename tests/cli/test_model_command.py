"""The command `shadowmap-dr model`: what it refuses, in one line."""

from __future__ import annotations

import builtins
import json
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from shadowmap_dr.cli import model
from shadowmap_dr.errors import ShadowmapError, install_hint
from shadowmap_dr.io import assets


@pytest.mark.parametrize("arguments, reason", [
    ({"mesh": "nothing"}, "no mesh 'nothing'"),
    ({"mesh": "spot", "view": "below"}, "no view 'below'"),
    ({"mesh": "spot", "output": Path("mesh.stl")}, ".stl"),
    ({"mesh": "spot", "image": Path("shadow.jpg")}, ".jpg"),
    ({"mesh": "broken.ply"}, "broken.ply"),
    ({"mesh": "spot", "step_size": -1.0, "resolution": 32}, "--step-size. is -1.0"),
    ({"mesh": "spot", "step_size": -1.0, "resolution": 32, "serve": True}, "--step-size. is -1.0"),
])  # fmt: skip
def test_bad_input_is_one_line(variant, tmp_path, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    Path("broken.ply").write_text("ply\n")
    with pytest.raises(ShadowmapError, match=reason) as refused:
        model.model(**arguments)
    assert "\n" not in str(refused.value)
    assert not Path("shadow.png").exists() and not Path("model.ply").exists()


@pytest.mark.parametrize(("package", "extra"), [("uvicorn", "interactive"), ("cholespy", "art")])
def test_missing_packages_are_named(variant, tmp_path, monkeypatch, package, extra):
    monkeypatch.chdir(tmp_path)
    load = builtins.__import__

    def without(name, *arguments, **options):
        if name.split(".")[0] == package:
            raise ModuleNotFoundError(f"No module named '{package}'", name=package)
        return load(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.delitem(__import__("sys").modules, "shadowmap_dr.interactive.server", raising=False)
    with pytest.raises(ShadowmapError, match=re.escape(f"{package}: {install_hint(extra)}.")):
        model.model("sphere", serve=True, port=0)
    assert not Path("model.ply").exists()


def test_a_port_that_is_taken_leaves_files_alone(variant, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("m.ply").write_text("precious")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen(1)
        with pytest.raises(ShadowmapError, match="cannot serve on port"):
            model.model("sphere", serve=True, port=other.getsockname()[1], resolution=32, output=Path("m.ply"))
    assert Path("m.ply").read_text() == "precious"


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no terminals that hang up")
@pytest.mark.parametrize("number", ["SIGTERM", "SIGHUP"])
def test_a_served_mesh_is_saved_when_the_program_is_told_to_end(tmp_path, number):
    command = [
        sys.executable,
        "-c",
        "from shadowmap_dr.cli.main import main; main()",
        "model",
        "sphere",
        "--serve",
        "--port",
        "0",
    ]
    process = subprocess.Popen(
        [*command, "--resolution", "32", "-o", "m.ply"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout.readline().startswith("Open http://127.0.0.1:")
        process.send_signal(getattr(signal, number))
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    assert out == "Mesh: m.ply\n" and "Traceback" not in err
    assert (tmp_path / "m.ply").read_bytes().startswith(b"ply")


def test_the_mesh_that_a_page_has_chosen_is_saved(tmp_path):
    client = pytest.importorskip("websockets.sync.client")
    trimesh = pytest.importorskip("trimesh")
    command = [sys.executable, "-c", "from shadowmap_dr.cli.main import main; main()"]
    options = ["model", "sphere", "--serve", "--port", "0", "--resolution", "32", "-o", "m.ply"]
    process = subprocess.Popen([*command, *options], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().split()[1].rstrip("/")
        with client.connect(f"ws{address[4:]}/live", origin=address, proxy=None, max_size=None) as page:
            assert "spot" in json.loads(page.recv(timeout=30))["meshes"]
            page.send(json.dumps({"type": "mesh", "name": "spot"}))
            while not (isinstance(text := page.recv(timeout=60), str) and json.loads(text)["type"] == "mesh"):
                pass
            assert json.loads(text) == {"type": "mesh", "name": "spot", "mesh": 1}
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0, err
    saved = trimesh.load_mesh(tmp_path / "m.ply", process=False)
    file = trimesh.load_mesh(assets.mesh("spot"), process=False)
    assert len(saved.faces) == len(file.faces)
    np.testing.assert_allclose(saved.bounds, file.bounds, atol=1e-4)  # in the place and size of its file
