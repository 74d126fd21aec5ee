"""OFF files. Format: Geomview's manual, "OFF files", and the variants that other programs write."""

from __future__ import annotations

import re

import numpy as np
import numpy.typing as npt

from .polygons import triangles

# The keyword, which may stand before the counts without a space; what goes before it says what vertices have.
_KEYWORD = re.compile(r"^\s*(ST)?C?N?(4?n?)OFF(?=\s|\d|$)[ \t]*(BINARY)?", re.MULTILINE)


def parse(data: bytes) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]:
    """(V, 3) vertices and (F, 3) triangles. ValueError, one clause for a message, if the file is damaged."""
    text = re.sub(r"#[^\r\n]*", "", data.decode("ascii", "replace"))
    keyword = _KEYWORD.search(text)  # Geomview does not need it
    if keyword and keyword[2]:
        raise ValueError("its vertices have more than three coordinates: project the mesh into space")
    if keyword and keyword[3]:
        raise ValueError("it is a binary OFF file: export it as text")
    lines = [line.split() for line in text[keyword.end() if keyword else 0 :].splitlines()]
    lines = [line for line in lines if line]
    try:
        vertex_count, face_count = (int(word) for word in lines[0][:2])
        vertices = np.array([line[:3] for line in lines[1 : max(vertex_count, 0) + 1]], np.float64).reshape(-1, 3)
        faces = [[int(word) for word in line[1 : int(line[0]) + 1]] for line in lines[vertex_count + 1 :][: max(face_count, 0)]]
    except (ValueError, IndexError, OverflowError) as error:
        raise ValueError("it is no mesh, or it is damaged") from error
    if (len(vertices), len(faces)) != (vertex_count, face_count):
        raise ValueError(
            f"it is damaged: it announces {vertex_count} vertices and {face_count} faces, but has {len(lines) - 1} lines"
        )
    return vertices, triangles(vertices, faces)
