"""Wavefront OBJ files: faces with notches, of which loaders make fans that cover the notches, become triangles."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from .polygons import concave, ears


def split_concave_faces(data: bytes) -> bytes:
    """The content of a file with triangles instead of each face that has a corner which points inwards.

    A damaged file stays as it is, for its loader to refuse.
    """
    if b"\0" in data[:4096]:  # UTF-16
        return data
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    try:
        return b"\n".join(_split(lines)) if any(line.lstrip()[:1] == b"f" for line in lines) else data
    except (ValueError, IndexError):
        return data


def _split(lines: list[bytes]) -> list[bytes]:
    places, faces = list[list[bytes]](), defaultdict[int, list[tuple[int, list[bytes], list[int]]]](list)
    for number, line in enumerate(lines):
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            places.append(words[1:4])
        elif words[0] == b"f" and len(words) > 4:
            indices = [int(word.split(b"/")[0]) for word in words[1:]]
            # From 1 on, or backwards from the last vertex before the face.
            faces[len(indices)].append((number, words[1:], [k - 1 if k > 0 else len(places) + k for k in indices]))
    vertices = np.array(places, np.float64)
    for found in faces.values():
        points = vertices[np.array([indices for _, _, indices in found])]
        for face in np.flatnonzero(concave(points)):
            number, words, _ = found[face]
            lines[number] = b"\n".join(b" ".join((b"f", *(words[k] for k in corner))) for corner in ears(points[face]))
    return lines
