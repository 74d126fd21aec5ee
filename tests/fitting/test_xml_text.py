"""Edits of XML: what is not edited stays byte for byte."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.xml_text import XmlText, snake_case, tag

TEXT = """<?xml version="1.0"?>
<!-- first --><a x = '1>2' y="&quot;&#228;">
    <b name="one"/>   <!-- <b name="no"/> -->
    <c name="two"><![CDATA[<d/>]]><b name="three" /></c>
</a>
<!-- last -->
"""


def parsed(folder: Path, text: str = TEXT) -> XmlText:
    (folder / "a.xml").write_bytes(text.encode())
    return XmlText(folder / "a.xml")


def test_elements(tmp_path: Path) -> None:
    text = parsed(tmp_path)
    assert [element.tag for element in text.root.walk()] == ["a", "b", "c", "b"]
    assert text.root.attributes == {"x": "1>2", "y": '"ä'}
    for element in text.root.walk():
        assert text.at(element.start + 1) is element
        assert text.data[element.start : element.end].decode().startswith(f"<{element.tag}")
    assert text.edited() == TEXT.encode()


def test_edits(tmp_path: Path) -> None:
    text = parsed(tmp_path)
    one, two = text.root.children
    text.set(text.root, x="<&'\"", y=None, z="new")
    text.replace(one, tag("e", {"name": "é"}, tag("f", {})))
    text.append(two.children[0], tag("g", {"h": "1"}))
    text.append(text.root, tag("last", {}))
    text.prepend(text.root, tag("first", {}))
    result = text.edited().decode()
    root = ElementTree.fromstring(result)
    assert root.attrib == {"x": "<&'\"", "z": "new"}
    assert [child.tag for child in root] == ["first", "e", "c", "last"]
    assert root.find("e/f") is not None and root.find("c/b/g").attrib == {"h": "1"}  # type: ignore[union-attr]
    for kept in ("<!-- first -->", '<!-- <b name="no"/> -->', "<![CDATA[<d/>]]>", "<!-- last -->", '<b name="three">'):
        assert kept in result
    text.replace(two, None)
    assert "CDATA" not in text.edited().decode()
    text.undo()
    assert text.edited() == TEXT.encode()


def test_indentation(tmp_path: Path) -> None:
    text = parsed(tmp_path, '<a>\n  <b x="1"/>\n</a>\n')
    text.append(text.root.children[0], tag("c", {}, tag("d", {})))
    text.append(text.root, tag("e", {}))
    assert text.edited().decode() == '<a>\n  <b x="1">\n      <c>\n          <d/>\n      </c>\n  </b>\n  <e/>\n</a>\n'


_NAMES = st.sampled_from(["a", "bc", "d_e"])
_VALUES = st.text(st.characters(blacklist_categories=("Cs", "Cc")), max_size=6)


_ATTRIBUTES = st.dictionaries(_NAMES, _VALUES)
_TREES = st.recursive(
    st.tuples(_NAMES, _ATTRIBUTES, st.just([])),
    lambda inner: st.tuples(_NAMES, _ATTRIBUTES, st.lists(inner, max_size=3)),
    max_leaves=8,
)


@given(_TREES, _VALUES)
@settings(max_examples=60, deadline=None)
def test_any_attribute_of_any_tree(tmp_path_factory: pytest.TempPathFactory, tree: tuple, value: str) -> None:
    def element(node: tuple) -> ElementTree.Element:
        made = ElementTree.Element(node[0], node[1])
        made.extend(element(child) for child in node[2])
        return made

    expected = element(tree)
    folder = tmp_path_factory.mktemp("xml")
    text = parsed(folder, ElementTree.tostring(expected, encoding="unicode"))
    for mine, theirs in zip(text.root.walk(), expected.iter(), strict=True):
        assert (mine.tag, mine.attributes) == (theirs.tag, theirs.attrib)
        text.set(mine, bc=value)
        theirs.set("bc", value)
    again = ElementTree.fromstring(text.edited())
    assert [(one.tag, one.attrib) for one in again.iter()] == [(one.tag, one.attrib) for one in expected.iter()]


@pytest.mark.parametrize("data", [b"", b"<a>", b"<a></b>", b"<a>\xff</a>", b'<?xml version="1.0" encoding="none"?><a/>', b"text"])
def test_bad_files(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "a.xml").write_bytes(data)
    with pytest.raises(ShadowmapError, match="it is no well-formed XML") as caught:
        XmlText(tmp_path / "a.xml")
    assert "\n" not in str(caught.value)
    with pytest.raises(ShadowmapError, match="cannot read .*none.xml: No such file"):
        XmlText(tmp_path / "none.xml")


def test_names_of_old_scenes() -> None:
    assert [snake_case(name) for name in ("toWorld", "to_world", "intIOR", "alphaU")] == [
        "to_world",
        "to_world",
        "int_iOR",
        "alpha_u",
    ]
