"""A scene file as Mitsuba parses it: which element of which file each parameter comes from."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..errors import ShadowmapError, mitsuba_message
from ..jit.threads import second_thread
from ..scene.mitsuba_objects import children
from ..scene.naming import name_objects
from .xml_text import Element, XmlText


@dataclass(frozen=True)
class Place:
    """Origin of a parameter.

    ``element`` describes the object that has it, or the nearest object around that the file describes; ``path`` leads on from
    there: names of children, and of the parameter.
    """

    text: XmlText
    element: Element
    path: tuple[str, ...]


class ParsedScene:
    """A scene file, loaded, with the texts of all its files.

    Args:
        file: scene file.
        parameters: values of ``$name`` in it.

    Raises:
        ShadowmapError: Mitsuba does not understand the file, or it is no scene.
    """

    def __init__(self, file: Path, parameters: Mapping[str, str]) -> None:
        self.file, self.folder = file, file.parent
        config, state = parsed(file, parameters)
        self.texts = texts_of(state)
        self.defaults = _defaults(self.texts)
        self.constants = {**self.defaults, **parameters}
        self._found: dict[str, tuple[XmlText, Element]] = {}
        counts: dict[str, int] = {}
        # Mitsuba tells by ids which element an object comes from.
        for node in state.nodes:
            kind = node.type.name.lower()
            counts[kind] = counts.get(kind, 0) + 1
            name = node.props.id() or f"{_UNNAMED}{kind}-{counts[kind]}"
            text = self.texts[node.file_index]
            element = text.at(node.offset)
            if element is not None:
                self._found[name] = text, element
            node.props.set_id(name)
        with resolving(self._folders()):
            scene = instantiated(config, state, file)
        self.scene = scene
        self._name_objects()
        self.parameters = mi.traverse(scene)
        self.shapes = {shape.id(): shape for shape in scene.shapes()}

    def place(self, name: str) -> Place | None:
        """The place of a parameter in the files; None if none is found."""
        parts = name.split(".")
        owner: Any = self.parameters.properties[name][2]  # Any: an object of Mitsuba
        while owner is not None:
            parent, depth = self.parameters.hierarchy[owner]
            known = owner.id() if owner.id() in self._found else parts[0] if depth == 1 else ""
            if known in self._found and depth:
                text, element = self._found[known]
                return self._descended(text, element, tuple(parts[depth:]))
            owner = parent
        return None

    def value(self, name: str) -> Any:  # Any: parameters have values of all kinds
        """The value of a parameter; None if there is none of this name, or if it has none, as some of hair have."""
        value, kind, owner, _ = self.parameters.properties.get(name, (None, None, None, 0))
        return value if kind is None else mi.get_property(value, kind, owner)

    def shape(self, name: str) -> mi.Shape | None:
        """The shape of a name: an id, or ``shape_N`` for the N-th one, as scenes have it that Mitsuba itself loads."""
        numbered = {f"shape_{number}": shape for number, shape in enumerate(self.scene.shapes())}
        return self.shapes.get(name) or numbered.get(name)

    def shape_element(self, shape: mi.Shape) -> tuple[XmlText, Element] | None:
        """The element of a shape of the scene."""
        return self._found.get(shape.id())

    def substituted(self, text: str) -> str:
        """A text with the values of ``$name`` in it."""
        return _substituted(text, self.constants)

    def resolved(self, name: str) -> Path | None:
        """The file that a name in the scene means; None if there is none."""
        for folder in self._folders():
            if name and (folder / name).is_file():
                return folder / name
        found = Path(str(mi.file_resolver().resolve(name))) if name else Path()
        return found.absolute() if found.is_file() else None

    def _name_objects(self) -> None:
        """Give objects of the scene the names that they have in a fit."""
        found = [(child, child.id()) for _, child in children(self.scene) if child.id().startswith(_UNNAMED)]
        for child, _ in found:
            child.set_id("")
        name_objects(self.scene)
        for child, name in found:
            if name in self._found:
                self._found[child.id()] = self._found.pop(name)

    def _descended(self, text: XmlText, element: Element, path: tuple[str, ...]) -> Place:
        """The place within nested elements, as far as they are written out: some plug-ins become others, which know no id."""
        while len(path) > 1:
            child = element.named(path[0])
            if child is None:
                free = [one for one in element.children if one.tag in ("texture", "volume") and not one.get("name")]
                child = free[0] if path[0] in ("nested_texture", "texture") and len(free) == 1 else None
            if child is not None and child.tag == "ref":
                referred = self._found.get(self.substituted(child.get("id")))
                if referred is None:
                    break
                text, element, path = *referred, path[1:]
                continue
            if child is None or child.tag not in _PLUGINS or not child.get("type"):
                break
            element, path = child, path[1:]
        return Place(text, element, path)

    def _folders(self) -> list[Path]:
        """Folders in which Mitsuba looks for files."""
        return search_folders(self.texts, self.constants)


def texts_of(state: mi.parser.ParserState) -> list[XmlText]:
    """Texts of all files of a scene, its own first."""
    return [XmlText(Path(str(path))) for path in state.files]


def search_folders(texts: Sequence[XmlText], parameters: Mapping[str, str]) -> list[Path]:
    """Folders in which Mitsuba looks for files that a scene names: its own, and those that it calls ``path``.

    Args:
        texts: of all files of the scene, its own first.
        parameters: values of ``$name`` in them.
    """
    folder, constants = texts[0].path.parent, {**_defaults(texts), **parameters}
    elements = (element for text in texts for element in text.root.walk() if element.tag == "path")
    found = [folder / _substituted(element.get("value"), constants) for element in elements]
    return [*reversed(found), folder]


def _defaults(texts: Sequence[XmlText]) -> dict[str, str]:
    """Values of ``$name`` that files of a scene give themselves, those of the first ones before others."""
    elements = (element for text in reversed(texts) for element in text.root.walk() if element.tag == "default")
    return {element.get("name"): element.get("value") for element in elements}


def _substituted(text: str, constants: Mapping[str, str]) -> str:
    """A text with the values of ``$name`` in it."""
    longest = sorted(constants, key=len, reverse=True)
    pattern = "|".join(re.escape("$" + name) for name in longest)
    return re.sub(pattern, lambda found: constants[found[0][1:]], text) if longest else text


def parsed(file: Path, parameters: Mapping[str, str]) -> tuple[mi.parser.ParserConfig, mi.parser.ParserState]:
    """(configuration, state) of a scene file that Mitsuba has parsed; shapes stay as they are. ShadowmapError if it cannot be."""
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    try:
        with resolving([file.parent]):
            state = mi.parser.parse_file(config, str(file), **parameters)
    except (RuntimeError, TypeError, UnicodeError) as error:
        raise ShadowmapError(f"cannot load {file}: {mitsuba_message(error)}") from error
    # Mitsuba's own writer of scene files writes names instead of ids.
    taken = {node.props.id() for node in state.nodes}
    for key, node in _children_of_root(state):
        if not node.props.id() and not key.startswith("_") and key not in taken:
            node.props.set_id(key)
            taken.add(key)
    return config, state


def _children_of_root(state: mi.parser.ParserState) -> list[tuple[str, Any]]:  # Any: no stub names nodes
    """(key of the scene's property, node) of the objects of a scene."""
    root = state.root.props
    references = [key for key in root.keys() if root.type(key) == mi.Properties.Type.ResolvedReference]
    return [(key, state.nodes[root[key].index()]) for key in references]


def instantiated(config: mi.parser.ParserConfig, state: mi.parser.ParserState, file: Path) -> mi.Scene:
    """The scene of a parsed file. ShadowmapError if it cannot be made, or is none."""
    ids = {key: node.props.id() for key, node in _children_of_root(state)}
    try:
        mi.parser.transform_all(config, state)
        with second_thread():
            scene: Any = mi.parser.instantiate(config, state)  # Any: no stub says it is a scene
    except (RuntimeError, TypeError, UnicodeError) as error:
        raise ShadowmapError(f"cannot load {file}: {mitsuba_message(error)}") from error
    scene = scene[0] if isinstance(scene, list) and len(scene) == 1 else scene
    if not isinstance(scene, mi.Scene):
        raise ShadowmapError(f"cannot load {file}: its root is no scene.")
    # Some plug-ins become others, which know no id.
    for key, name in ids.items():
        child = state.root.props[key]
        if isinstance(child, mi.Object) and not child.id():
            child.set_id(name)
    return scene


@contextlib.contextmanager
def resolving(folders: Sequence[Path]) -> Iterator[None]:
    """Let Mitsuba look for files in folders, the first first."""
    before = mi.file_resolver()
    resolver = mi.FileResolver(before)
    for folder in reversed(folders):
        resolver.prepend(os.fspath(folder))
    mi.set_file_resolver(resolver)
    try:
        yield
    finally:
        mi.set_file_resolver(before)


# Begin of the names of objects that have none.
_UNNAMED = "unnamed-"
# Elements of objects that have parameters.
_PLUGINS = ("bsdf", "emitter", "film", "medium", "phase", "sensor", "shape", "texture", "volume")
