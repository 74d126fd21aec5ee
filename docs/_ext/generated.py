"""Parts of pages that are made from the code: a line ``<!-- generated: NAME -->`` is replaced by Markdown from `GENERATORS`."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from commands import commands
from project_links import PAGES, file
from settings_tables import channels, settings
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.errors import ExtensionError

GENERATORS: dict[str, Callable[[], str]] = {
    "commands": commands,
    "settings": settings,
    "channels": channels,
    **{name: partial(file, name) for name in PAGES},
}
_MARK = re.compile(r"^<!-- generated: (.+) -->$", re.MULTILINE)


def read_source(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the marks of a page."""
    source[0] = _MARK.sub(lambda mark: _generated(mark[1], page), source[0])


def _generated(name: str, page: str) -> str:
    if name not in GENERATORS:
        raise ExtensionError(f"{page}: nothing is called '{name}': {', '.join(GENERATORS)}.")
    return GENERATORS[name]()


def outdated(app: Sphinx, env: BuildEnvironment, added: set[str], changed: set[str], removed: set[str]) -> list[str]:
    """Pages with marks: what they show may have changed though they have not."""
    return [page for page in env.found_docs if _MARK.search(Path(env.doc2path(page)).read_text(encoding="utf-8"))]


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("env-get-outdated", outdated)
    app.connect("source-read", read_source)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
