"""Pages of the documentation: their code runs, their links lead somewhere, and Sphinx builds them without a warning."""

from __future__ import annotations

import gc
import importlib.util
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

if not DOCS.is_dir():
    pytest.skip("no documentation beside the tests", allow_module_level=True)

BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
#: Pages with code that other tests run, or that shows a part of a program.
OTHERS = {"README.md", "art.md", "faces.md", "lights.md", "model.md", "performance.md"}
PAGES = {
    path.relative_to(DOCS).as_posix(): blocks
    for path in sorted(DOCS.rglob("*.md"))
    if path.relative_to(DOCS).as_posix() not in OTHERS and (blocks := BLOCK.findall(path.read_text(encoding="utf-8")))
}
#: Values that the text of a page promises: an expression of its names, and the bound of its absolute value.
PROMISES = {
    "get-started.md": [("colour - 0.5", 0.06)],
    "how-to/cameras.md": [("optimiser['camera.x_fov'] - true_fov", 1.0), ("shift", 0.05)],
    "how-to/scene-and-photo.md": [("direction - mi.Vector3f(-0.25, 0.5, -0.83)", 0.03)],
    "how-to/sweeps.md": [("np.array(records[0]['final']) - [1, -0.5]", 0.1)],
    "reference/inverse.md": [("history.final - [0.2, 0.1, -0.1]", 0.05)],
    "how-to/visibility.md": [("np.array(sorted(names)) != ['depth', 'visibility.bulb', 'visibility.sun']", 0)],
}


@pytest.fixture
def names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """Names of a page's code, which runs in a folder with the scenes of the checkout."""
    (tmp_path / "scenes").symlink_to(ROOT / "scenes")
    monkeypatch.chdir(tmp_path)
    # Scenes of earlier pages, collected while a function is recorded, would end the process.
    gc.collect()
    gc.disable()
    page: dict[str, Any] = {"__name__": "page"}
    yield page
    page.clear()
    gc.enable()


