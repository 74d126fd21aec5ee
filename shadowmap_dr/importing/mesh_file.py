"""A mesh with normals, texture coordinates and colours as a PLY file that Mitsuba reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..io.files import atomic
from .model import Part


def write_mesh(path: Path, part: Part) -> None:
    """Write binary PLY with Mitsuba's names: x y z, nx ny nz, u v, r g b (which becomes ``vertex_color``).

    Raises OutputError if the file cannot be written.
    """
    columns: list[tuple[str, ...]] = [("x", "y", "z")]
    values = [part.vertices]
    for names, array in ((("nx", "ny", "nz"), part.normals), (("u", "v"), part.texcoords), (("r", "g", "b"), part.colours)):
        if array is not None:
            columns.append(names)
            values.append(array)
    header = [
        *("ply", "format binary_little_endian 1.0"),
        f"element vertex {len(part.vertices)}",
        *(f"property float {name}" for names in columns for name in names),
        f"element face {len(part.faces)}",
        *("property list uchar int vertex_indices", "end_header", ""),
    ]
    faces = np.empty(len(part.faces), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, part.faces
    with atomic(path) as temporary, temporary.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(np.concatenate(values, axis=1).astype("<f4").tobytes())
        file.write(faces.tobytes())
