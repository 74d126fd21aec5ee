"""Messages that several modules share: hints how to install packages, and the nearest of known words."""

from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path
from typing import Any

import pytest

from shadowmap_dr import errors

ROOT = Path(__file__).resolve().parents[1]


class Distribution:
    """An installation as `importlib.metadata` describes it."""

    requires = [
        "numpy>=1.26",
        'cholespy>=2.0; extra == "art"',
        "surely-missing<3,>=1.5 ; extra == 'art'",
        "also-missing; python_version > '3' and extra == 'art'",
        "scipy>=1.11; extra == 'faces'",
    ]

    def __init__(self, origin: str | None = None) -> None:
        self.origin = origin

    def read_text(self, name: str) -> str | None:
        return self.origin if name == "direct_url.json" else None


def installed(monkeypatch: pytest.MonkeyPatch, package: Path, *, origin: str | None = None) -> None:
    def version(name: str) -> str:
        if name not in ("cholespy", "numpy"):
            raise importlib.metadata.PackageNotFoundError(name)
        return "2.0"

    monkeypatch.setattr(importlib.metadata, "distribution", lambda name: Distribution(origin))
    monkeypatch.setattr(importlib.metadata, "version", version)
    monkeypatch.setattr(errors, "_PACKAGE", package)


def test_hint_in_a_checkout(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text("")
    installed(monkeypatch, tmp_path / "shadowmap_dr")
    assert errors.install_hint("art") == f"pip install '.[art]' in {tmp_path}"
    installed(monkeypatch, tmp_path / "shadowmap_dr", origin='{"url": "file:///a", "dir_info": {"editable": true}}')
    assert errors.install_hint("art") == f"pip install -e '.[art]' in {tmp_path}"


def test_hint_of_a_wheel_names_missing_packages(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    installed(monkeypatch, tmp_path / "shadowmap_dr")
    assert errors.install_hint("art") == "pip install 'surely-missing<3,>=1.5' 'also-missing'"
    assert errors.install_hint("faces") == "pip install 'scipy>=1.11'"


def test_extras_of_hints_exist() -> None:
    declared = re.search(r"\[project\.optional-dependencies\](.*?)\n\[", (ROOT / "pyproject.toml").read_text(), re.DOTALL)
    assert declared is not None
    extras = set(re.findall(r"^(\w+) = ", declared[1], re.MULTILINE))
    sources = "\n".join(path.read_text() for path in (ROOT / "shadowmap_dr").rglob("*.py"))
    named = set(re.findall(r"install_hint\(['\"](\w+)['\"]\)", sources))
    assert named == {"art", "distributed", "faces", "interactive", "photos", "remesh", "torch"} and named <= extras
    assert "shadowmap-dr[" not in sources, "the package is on no index"


@pytest.mark.parametrize(
    ("word", "found"),
    [("poes", "pose"), ("grad", "gradients"), ("Art", "art"), ("zebra", None), ("", None), ("size", "map_size")],
)
def test_nearest_words(word: str, found: Any) -> None:
    known = ["pose", "gradients", "art", "maps", "map_size", "soft_map_size"]
    assert errors.nearest(word, known) == found
    assert errors.did_you_mean(word, known) == (f" Did you mean {found!r}?" if found else "")


def test_long_texts_keep_their_ends() -> None:
    assert errors.shortened("a name") == "a name" and errors.quoted("a name") == "'a name'"
    text = errors.shortened("b" + 5000 * "x" + "e")
    assert len(text) == 80 and text.startswith("bx") and text.endswith("xe") and "…" in text
    assert len(errors.quoted(5000 * "x")) == 80 and errors.quoted(10**5000) == "a very long int"


@pytest.mark.parametrize("given", [5000 * "x", "/".join(900 * ["folder"]), 900 * "two words ", 3000 * "\n", 700 * "x y\n"])
def test_messages_are_one_short_line(given: str) -> None:
    """They keep their begin and their end, and ``args`` keeps all."""
    for kind in (errors.ShadowmapError, errors.OutputError, errors.LLVMError):
        error = kind(f"the thing {given} is wrong: give another.")
        assert len(str(error)) <= 600 and "\n" not in str(error)
        assert str(error).startswith("the thing ") and str(error).endswith("is wrong: give another.")
        assert given in error.args[0]
    path = "/".join(30 * ["folder"])
    assert str(errors.ShadowmapError(f"no file {path!r}.")) == f"no file {path!r}."
