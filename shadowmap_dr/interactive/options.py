"""Options of the command `model`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..errors import ShadowmapError, did_you_mean
from ..io.options import option
from ..io.ranges import check_ranges
from . import exports

#: For each view, the light's direction, and the direction that is up in the shadow image.
VIEWS = {"front": ((0, 0, -1), (0, 1, 0)), "side": ((-1, 0, 0), (0, 1, 0)), "top": ((0, -1, 0), (0, 0, -1))}


@dataclass(frozen=True)
class ModelOptions:
    """Options of a session."""

    serve: bool = option(False, help="Paint in the browser instead of in an image file.")
    port: int = option(8711, allowed=(0, 65535), help="Port of the page on 127.0.0.1; 0 for any free one.")
    image: Path = option(Path("shadow.png"), help="Image of the shadow (.png), to edit in a paint program.")
    output: Path = option(Path("model.ply"), names=("-o", "--output"), help=f"Mesh to write: .{', .'.join(exports.FORMATS)}.")
    view: str = option("front", choices=VIEWS, help="Side that the light comes from.")
    resolution: int = option(256, allowed=(32, 512), help="Pixels along each side of the shadow.")
    smoothness: float = option(20.0, allowed=(0.0, 1e6), help="Stiffness of the mesh; finer meshes need more.")
    step_size: float = option(0.2, allowed=(1e-6, 100.0), help="Length of a step.")

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.view not in VIEWS:
            raise ShadowmapError(f"no view {self.view!r}: choose from {', '.join(VIEWS)}.{did_you_mean(self.view, VIEWS)}")
