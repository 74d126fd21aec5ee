"""XML files that are edited in place: all that is not changed stays byte for byte, comments and blanks included."""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from ..errors import ShadowmapError

# The encoding that a file declares.
_DECLARED = re.compile(rb"""(\s*<\?xml[^>]*?encoding\s*=\s*["'])([\w.-]+)(["'])""")


@dataclass(eq=False)
class Element:
    """An element of a file. Bytes: ``start`` of its tag, ``inner`` of its content, ``close`` of its end tag, ``end`` behind it.

    An element of one tag, ``<a/>``, has all three behind the tag.
    """

    tag: str
    attributes: dict[str, str]
    start: int
    parent: Element | None
    inner: int = 0
    close: int = 0
    end: int = 0
    children: list[Element] = field(default_factory=list)

    def walk(self) -> Iterator[Element]:
        """The element and all within it, in the order of the file."""
        yield self
        for child in self.children:
            yield from child.walk()

    def get(self, name: str) -> str:
        """An attribute; empty if there is none."""
        return self.attributes.get(name, "")

    def named(self, name: str) -> Element | None:
        """The child with that ``name``, also where it is written as in old scenes, with capitals instead of underscores."""
        return next((child for child in self.children if snake_case(child.get("name")) == name), None)


class XmlText:
    """The text of an XML file, its elements, and edits of it.

    Args:
        path: of the file.

    Raises:
        ShadowmapError: The file cannot be read, or is no well-formed XML.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._attributes: dict[Element, dict[str, str | None]] = {}
        self._appended: dict[Element, list[str]] = {}
        self._prepended: dict[Element, list[str]] = {}
        self._replaced: dict[Element, str | None] = {}
        try:
            self.data = _as_utf8(path.read_bytes())
            self.root = _parsed(self.data)
        except OSError as error:
            raise ShadowmapError(f"cannot read {path}: {error.strerror or error}.") from error
        except (expat.ExpatError, UnicodeError, LookupError) as error:
            raise ShadowmapError(f"cannot read {path}: it is no well-formed XML: {error}.") from error
        self._by_start = {element.start: element for element in self.root.walk()}

    def at(self, offset: int) -> Element | None:
        """The element whose name stands at a byte, counted with or without a byte order mark."""
        return self._by_start.get(offset - 1) or self._by_start.get(offset - 4)

    # --------------------------------------------------------------------------------------------------------------- edits

    def set(self, element: Element, **attributes: str | None) -> None:
        """Set attributes; None removes one."""
        self._attributes.setdefault(element, {}).update(attributes)

    def append(self, element: Element, xml: str) -> None:
        """Add an element, given as text without indentation, behind the content of another."""
        self._appended.setdefault(element, []).append(xml)

    def prepend(self, element: Element, xml: str) -> None:
        """Add an element, given as text without indentation, before the content of another."""
        self._prepended.setdefault(element, []).append(xml)

    def replace(self, element: Element, xml: str | None) -> None:
        """Replace an element by another, given as text without indentation; None removes it."""
        self._replaced[element] = xml

    def is_removed(self, element: Element) -> bool:
        """True if an edit has removed an element."""
        return element in self._replaced and self._replaced[element] is None

    def undo(self) -> None:
        """Forget all edits."""
        for edits in (self._attributes, self._appended, self._prepended, self._replaced):
            edits.clear()

    def edited(self) -> bytes:
        """The text with all edits, UTF-8."""
        head = _DECLARED.sub(rb"\1utf-8\3", self.data[: self.root.start], count=1)
        return head + self._rendered(self.root) + self.data[self.root.end :]

    def _rendered(self, element: Element) -> bytes:
        if element in self._replaced:
            return _indented(self._replaced[element] or "", self._indent(element)).encode()
        tag = self.data[element.start : element.inner]
        for name, value in self._attributes.get(element, {}).items():
            tag = _with_attribute(tag, name, value)
        added, before = self._appended.get(element, []), self._prepended.get(element, [])
        if tag.endswith(b"/>") and not added and not before:
            return tag
        content, at = b"", element.inner
        for child in element.children:
            between = self.data[at : child.start]
            content += between.rstrip(b" \t\r\n") if self.is_removed(child) else between
            content += self._rendered(child)
            at = child.end
        content += self.data[at : element.close]
        closing = self.data[element.close : element.end]
        if tag.endswith(b"/>"):
            tag, closing = tag[:-2].rstrip() + b">", f"</{element.tag}>".encode()
        if not added and not before:
            return tag + content + closing
        outer = self._indent(element)
        first = next((child for child in element.children if self._starts_line(child)), None)
        inner = self._indent(first) if first else outer + "    "
        head, tail = ("".join(f"\n{inner}{_indented(xml, inner)}" for xml in texts).encode() for texts in (before, added))
        if not added:
            return tag + head + content + closing
        return tag + head + content.rstrip(b" \t\r\n") + tail + f"\n{outer}".encode() + closing

    def _indent(self, element: Element) -> str:
        """Blanks before the line in which an element begins."""
        line = self.data.rfind(b"\n", 0, element.start) + 1
        found = re.match(rb"[ \t]*", self.data[line : element.start])
        return found[0].decode() if found else ""

    def _starts_line(self, element: Element) -> bool:
        return not self.data[self.data.rfind(b"\n", 0, element.start) + 1 : element.start].strip()


def tag(name: str, attributes: Mapping[str, str], *content: str) -> str:
    """Text of an element with attributes, and with other elements in it, one in a line."""
    start = " ".join([name, *(f"{key}={quoteattr(value)}" for key, value in attributes.items())])
    if not content:
        return f"<{start}/>"
    lines = ["    " + line for text in content for line in text.split("\n")]
    return "\n".join([f"<{start}>", *lines, f"</{name}>"])


def snake_case(name: str) -> str:
    """A name as Mitsuba writes it since version 2: ``toWorld`` becomes ``to_world``."""
    return re.sub(r"(?<=[a-z0-9])([A-Z])", lambda found: "_" + found[1].lower(), name)


def _as_utf8(data: bytes) -> bytes:
    """The text of a file in UTF-8, without byte order mark. A declaration of another encoding is left."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16").encode()
    declared = _DECLARED.match(data.removeprefix(codecs.BOM_UTF8))
    if declared is None or data.startswith(codecs.BOM_UTF8):
        return data.decode("utf-8-sig").encode()
    return data.decode(declared[2].decode()).encode()


