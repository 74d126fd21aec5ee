"""The whole of a fit's inputs: scene, pictures and options; as a file, fit.toml."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from ..errors import ShadowmapError, did_you_mean, quoted
from .options import FitOptions
from .targets import MOST_EXPOSED, Target, read_target
from .vary import Vary

_KEYS = {"scene", "parameters", "target"}


@dataclass(frozen=True)
class PictureFile:
    """A picture file: its sensor's number, a mask, and its exposure where that is known (a factor)."""

    file: str
    sensor: int = 0
    mask: str | None = None
    exposure: float = 1.0

    def read(self) -> Target:
        """Read the picture."""
        return read_target(self.file, self.mask, sensor=self.sensor, exposure=self.exposure)


@dataclass(frozen=True)
class FitTask:
    """Inputs of a fit.

    Attributes:
        scene: scene file, or name of a scene of this package.
        parameters: values of ``$name`` in the scene file.
        pictures: the pictures.
        options: all else.
    """

    scene: str
    parameters: Mapping[str, str] = field(default_factory=dict)
    pictures: Sequence[PictureFile] = ()
    options: FitOptions = field(default_factory=FitOptions)

    def plain(self) -> dict[str, Any]:
        """The task as the entries of fit.toml, without those that are as usual."""
        options = {}
        for option in fields(FitOptions):
            value = getattr(self.options, option.name)
            if option.name != "vary" and value != option.default:
                options[option.name] = value
        pictures = [
            {one.name: getattr(picture, one.name) for one in fields(picture) if getattr(picture, one.name) != one.default}
            for picture in self.pictures
        ]
        return {
            "scene": self.scene,
            **options,
            "target": pictures,
            "vary": [vary.plain() for vary in self.options.vary],
            **({"parameters": dict(self.parameters)} if self.parameters else {}),
        }


def read_task(path: Path) -> FitTask:
    """Read a fit.toml. Names of files in it are relative to its folder.

    Raises:
        ShadowmapError: The file cannot be read, has keys that are not known, or values of another kind; with the key.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeError) as error:
        raise ShadowmapError(f"cannot read {path}: {getattr(error, 'strerror', None) or 'it is no text'}.") from error
    tomllib = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also integers of thousands of digits
        raise ShadowmapError(f"cannot read {path}: {' '.join(str(error).split())}.") from error
    return _Reader(path).task(content)


def _as_float(value: int) -> float:
    """An integer as a float; infinite beyond the largest one."""
    try:
        return float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


class _Reader:
    """Conversion of a TOML document, with messages that name the file and the key."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def task(self, content: Mapping[str, Any]) -> FitTask:
        known = {option.name: option for option in fields(FitOptions)}
        self._known(content, [*_KEYS, *known], "")
        scene = self._text(content.get("scene"), "scene")
        # A scene of this package has a name that is no file.
        scene = self._beside(scene) if scene.endswith(".xml") else scene
        parameters = self._table(content.get("parameters", {}), "parameters")
        values = {}
        for name, option in known.items():
            if name in content and name != "vary":
                values[name] = self._kind(content[name], option.default, name)
        vary = [self._vary(entry) for entry in self._list(content.get("vary", []), "vary")]
        pictures = [self._picture(entry) for entry in self._list(content.get("target", []), "target")]
        try:
            options = FitOptions(vary=tuple(vary), **values)
        except ShadowmapError as error:
            raise ShadowmapError(f"{self.path}: {error}") from error
        return FitTask(scene, {key: str(value) for key, value in parameters.items()}, pictures, options)

    def _picture(self, entry: Any) -> PictureFile:  # Any: TOML
        if isinstance(entry, str):
            entry = {"file": entry}
        table = self._table(entry, "target")
        self._known(table, [one.name for one in fields(PictureFile)], "target: ")
        picture = PictureFile(self._beside(self._text(table.get("file"), "target: file")))
        if "mask" in table:
            picture = replace(picture, mask=self._beside(self._text(table["mask"], "target: mask")))
        for name in ("sensor", "exposure"):
            if name in table:
                picture = replace(picture, **{name: self._kind(table[name], getattr(picture, name), f"target: {name}")})
        if not 0 < picture.exposure <= MOST_EXPOSED:
            raise ShadowmapError(
                f"{self.path}: target: exposure is {picture.exposure:g}; give a positive number up to {MOST_EXPOSED:g}."
            )
        return picture

    def _vary(self, entry: Any) -> Vary:  # Any: TOML
        try:
            return Vary.of(entry)
        except ShadowmapError as error:
            raise ShadowmapError(f"{self.path}: {error}") from error

    def _beside(self, name: str) -> str:
        """A file's name, relative to the folder of the document."""
        return name if Path(name).is_absolute() else str(self.path.parent / name)

    def _known(self, table: Mapping[str, Any], known: Sequence[str], where: str) -> None:
        for key in table:
            if key not in known:
                raise ShadowmapError(f"{self.path}: {where}there is no key {quoted(key)}.{did_you_mean(key, known)}")

    def _kind(self, value: Any, like: Any, name: str) -> Any:  # Any: TOML
        if like is MISSING:
            return value
        fits = isinstance(value, type(like)) and isinstance(value, bool) == isinstance(like, bool)
        if isinstance(like, float) and isinstance(value, int) and not isinstance(value, bool):
            return _as_float(value)
        if not fits:
            raise ShadowmapError(f"{self.path}: {name} is {quoted(value)}; give a value like {like!r}.")
        return value

    def _text(self, value: Any, name: str) -> str:  # Any: TOML
        if not isinstance(value, str) or not value:
            raise ShadowmapError(
                f"{self.path}: {name} is {'missing' if value is None else quoted(value)}; give a text in quotes."
            )
        return value

    def _table(self, value: Any, name: str) -> Mapping[str, Any]:  # Any: TOML
        if not isinstance(value, Mapping):
            raise ShadowmapError(f"{self.path}: {name} is {quoted(value)}; give a table.")
        return value

    def _list(self, value: Any, name: str) -> Sequence[Any]:  # Any: TOML
        if not isinstance(value, list):
            raise ShadowmapError(f"{self.path}: {name} is {quoted(value)}; give a list, or [[{name}]].")
        return value
