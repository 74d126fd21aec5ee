"""PLY files that trimesh refuses: comments that are not UTF-8, and binary lists of different lengths.

Format: Greg Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .polygons import triangles

_TYPES = {
    **{"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"},
    **{"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"},
}
_LEAST_HEADER, _MOST_HEADER = b"ply", 1 << 20


@dataclass(frozen=True)
class Property:
    """A property of an element: its type as of `struct`; of lists also the type of the length."""

    name: str
    kind: str
    length: str = ""


@dataclass(frozen=True)
class Element:
    """Vertices, faces or others: how many there are, and what each has."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def least_bytes(self) -> int:
        """Bytes that one of them takes at least in a binary file."""
        return sum(struct.calcsize("=" + (prop.length or prop.kind)) for prop in self.properties)


@dataclass(frozen=True)
class Ply:
    """A file: byte order (empty for text), elements, and the bytes after the header."""

    order: str
    elements: tuple[Element, ...]
    header: bytes
    body: bytes

    @property
    def cleaned(self) -> bytes:
        """The file without comments."""
        return self.header + self.body


def parse(data: bytes) -> Ply:
    """Read the header. ValueError, one clause for a message, if there is none, or if the file is too short for it."""
    end = data.find(b"end_header", 0, _MOST_HEADER)
    if not data.startswith(_LEAST_HEADER) or end < 0:
        raise ValueError("it has no header of a PLY file")
    # What ends the last line of the header ends all of its lines; data may begin with any byte.
    at = end + len(b"end_header")
    at += 2 if data[at : at + 2] == b"\r\n" else 1
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    order, elements = "", list[Element]()
    try:
        for line in lines[1:]:
            if line[0] == "format":
                order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[line[1]]
            elif line[0] == "element":
                elements.append(Element(line[1], int(line[2]), ()))
            elif line[0] == "property":
                last = elements.pop()
                own = (
                    Property(line[4], _TYPES[line[3]], _TYPES[line[2]])
                    if line[1] == "list"
                    else Property(line[2], _TYPES[line[1]])
                )
                elements.append(Element(last.name, last.count, (*last.properties, own)))
    except (KeyError, IndexError, ValueError) as error:
        raise ValueError("its header is damaged") from error
    header = "\n".join(" ".join(line) for line in [*lines, ["end_header"], []]).encode("ascii", "replace")
    ply = Ply(order, tuple(elements), header, data[at:])
    for element in elements:
        # A number and a space or the end of the line for each property of text files.
        least = max(1, element.least_bytes if order else 2 * len(element.properties) - 1)
        if element.count < 0 or element.count * least > len(ply.body) + 1:
            raise ValueError(
                f"its header announces {element.count} of the element {element.name!r}, which take {element.count * least} "
                f"bytes; {len(ply.body)} follow"
            )
    return ply


def binary_mesh(ply: Ply) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """(V, 3) vertices and (F, 3) triangles of a binary file. ValueError if the file is too short."""
    at, tables = 0, dict[str, dict[str, list[tuple[float, ...]]]]()
    for element in ply.elements:
        if element.name not in ("vertex", "face") and not any(prop.length for prop in element.properties):
            at += element.count * element.least_bytes
            continue
        columns: dict[str, list[tuple[float, ...]]] = {prop.name: [] for prop in element.properties}
        try:
            for _ in range(element.count):
                for prop in element.properties:
                    count = 1
                    if prop.length:
                        (count,) = struct.unpack_from(ply.order + prop.length, ply.body, at)
                        at += struct.calcsize("=" + prop.length)
                    layout = f"{ply.order}{count}{prop.kind}"
                    columns[prop.name].append(struct.unpack_from(layout, ply.body, at))
                    at += struct.calcsize(layout)
        except struct.error as error:
            raise ValueError("it is cut") from error
        tables[element.name] = columns
    faces = tables.get("face", {})
    lists = faces.get("vertex_indices") or faces.get("vertex_index") or []
    vertices = tables.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertices):
        raise ValueError("its vertices have no x, y and z")
    points = np.concatenate([np.array(vertices[axis], np.float64).reshape(-1, 1) for axis in "xyz"], axis=1)
    return points, triangles(points, [[int(corner) for corner in face] for face in lists])
