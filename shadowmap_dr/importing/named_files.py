"""Files that a model names: libraries of materials, and pictures. trimesh is silent about missing ones; here they are noted."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from trimesh.resolvers import FilePathResolver

from ..errors import ShadowmapError, shortened
from ..io.images import check_size

# Options before the name of a picture in a library, such as `-s 2 2 1` or `-clamp on`.
_OPTIONS = re.compile(r"^(?:-[a-z]\w*(?:\s+(?:on|off|[-+.\d]\S*|[rgbmlz](?=\s)))*\s+)+", re.IGNORECASE)
_LIBRARY, _PICTURES = ".mtl", (".bmp", ".gif", ".jpeg", ".jpg", ".png", ".tga", ".tif", ".tiff", ".webp")


class NamedFiles(FilePathResolver):
    """Files beside a model, found as its exporter may have written them: with options, backslashes or folders of another machine.

    Args:
        model: path of the model file.

    Attributes:
        notes: clauses about files that are missing or damaged, and about options.
    """

    def __init__(self, model: Path) -> None:
        super().__init__(str(model))
        self.notes: list[str] = []

    def get(self, name: str) -> bytes:
        """The content of a file.

        Raises:
            FileNotFoundError: there is none of this name, or it is no picture.
        """
        plain = name.strip().strip('"')
        options = _OPTIONS.match(plain)
        if options is not None and not Path(self.parent, plain).is_file():
            plain = plain[options.end() :].strip()
            self._note(f"the options '{shortened(options[0].strip(), 40)}' of '{shortened(plain, 60)}' are left out")
        found = self._found(plain) or self._found(unquote(plain))  # glTF's names are parts of URLs
        is_library = plain.lower().endswith(_LIBRARY)
        if found is None and is_library and len(parts := re.findall(r"\S.*?\.mtl(?=\s|$)", plain, re.IGNORECASE)) > 1:
            return self._joined(parts)
        if found is None:
            left_out = "materials are" if is_library else "a picture is"
            self._note(f"{left_out} left out: there is no file '{shortened(plain, 60)}'")
            raise FileNotFoundError(plain)
        data = found.read_bytes()
        if plain.lower().endswith(_PICTURES):
            self._check_picture(found, data)
        return data

    def _joined(self, libraries: Sequence[str]) -> bytes:
        """The content of all libraries that are there."""
        found = []
        for name in libraries:
            with contextlib.suppress(FileNotFoundError):
                found.append(self.get(name))
        if not found:
            raise FileNotFoundError(libraries[0])
        return b"\n".join(found)

    def _found(self, name: str) -> Path | None:
        """The file of a name: as it is, or of the same name beside the model, capitals or not."""
        folder, path = Path(self.parent), PurePosixPath(name.replace("\\", "/"))
        for candidate in (folder / path, folder / str(path).lstrip("/"), folder / path.name):
            if path.name and candidate.is_file():
                return candidate
        alike = (folder / path).parent
        folders = [one for one in (alike, folder) if one.is_dir()]
        return next((file for one in folders for file in sorted(one.iterdir()) if _is_alike(file, path.name)), None)

    def _check_picture(self, file: Path, data: bytes) -> None:
        """FileNotFoundError for a file that Pillow cannot read: trimesh would leave it out silently."""
        from PIL import Image

        try:
            picture = Image.open(io.BytesIO(data))
            check_size(str(file), picture.width, picture.height, 4)
            picture.load()
        except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, ShadowmapError) as error:
            self._note(
                f"the picture '{shortened(file.name, 60)}' is left out: it is damaged, too large, or no picture that Pillow reads"
            )
            raise FileNotFoundError(file.name) from error

    def _note(self, words: str) -> None:
        if words not in self.notes:
            self.notes.append(words)


def _is_alike(file: Path, name: str) -> bool:
    return bool(name) and file.name.lower() == name.lower() and file.is_file()


def with_one_library(data: bytes) -> bytes:
    """The content of an OBJ file with all its libraries of materials in one line: trimesh reads the first line alone."""
    lines = re.findall(rb"^[ \t]*mtllib[ \t]+(.*?)[ \t]*\r?$", data, re.MULTILINE)
    if len(set(lines)) < 2:
        return data
    rest = re.sub(rb"^[ \t]*mtllib[ \t].*$", b"", data, flags=re.MULTILINE)
    return b"mtllib " + b" ".join(dict.fromkeys(lines)) + b"\n" + rest
