"""Links from pages to files of the project, as they work in a checkout, made links between pages of the documentation."""

from __future__ import annotations

import re
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

#: Files beside docs/ that are pages of the documentation, too: their place there.
PAGES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
_LINK = re.compile(r"\]\((?P<path>[^)#\s:]+)(?P<anchor>#[^)\s]*)?\)")


def read_source(app: Sphinx, page: str, source: list[str]) -> None:
    """Let links to the files of `PAGES` lead to their pages."""
    folder = (Path(app.srcdir) / page).parent
    source[0] = _LINK.sub(lambda link: _led(link, folder, Path(app.srcdir)), source[0])


def _led(link: re.Match[str], folder: Path, docs: Path) -> str:
    target = (folder / link["path"]).resolve()
    if target.parent == docs.parent and target.name in PAGES:
        anchor = link["anchor"] or ""
        # A heading that is gone is no reason to lose the link.
        known = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.MULTILINE)
        there = anchor.lstrip("#") in {heading.lower().replace(" ", "-") for heading in known}
        return f"](/{PAGES[target.name]}{anchor if there else ''})"
    return link[0]


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", read_source)
    # Diagrams are shown as they are written; drawing them needs a program or the network.
    app.add_lexer("mermaid", TextLexer)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
