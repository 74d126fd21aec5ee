"""The command `shadowmap-dr model`: what it refuses, in one line."""

from __future__ import annotations

import builtins
from pathlib import Path

import pytest

from shadowmap_dr import cli_model
from shadowmap_dr.errors import ShadowmapError


@pytest.mark.parametrize("arguments, reason", [
    ({"mesh": "nothing"}, "no mesh 'nothing'"),
    ({"mesh": "spot", "view": "below"}, "no view 'below'"),
    ({"mesh": "spot", "output": Path("mesh.stl")}, ".stl"),
    ({"mesh": "spot", "image": Path("shadow.jpg")}, ".jpg"),
    ({"mesh": "broken.ply"}, "broken.ply"),
    ({"mesh": "spot", "step_size": -1.0, "resolution": 32}, "step size"),
    ({"mesh": "spot", "step_size": -1.0, "resolution": 32, "serve": True}, "step size"),
])  # fmt: skip
def test_bad_input_is_one_line(variant, tmp_path, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    Path("broken.ply").write_text("ply\n")
    with pytest.raises(ShadowmapError, match=reason) as refused:
        cli_model.model(**arguments)
    assert "\n" not in str(refused.value)
    assert not Path("shadow.png").exists() and not Path("model.ply").exists()


def test_missing_packages_are_named(variant, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load = builtins.__import__

    def without(name, *arguments, **options):
        if name.split(".")[0] == "uvicorn":
            raise ModuleNotFoundError("No module named 'uvicorn'", name="uvicorn")
        return load(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", without)
    monkeypatch.delitem(__import__("sys").modules, "shadowmap_dr.interactive.server", raising=False)
    with pytest.raises(ShadowmapError, match=r"uvicorn.*pip install 'shadowmap-dr\[interactive\]'"):
        cli_model.model("sphere", serve=True, port=0)