@pytest.mark.parametrize("page", PAGES)
def test_code_runs(page: str, names: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    """All blocks of a page, one after the other. Blocks that need PyTorch or OpenCV are left out without it."""
    with_torch, with_opencv = (importlib.util.find_spec(name) is not None for name in ("torch", "cv2"))
    for number, block in enumerate(PAGES[page]):
        if (with_torch or not re.search(r"\b(torch|sdr)\b", block)) and (with_opencv or "cameras.undistort" not in block):
            exec(compile(block, f"docs/{page}, block {number}", "exec", dont_inherit=True), names)
    for expression, bound in PROMISES.get(page, []):
        assert np.all(np.abs(np.array(eval(expression, {"np": np, "mi": mi, **names}), np.float64)) <= bound), expression


def test_all_public_names_have_an_example() -> None:
    """On the page of the reference that describes them."""
    count, without = 0, []
    for path in sorted((DOCS / "reference").glob("*.md")):
        text = path.read_text(encoding="utf-8")
        code = "\n".join(BLOCK.findall(text))
        for name in re.findall(r"^\.\. auto(?:function|class|exception):: ([\w.]+)", text, re.MULTILINE):
            count += 1
            without += [] if re.search(rf"\b{name.rpartition('.')[2]}\b", code) else [f"{path.name}: {name}"]
    assert count > 70 and not without


def test_promises_are_of_pages_that_exist() -> None:
    assert PAGES.keys() >= PROMISES.keys() and len(PAGES) >= 13


def test_guides_are_short() -> None:
    guides = {path.name: path.read_text(encoding="utf-8") for path in (DOCS / "how-to").glob("*.md")}
    words = {name: len(re.sub(r"```.*?```", "", text, flags=re.DOTALL).split()) for name, text in guides.items()}
    assert words and max(words.values()) <= 500, words


def texts() -> Iterator[tuple[Path, str]]:
    """Markdown of all pages and notebooks, without code."""
    for path in sorted(DOCS.rglob("*.md")):
        yield path, re.sub(r"^```(?!\{).*?^```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for path in sorted(DOCS.rglob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        yield path, "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def test_links_and_pictures_exist() -> None:
    found, missing = 0, []
    for path, text in texts():
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", re.sub(r"`[^`]*`", "", text)):
            if not re.match(r"[a-z]+:", target):
                found += 1
                missing += [] if (path.parent / target).exists() else [f"{path.relative_to(ROOT)}: {target}"]
    generated = {"docs/changelog.md", "docs/contributing.md"}
    assert found > 100 and not missing and all((ROOT / name).is_file() for name in generated)


def test_sphinx_builds_all_pages(tmp_path: Path) -> None:
    for name in ("sphinx", "myst_parser", "furo", "sphinx_copybutton"):
        pytest.importorskip(name, reason="Sphinx is not installed: pip install '.[docs]'")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "-d", tmp_path / "trees"]
    result = subprocess.run([*command, DOCS, tmp_path / "html"], capture_output=True, text=True, timeout=300, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    pages = {path.relative_to(tmp_path / "html").as_posix() for path in (tmp_path / "html").rglob("*.html")}
    assert {"index.html", "tutorials/pose.html", "gallery/gallery.html", "reference/commands.html"} <= pages
    commands = (tmp_path / "html" / "reference" / "commands.html").read_text(encoding="utf-8")
    settings = (tmp_path / "html" / "reference" / "settings.html").read_text(encoding="utf-8")
    assert "--scheduler" in commands and "9 to 4096" in settings
    # Signatures and docstrings, also of what needs PyTorch.
    assert "clip-space vertices" in (tmp_path / "html" / "reference" / "torch.html").read_text(encoding="utf-8")


@pytest.fixture
def extensions(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The folder of extensions as a place to import from."""
    pytest.importorskip("sphinx", reason="Sphinx is not installed: pip install '.[docs]'")
    monkeypatch.syspath_prepend(DOCS / "_ext")
    yield
    for name in ("commands", "docstrings", "project_links", "settings_tables", "tables"):
        sys.modules.pop(name, None)


def test_aligned_lists_and_examples_in_docstrings(extensions: None) -> None:
    import docstrings

    lines = ["Title.", "", "width   Float, metres", "        and more", "a, b    Int", "", "Use:", "", "    run()", ""]
    assert docstrings.definitions(docstrings.literal_blocks(lines)) == [
        *("Title.", "", "", "``width``", "    Float, metres", "    and more", "", "``a``, ``b``", "    Int", ""),
        *("Use::", "", "    run()", ""),
    ]


def test_links_of_files_beside_the_pages(extensions: None, tmp_path: Path) -> None:
    import project_links

    text = "[a](docs/pose.md#results) [b](CONTRIBUTING.md) [c](README.md#gone) [d](scenes) [e](LICENSE) [f](https://x.y/z)"
    assert project_links.with_links(f"{text} ![g](docs/model.png)", ROOT, DOCS) == (
        "[a](pose.md#results) [b](/contributing.md) [c](/readme.md) d [e](../LICENSE) [f](https://x.y/z) ![g](model.png)"
    )


def test_ranges_are_those_that_the_records_accept(extensions: None) -> None:
    import settings_tables

    rows = [line.split(" | ") for line in settings_tables.settings().splitlines()[2:]]
    accepted = {row[0].strip("| `"): row[3] for row in rows}
    assert accepted["shadow_order"] == "even, 2 to 16" and accepted["shadow_filter_size"] == "0; odd, 1 to 121"
    assert accepted["shadow_bleeding"] == "0 to below 1" and accepted["tessellation"] == "3 or more"
    assert accepted["shadow_map_resolution"] == "`auto`; 9 to 4096" and accepted["shadow_tiles"] == "0 to 16"
    assert accepted["recorded"] == "`auto`, `true`, `false`"
    assert accepted["emitter_shadows"] == "`samples`, `single`" and accepted["light_memory"] == "above 0"


def test_every_command_is_described(extensions: None) -> None:
    import commands

    from shadowmap_dr.cli.main import COMMANDS

    text = commands.commands()
    assert all(re.search(rf"^## {name}\b", text, re.MULTILINE) for name in COMMANDS)
    assert "| `-o` `--output` | `IMAGE` | required |" in text
