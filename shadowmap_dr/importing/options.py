"""Options of an import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..errors import ShadowmapError
from ..io.options import option
from ..io.ranges import check_ranges


@dataclass(frozen=True)
class ImportOptions:
    """Options of an import: all of them add to a model what it lacks."""

    up: Literal["y", "z"] = option("y", help="Axis that points upwards, for what is added: camera, sun, floor.")
    size: int = option(512, allowed=(1, 16384), help="Pixels along the longer side of pictures.")
    normals: Literal["auto", "smooth", "flat"] = option(
        "auto", help="Shading of meshes without normals; auto: flat for glTF and STL, smooth for the others."
    )
    daylight: bool = option(True, help="Add a sun and a dim sky to a model without lights.")
    floor: bool = option(False, help="Add a grey floor below the model, for its shadow.")

    def __post_init__(self) -> None:
        check_ranges(self)
        for name, known in (("up", ("y", "z")), ("normals", ("auto", "smooth", "flat"))):
            if getattr(self, name) not in known:
                raise ShadowmapError(f"{name} is {getattr(self, name)!r}: give one of {', '.join(known)}.")
