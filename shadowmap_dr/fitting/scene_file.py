"""The fitted scene as a file: the user's own XML, with the values that a fit has changed, and files beside it."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..errors import OutputError, ShadowmapError, mitsuba_message
from ..io.files import atomic, make_folder, no_file
from ..scene.load import named_shapes
from .changes import Array, Changes
from .parsed_scene import ParsedScene
from .scene_edits import FILES_FOLDER, Step, Unwritable, is_close, numbers_of
from .shape_edits import MeshStep, TransformStep, mapped, vertices_of
from .value_edits import ValueStep
from .xml_text import Element, XmlText, tag


@dataclass
class Written:
    """Results of :func:`write_fitted_scene`: the files, the scene first, and notes about what could not be written."""

    files: list[Path] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def write_fitted_scene(
    scene_file: Path | Mapping[str, Any],
    parameters: Mapping[str, str],
    changes: Changes,
    out: Path,
    *,
    names: Sequence[str] = (),
    copy_files: bool = False,
) -> Written:
    """Write ``out/scene.xml``: a scene file with new values.

    All else stays as it is: comments, ``$name``, included files, ids. ``parameters`` become the defaults of their names.
    Textures, meshes and included files lie in ``out/scene_files``; other files are named by relative paths. Mitsuba then loads
    the result, and every value is compared. A value that could not be written is left as it was, and a note names it.

    Args:
        scene_file: the scene's file; or its dictionary for ``mi.load_dict``, which must have no objects of Mitsuba's in it.
        parameters: values of ``$name``, with which the scene was loaded.
        changes: new values.
        out: folder.
        names: names of ``mi.traverse(scene)``, all and in order. Needed for changes of objects without id: Mitsuba names them by
            their place in memory.
        copy_files: copy files that the scene names into ``out/scene_files``, too.

    Raises:
        ShadowmapError: Mitsuba does not understand the scene file.
        OutputError: A file cannot be written, or the scene file would be overwritten.
    """
    target = Path(out).absolute() / SCENE_NAME
    make_folder(target.parent / FILES_FOLDER)
    if isinstance(scene_file, Mapping):
        with tempfile.TemporaryDirectory() as folder:
            file = _written_dictionary(scene_file, Path(folder))
            return _Writer(ParsedScene(file, {}), {}, target, copy_files, names).write(changes)
    file = Path(scene_file).absolute()
    if not file.is_file():
        raise no_file("scene", scene_file)
    if target.exists() and target.samefile(file):
        raise OutputError(f"cannot write {target}: the scene itself would be overwritten; give another folder.")
    return _Writer(ParsedScene(file, parameters), parameters, target, copy_files, names).write(changes)


#: The scene file in the folder that is written.
SCENE_NAME = "scene.xml"


class _Writer:
    def __init__(
        self, parsed: ParsedScene, parameters: Mapping[str, str], target: Path, copy_files: bool, names: Sequence[str]
    ) -> None:
        self.names = dict(zip(names, parsed.parameters.keys(), strict=True)) if len(names) == len(parsed.parameters) else {}
        self.changed: set[str] = set()
        self.parsed, self.parameters, self.target, self.copy_files = parsed, parameters, target, copy_files
        self.folder = target.parent / FILES_FOLDER
        self.included = self._included()
        self.files: list[Path] = []
        self.taken: set[str] = set()
        #: Files of all attempts; names of the steps that were written last, and the scene read with them.
        self.all_files: set[Path] = set()
        self._last: tuple[list[str], ParsedScene] | None = None

    def write(self, changes: Changes) -> Written:
        """Write all changes that can be, and check what has been written."""
        notes: dict[str, str] = {}
        steps = self._loadable(self._steps(changes, notes), notes)
        for _ in range(3):
            differing = self._differences(steps, notes)
            if not differing:
                break
            for name, reason in differing.items():
                value = numbers_of(self.parsed.value(name))
                if name in steps:
                    notes[name] = reason
                    del steps[name]
                elif name not in notes and value is not None and value.size <= 16:
                    # It follows from others where the file does not tell it, so the file has to.
                    steps[name] = ValueStep(name, name, value, self.parsed)
                else:
                    notes.setdefault(name, reason)
        else:
            notes = self._differences(steps, notes) | notes
        for path in self.all_files - set(self.files):
            path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # it has files
            (self.target.parent / FILES_FOLDER).rmdir()
        listed = [f"{name} could not be written into the scene file: {reason}." for name, reason in notes.items()]
        return Written([self.target, *self.files], listed)

    # ------------------------------------------------------------------------------------------------------------------ steps

    def _steps(self, changes: Changes, notes: dict[str, str]) -> dict[str, Step]:
        """One step for each change, by its name."""
        parsed, steps = self.parsed, dict[str, Step]()
        meshes: dict[str, MeshStep] = {}
        for name, points in changes.vertices.items():
            shape = parsed.shape(name)
            if shape is None:
                notes[f"{name}:vertices"] = self._no_shape(name)
            elif not isinstance(shape, mi.Mesh):
                notes[f"{name}:vertices"] = f"the shape is a {shape.class_name()}, no mesh"
            else:
                meshes[name] = MeshStep(name, shape, np.asarray(points, np.float32).reshape(-1, 3), {})
        for given, value in changes.values.items():
            name = self.names.get(given, given)
            if name not in parsed.parameters:
                texture = f"{name.removesuffix('.data')}.value"
                if not (name.endswith(".data") and texture in parsed.parameters and np.ndim(value) == 3):
                    notes[name] = "the scene file has no such parameter"
                    continue
                key = texture
            else:
                key = name
            owner = parsed.parameters.properties[key][2]
            last = key.rpartition(".")[2]
            if isinstance(owner, mi.Mesh) and last.startswith(("vertex_", "face_")):
                shape_name = next((shown for shown, shape in parsed.shapes.items() if shape == owner), None)
                if shape_name is None:
                    notes[name] = "its shape is part of a shape group"
                    continue
                step = meshes.setdefault(shape_name, MeshStep(shape_name, owner, None, {}))
                if last in ("vertex_positions", "positions"):
                    step.vertices = np.asarray(value, np.float32).reshape(-1, 3)
                else:
                    step.attributes[last] = np.asarray(value, np.float32).ravel()
            else:
                steps[name] = ValueStep(name, key, np.asarray(value), parsed)
        for name, matrix in changes.transforms.items():
            shape = parsed.shape(name)
            if shape is None:
                self._move_instance(name, changes.transforms, steps, notes)
            elif name in meshes:
                if meshes[name].vertices is None:
                    meshes[name].vertices = mapped(np.asarray(matrix, np.float64), vertices_of(shape))
            else:
                steps[f"{name}:pose"] = TransformStep(name, shape, np.asarray(matrix, np.float64))
        return steps | {f"{name}:vertices": step for name, step in meshes.items()}

    def _move_instance(self, name: str, transforms: Mapping[str, Array], steps: dict[str, Step], notes: dict[str, str]) -> None:
        """Add the step of the instance that a shape is a part of, if all of its parts move alike."""
        instances = {part: instance for part, _, instance in named_shapes(self.parsed.scene) if instance is not None}
        instance, matrix = instances.get(name), np.asarray(transforms[name], np.float64)
        parts = [part for part, other in instances.items() if instance is not None and other == instance]
        if instance is None:
            notes[f"{name}:pose"] = self._no_shape(name)
        elif not all(part in transforms and np.array_equal(transforms[part], matrix) for part in parts):
            notes[f"{name}:pose"] = f"other parts of {instance.id()!r} do not move along, but instances move as a whole"
        else:
            steps[f"{instance.id()}:pose"] = TransformStep(instance.id(), instance, matrix)

    def _no_shape(self, name: str) -> str:
        instance = next((known for known in self.parsed.shapes if name.startswith(f"{known}.")), None)
        if instance is not None:
            return f"it is a part of {instance!r}, which other instances may share"
        return f"the scene has no such shape, only {', '.join(map(repr, self.parsed.shapes)) or 'none'}"

    def _loadable(self, steps: dict[str, Step], notes: dict[str, str]) -> dict[str, Step]:
        """The steps after which Mitsuba still loads the scene. Where it does not, they are halved: each try loads the scene."""
        kept, waiting = dict[str, Step](), [list(steps)]
        while waiting:
            names = [name for name in waiting.pop() if name not in notes]
            try:
                self._read(kept | {name: steps[name] for name in names}, notes)
            except ShadowmapError as error:
                if not names or len(names) == len(steps):
                    self._read(kept, notes)  # raises if it is not the changes that are at fault
                if len(names) > 1:
                    half = len(names) // 2
                    waiting += [names[half:], names[:half]]
                    continue
                reason = mitsuba_message(error.__cause__ or error).rstrip(".!")
                notes[names[0]] = f"Mitsuba refuses the file with it: {re.sub(r'^At .*?[)]: ', '', reason)}"
            kept |= {name: steps[name] for name in names if name not in notes}
        return kept

    def _read(self, steps: Mapping[str, Step], notes: dict[str, str]) -> ParsedScene:
        """Write all files with some steps, and read them again."""
        known = len(notes)
        if self._last is None or self._last[0] != list(steps):
            self._last = None
            self._build(steps, notes)
            self._last = list(steps), ParsedScene(self.target, {})
        written = self._last[1]
        if len(notes) > known:  # a step that failed has perhaps been written in parts
            self._last = None
        return written

    def _differences(self, steps: Mapping[str, Step], notes: dict[str, str]) -> dict[str, str]:
        """Reasons by names of changes that Mitsuba does not find in the written file; of other parameters, too."""
        written, found = self._read(steps, notes), dict[str, str]()
        for name, step in steps.items():
            try:
                reason = step.difference(self.parsed, written)
            except (KeyError, ValueError, RuntimeError, TypeError, Unwritable) as error:
                reason = f"it could not be read again ({type(error).__name__})"
            if reason:
                found[name] = reason
        moved = {step.owner for step in steps.values()}
        for key in self.parsed.parameters.keys():
            if key in written.parameters and not any(key == one or key.startswith(f"{one}.") for one in moved):
                before, after = (numbers_of(one.value(key)) for one in (self.parsed, written))
                if before is not None and after is not None and not is_close(after, before):
                    found.setdefault(key, "it is another value there, though the fit has not changed it")
        return found

    # ------------------------------------------------------------------------------------------------------------------ files

    def _build(self, steps: Mapping[str, Step], notes: dict[str, str]) -> None:
        """Write all files, with the changes of some steps. A change that cannot be expressed is noted."""
        for text in self.parsed.texts:
            text.undo()
        self.files, self.taken = [], set()
        self.changed = {step.owner for step in steps.values()}
        self._relocate()
        for name, step in steps.items():
            try:
                step.apply(self)
            except Unwritable as error:
                notes[name] = str(error)
        for text, path in self.included.items():
            self._write_bytes(self.folder / path, text.edited())
        self._write_bytes(self.target, self.parsed.texts[0].edited(), listed=False)
        self.all_files |= set(self.files)

    def _write_bytes(self, path: Path, data: bytes, listed: bool = True) -> None:
        with atomic(path) as temporary:
            temporary.write_bytes(data)
        if listed:
            self.files.append(path)

    def new_file(self, stem: str, suffix: str) -> Path:
        """A file in the folder, with a name that is not taken."""
        base = re.sub(r"[^\w.+-]+", "_", stem, flags=re.ASCII).strip("._") or "unnamed"
        name, number = base + suffix, 2
        while name.lower() in self.taken | {one.lower() for one in self.included.values()}:
            name, number = f"{base}_{number}{suffix}", number + 1
        self.taken.add(name.lower())
        self.files.append(self.folder / name)
        return self.folder / name

    def _included(self) -> dict[XmlText, str]:
        """Names of copies of all included files."""
        found: dict[XmlText, str] = {}
        for text in self.parsed.texts[1:]:
            name, number = text.path.name, 2
            while name.lower() in {one.lower() for one in found.values()}:
                name, number = f"{text.path.stem}_{number}{text.path.suffix}", number + 1
            found[text] = name
        return found

    def _relocate(self) -> None:
        """Let names of files lead from the new folder to where they lie, and let defaults be the given parameters."""
        parsed, main = self.parsed, self.parsed.texts[0]
        order = iter(parsed.texts[1:])
        self._relocate_includes(main, order)
        for text in parsed.texts:
            for element in text.root.walk():
                if element.tag == "default" and element.get("name") in self.parameters:
                    text.set(element, value=self.parameters[element.get("name")])
                elif element.tag == "path":
                    text.replace(element, None)
        for name, value in self.parameters.items():
            if name not in parsed.defaults:
                text_of = tag("default", {"name": name, "value": value})
                main.prepend(main.root, text_of)
        for text in parsed.texts:
            for element in text.root.walk():
                attribute = _file_attribute(element)
                if attribute:
                    self._relocate_file(text, element, attribute)

    def _relocate_includes(self, text: XmlText, order: Any) -> None:  # Any: elements of a parser without stubs
        for element in text.root.walk():
            if element.tag == "include":
                inner = next(order, None)
                if inner is not None:
                    text.set(element, filename=f"{FILES_FOLDER}/{self.included[inner]}")
                    self._relocate_includes(inner, order)

    def _relocate_file(self, text: XmlText, element: Element, attribute: str) -> None:
        given = element.get(attribute)
        if Path(self.parsed.substituted(given)).is_absolute() and not self.copy_files:
            return
        path = self.parsed.resolved(self.parsed.substituted(given))
        if path is None:
            return
        name = self._name_of(path)
        alone = re.fullmatch(r"\$(\w+)", given)
        if alone and self._only_files(alone[1]):
            for other in self.parsed.texts:
                for one in other.root.walk():
                    if one.tag == "default" and one.get("name") == alone[1]:
                        other.set(one, value=name)
            if alone[1] in self.parsed.defaults:
                return
        text.set(element, **{attribute: name})

    def _only_files(self, name: str) -> bool:
        """True if a constant stands for names of files only, and alone."""
        for text in self.parsed.texts:
            for element in text.root.walk():
                for attribute, value in element.attributes.items():
                    if f"${name}" in value and (value != f"${name}" or attribute != _file_attribute(element)):
                        return False
        return True

    def _name_of(self, path: Path) -> str:
        """The name of a file in the written scene."""
        if self.copy_files:
            copy = self.new_file(path.stem, path.suffix)
            try:
                shutil.copyfile(path, copy)
            except OSError as error:
                raise OutputError(f"cannot write {copy}: {error.strerror or error}.") from error
            return f"{FILES_FOLDER}/{copy.name}"
        try:
            # A link keeps its own name, which may have the suffix that tells its format.
            return Path(os.path.relpath(path.parent.resolve() / path.name, self.target.parent.resolve())).as_posix()
        except ValueError:  # of another drive
            return path.as_posix()


def _file_attribute(element: Element) -> str:
    """The attribute of an element that names a file; empty if none does."""
    if element.tag == "string" and element.get("name").lower().endswith("filename"):
        return "value"
    return "filename" if element.tag == "spectrum" and element.get("filename") else ""


def _written_dictionary(description: Mapping[str, Any], folder: Path) -> Path:
    """The scene file of a dictionary for ``mi.load_dict``."""
    path = folder / SCENE_NAME
    try:
        state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), dict(description))
        mi.parser.write_file(state, str(path))
    except (RuntimeError, TypeError, UnicodeError) as error:
        raise ShadowmapError(
            f"the scene's dictionary cannot be written as a file: {mitsuba_message(error)} Describe its parts by dictionaries."
        ) from error
    text = XmlText(path)
    for child in text.root.children:
        if child.get("name") and child.get("type"):  # by which Mitsuba calls the parts of a dictionary
            text.set(child, id=child.get("id") or child.get("name"), name=None)
    path.write_bytes(text.edited())
    return path
