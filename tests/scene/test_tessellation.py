"""Meshes of analytic shapes by themselves: closed where the shape is."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.raster.topology import NO_VERTEX, build_topology
from shadowmap_dr.scene.shapes import tessellation


@pytest.mark.parametrize("segments", [3, 16, 63])
@pytest.mark.parametrize(("kind", "rims"), [("sphere", 0), ("disk", 1), ("cylinder", 2)])
def test_shapes_are_open_at_their_rims_only(variant: str, kind: str, rims: int, segments: int) -> None:
    mesh = getattr(tessellation, kind)(segments)
    opposite = build_topology(mesh.faces, mesh.positions, mi.UInt32).opposite.numpy().reshape(-1, 2)
    assert np.sum(opposite[:, 1] == NO_VERTEX) == rims * segments