def _parsed(data: bytes) -> Element:
    parser = expat.ParserCreate("utf-8")
    stack: list[Element] = []
    roots: list[Element] = []

    def start(name: str, attributes: dict[str, str]) -> None:
        at = parser.CurrentByteIndex
        element = Element(name, attributes, at, stack[-1] if stack else None, _tag_end(data, at))
        (stack[-1].children if stack else roots).append(element)
        stack.append(element)

    def end(name: str) -> None:
        element, at = stack.pop(), parser.CurrentByteIndex
        if data[element.inner - 2 : element.inner] == b"/>":
            element.close = element.end = element.inner
        else:
            element.close, element.end = at, data.index(b">", at) + 1

    parser.StartElementHandler, parser.EndElementHandler = start, end
    parser.Parse(data, True)
    return roots[0]


def _tag_end(data: bytes, start: int) -> int:
    """Byte behind the tag that begins at one."""
    found = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""").match(data, start)
    assert found is not None  # expat has read the tag
    return found.end()


def _with_attribute(tag: bytes, name: str, value: str | None) -> bytes:
    """A tag with an attribute set, added or removed."""
    pattern = re.compile(rb"""\s+""" + re.escape(name.encode()) + rb"""\s*=\s*("[^"]*"|'[^']*')""")
    text = b"" if value is None else f" {name}={quoteattr(value)}".encode()
    if pattern.search(tag):
        return pattern.sub(lambda _: text, tag, count=1)
    close = b"/>" if tag.endswith(b"/>") else b">"
    return tag[: -len(close)].rstrip() + text + close


def _indented(xml: str, indent: str) -> str:
    return xml.replace("\n", "\n" + indent)
