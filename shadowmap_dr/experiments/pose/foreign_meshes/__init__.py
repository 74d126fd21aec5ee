"""Meshes as users bring them, made from formulas: thin bars, plates with rims, loose parts, needles, plants of single faces.

None is symmetric about the vertical axis, nor nearly so within the range of the starts: such an object has no pose to be found.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ....io.files import make_folder
from .blocks import chair, crystals, fence, letters, sponge, stairs
from .machine_parts import bracket, cad_plate, flange, gear, heat_sink, loose_parts, screw
from .parts import Mesh
from .plants import grass, palm, tree
from .rough_surfaces import dense_scan, foil, rock, terrain
from .thin_bars import antenna, bicycle, crane, frame, lattice, net, tangle, urchin, wheel

#: Makers by name.
MAKERS: dict[str, Callable[[], Mesh]] = {
    maker.__name__.replace("_", "-"): maker
    for maker in (
        antenna, bicycle, bracket, cad_plate, chair, crane, crystals, dense_scan, fence, flange, foil, frame, gear, grass,
        heat_sink, lattice, letters, loose_parts, net, palm, rock, screw, sponge, stairs, tangle, terrain, tree, urchin, wheel,
    )
}  # fmt: skip
#: Meshes that are written as STL, without common vertices.
UNWELDED = ("bracket", "cad-plate", "flange", "gear", "loose-parts")


def write(name: str, folder: Path) -> Path:
    """Write a mesh of `MAKERS` into a folder, as PLY or STL. Returns its file."""
    import trimesh

    path = folder / f"{name}.{'stl' if name in UNWELDED else 'ply'}"
    make_folder(folder)
    vertices, faces = MAKERS[name]()
    trimesh.Trimesh(vertices, faces, process=False).export(path)
    return path
