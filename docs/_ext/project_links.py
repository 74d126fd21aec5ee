"""Links of files of the project, as they work in a checkout, made links of the documentation."""

from __future__ import annotations

import re
from pathlib import Path

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
#: Files beside docs/ that are pages of the documentation, too: their place there.
PAGES = {"README.md": "readme.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
_LINK = re.compile(r"(?P<text>\[[^\]]*\])\((?P<path>[^)#\s:]+)(?P<anchor>#[^)\s]*)?\)")


def file(name: str) -> str:
    """Markdown of a file beside docs/, for a page in docs/."""
    return with_links((DOCS.parent / name).read_text(encoding="utf-8"), DOCS.parent, DOCS)


def read_source(app: Sphinx, page: str, source: list[str]) -> None:
    """Make the links of a page those of the documentation."""
    folder = (DOCS / page).parent
    source[0] = with_links(source[0], folder, folder)


def with_links(text: str, folder: Path, new_folder: Path) -> str:
    """Markdown from one folder for a page in another one.

    Links to `PAGES` lead to their pages, links to folders and to files that are gone become text.
    """
    return _LINK.sub(lambda link: _link(link, folder, new_folder), text)


def _link(link: re.Match[str], folder: Path, new_folder: Path) -> str:
    target, anchor = (folder / link["path"]).resolve(), link["anchor"] or ""
    if target.parent == DOCS.parent and target.name in PAGES:
        # A heading that is gone is no reason to lose the link.
        headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.MULTILINE)
        there = anchor.lstrip("#") in {heading.lower().replace(" ", "-") for heading in headings}
        return f"{link['text']}(/{PAGES[target.name]}{anchor if there else ''})"
    if folder == new_folder:
        return link[0]
    if not target.is_file():
        return link["text"][1:-1]
    up = [".."] * len(new_folder.relative_to(DOCS).parts)
    place = target.relative_to(DOCS) if target.is_relative_to(DOCS) else Path("..") / target.relative_to(DOCS.parent)
    return f"{link['text']}({'/'.join([*up, place.as_posix()])}{anchor})"


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("source-read", read_source)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
