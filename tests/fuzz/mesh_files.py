"""Files of meshes in all formats, as sound as programs write them."""

from __future__ import annotations

import functools
import struct

import numpy as np
import numpy.typing as npt
import trimesh

CORNERS = [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)]
QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
TRIANGLES = [face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))]


@functools.cache
def files() -> dict[str, tuple[str, bytes]]:
    """Suffix and content of a file of a cube of side 2, by a name."""
    cube = trimesh.Trimesh(CORNERS, TRIANGLES, process=False)
    made = {
        "stl": (".stl", cube.export(file_type="stl")),
        "ascii stl": (".stl", cube.export(file_type="stl_ascii")),
        "off": (".off", cube.export(file_type="off")),
        "glb": (".glb", cube.export(file_type="glb")),
        "obj": (".obj", cube.export(file_type="obj")),
        "obj of quads": (".obj", _obj()),
        "ply": (".ply", cube.export(file_type="ply")),
        "ascii ply": (".ply", cube.export(file_type="ply", encoding="ascii")),
        "ply of both": (".ply", _ply("<")),
        "big-endian ply": (".ply", _ply(">")),
    }
    return {name: (suffix, data.encode() if isinstance(data, str) else bytes(data)) for name, (suffix, data) in made.items()}


def _obj() -> bytes:
    lines = [
        "# caf\u00e9",
        "mtllib none.mtl",
        "o cube",
        *(f"v {x} {y} {z}" for x, y, z in CORNERS),
        "vn 0 0 1",
        "vt 0 0",
        "usemtl a",
    ]
    lines += ["f " + " ".join(f"{i + 1}/1/1" for i in face) for face in QUADS[:3]]
    lines += ["f " + " ".join(f"{i - 8}//1" for i in face) for face in QUADS[3:]]
    return "\n".join(lines).encode() + b"\n"


def _ply(order: str) -> bytes:
    """Triangles and quads in one list, with further properties and a comment that is not UTF-8."""
    faces = [*QUADS[:3], *TRIANGLES[6:]]
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    header = (
        f"ply\nformat {form} 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\n"
    )
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    data = b"".join(struct.pack(f"{order}3dB", *corner, 7) for corner in CORNERS)
    for face in faces:
        data += struct.pack(f"{order}B{len(face)}i", len(face), *face) + struct.pack(f"{order}B2f", 2, 0.5, 0.5)
    return header.encode() + b"comment caf\xe9\nend_header\n" + data


def is_cube(vertices: npt.ArrayLike, faces: npt.ArrayLike) -> bool:
    """True if a mesh is the cube."""
    cube = trimesh.Trimesh(vertices, faces, process=False)
    return bool(len(cube.vertices) == 8 and abs(cube.volume - 8) < 1e-3 and np.allclose(np.abs(cube.vertices), 1, atol=1e-5))
