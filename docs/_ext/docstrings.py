"""Docstrings as reStructuredText: aligned lists (``name  description``) become definition lists, indented examples code."""

from __future__ import annotations

import re

from sphinx.application import Sphinx

# A name, or several, two or more spaces, and a description; other lines of the description are indented.
_ITEM = re.compile(r"(?P<names>[A-Za-z_][\w.]*(?:, [A-Za-z_][\w.]*)*) {2,}(?P<text>\S.*)")

# An entry of a section for several names.
_NAMES = re.compile(r"^ +[A-Za-z_]\w*(?:, [A-Za-z_]\w*)+(?=: )")


def process(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Rewrite the lines of a docstring in place."""
    lines[:] = definitions(literal_blocks(joined_names(lines)))


def joined_names(lines: list[str]) -> list[str]:
    """Lines in which several names of one entry (``width, height: ...``) have no spaces: Sphinx takes the first for a type."""
    return [_NAMES.sub(lambda match: match[0].replace(", ", ",\u00a0"), line) for line in lines]


def literal_blocks(lines: list[str]) -> list[str]:
    """Lines in which paragraphs that end in a colon, with an indented block below, announce a literal block."""
    result = []
    for line, blank, below in zip(lines, [*lines[1:], ""], [*lines[2:], "", ""], strict=True):
        indent = len(line) - len(line.lstrip())
        announces = line.endswith(":") and not line.endswith("::") and not blank.strip()
        result.append(f"{line}:" if announces and below.startswith(" " * (indent + 4)) else line)
    return result


def signature(
    app: Sphinx, what: str, name: str, thing: object, options: dict[str, object], arguments: str | None, result: str | None
) -> tuple[str, str | None] | None:
    """No arguments for classes that functions make: those documented with ``:exclude-members: __init__``.

    Defaults that a dataclass makes anew each time are written ``...``; Sphinx cannot read the text that Python has for them.
    """
    if what == "class" and "__init__" in (options.get("exclude-members") or ()):
        return "", result
    return (arguments.replace("<factory>", "..."), result) if arguments else None


def definitions(lines: list[str]) -> list[str]:
    """Lines with items of aligned lists as items of definition lists."""
    result: list[str] = []
    inside = False
    for line in lines:
        item = _ITEM.fullmatch(line)
        if item:
            result += ["", ", ".join(f"``{name}``" for name in item["names"].split(", ")), f"    {item['text']}"]
            inside = True
        elif inside and line.startswith(" "):
            result.append(f"    {line.strip()}")
        else:
            result += ["", line] if inside and line else [line]
            inside = False
    return result


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", process, priority=400)  # before those of sphinx.ext.napoleon
    app.connect("autodoc-process-signature", signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
