"""Names of files and arguments that are no UTF-8: one line, and nothing written."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CODE = "from shadowmap_dr.cli.main import main; main()"
BAD = "caf\udce3"  # as Python decodes b"caf\xe3"


@pytest.mark.parametrize(
    "arguments",
    [
        ["render", f"{BAD}.xml", "-o", "a.png"],
        ["render", "scene.xml", "-o", "a.png"],
        ["render", "pose", "-o", f"{BAD}.png"],
        ["render", "pose", "-D", f"object={BAD}.ply", "-o", "a.png"],
        ["pose", "--object", f"{BAD}.ply"],
        ["art", "--target", f"{BAD}.png"],
        ["face", "--image", f"{BAD}.png"],
        ["soft", "--out", BAD],
        ["art", "--text", BAD],
        [BAD],
    ],
)
def test_names_that_are_no_text(tmp_path: Path, arguments: list[str]) -> None:
    for suffix in ("ply", "png", "xml"):
        (tmp_path / f"{BAD}.{suffix}").write_bytes(b"nothing")
    (tmp_path / "scene.xml").write_bytes(b'<scene version="3.0.0"><unknown\xe3 name="\xe3"/></scene>')
    before = sorted(tmp_path.iterdir())
    run = subprocess.run([sys.executable, "-c", CODE, *arguments], cwd=tmp_path, capture_output=True)
    lines = run.stderr.decode("utf-8").strip().splitlines()
    if run.returncode == 2:  # wrong usage: the error stands between the usage and the way to the help
        assert lines[0].startswith("Usage: ") and lines[2].startswith("Try ") and len(lines) == 3
        lines = lines[1:2]
    assert run.returncode in (1, 2) and len(lines) == 1 and lines[0].startswith("error: "), lines
    assert [path for path in sorted(tmp_path.iterdir()) if path.is_file()] == before
