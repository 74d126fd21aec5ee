"""Depth peeling: the surfaces of a mesh that a pixel's ray meets, one after the other, front to back.

Source: Everitt, "Interactive Order-Independent Transparency", 2001.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import drjit as dr

from ..jit.arrays import backend
from ..jit.branches import branch
from ..jit.broadcast import Copies, copied
from ..jit.handover import computed
from ..jit.types import Bool, Float, UInt32, UInt64
from .rasterize import check_mesh, check_resolution, located, nearest_fragments, triangle_of
from .types import NO_TRIANGLE, RasterOutput, Records

#: Share of the light; a surface that takes less of it may be left out.
LEAST_LOSS = 1 / 512
#: Share of the light; surfaces that less of it reaches are not counted.
LEAST_LIGHT = 1 / 256
#: A mask (Bool) of the pixels whose surface, a detached :class:`RasterOutput`, counts.
Counts = Callable[[RasterOutput], Bool]


def peeled_layers(
    positions: Float,
    faces: UInt32,
    resolution: tuple[int, int],
    *,
    batch: int = 1,
    layers: int,
    passes: int | None = None,
    counts: Counts | None = None,
) -> list[RasterOutput]:
    """The nearest surface of each pixel, the next one behind it, and so on.

    Args:
        positions: (4 B V,) flat clip-space vertices of ``batch`` images. Attached.
        faces: (3 F,) flat, valid indices.
        resolution: (height, width).
        batch: number of images B.
        layers: number of surfaces that each pixel keeps.
        passes: number of surfaces that each pixel looks at; None for ``layers``. Some of them may not count.
        counts: mask of the surfaces that a pixel keeps; None for all of them.

    Returns:
        One :class:`RasterOutput` for each layer. A pixel with fewer surfaces sees none in the last layers. Barycentrics and
        depths carry gradients to ``positions``, for fixed triangles.
    """
    flat, indices, batch, vertices = check_mesh(positions, faces, batch, False)
    size = (batch, vertices, *check_resolution(resolution))
    with dr.suspend_grad():
        triangles, records = computed(
            "peeled layers", lambda: _peeled(dr.detach(flat), indices, size, layers, passes or layers, counts)
        )
    return [located(flat, indices, triangle, records, *size) for triangle in triangles]


def stacked(layers: Sequence[RasterOutput], positions: Float, faces: UInt32, batch: int) -> tuple[RasterOutput, Float]:
    """(Raster of all images of the first layer, then of the second one, ..., clip-space vertices of all these). Attached.

    Args:
        layers: K of the rasters of :func:`peeled_layers`.
        positions, faces, batch: as given there.
    """
    first, count = layers[0], len(layers)
    if count == 1:
        return first, positions
    (copies,) = dr.custom(Copies, [positions], count, False)
    records = tuple(copied(record, count) for record in first.records)
    triangle = dr.concat([layer.triangle for layer in layers])
    dr.eval(copies, records, triangle)
    size = batch * count, dr.width(positions) // (4 * batch), first.height, first.width
    return located(copies, faces, triangle, cast("Records", records), *size), copies


def _peeled(
    positions: Float, faces: UInt32, size: tuple[int, int, int, int], layers: int, passes: int, counts: Counts | None
) -> tuple[list[UInt32], Records]:
    """(triangle of each pixel in each layer, records of all triangles)."""
    module = backend(positions)
    keys: UInt64 | None = None
    found: list[UInt32] = []
    used = dr.zeros(module.UInt32, size[0] * size[2] * size[3])
    for number in range(passes):
        keys, records = nearest_fragments(positions, faces, *size, behind=keys, peel=True)
        dr.eval(keys)
        triangle = triangle_of(keys)
        if counts is None:
            found.append(triangle)
        else:
            # In a branch: most pixels of scenes with few panes see none of them.
            def keep(triangle: UInt32, records: Records = records) -> Bool:
                return module.Bool(dr.detach(counts(located(positions, faces, triangle, records, *size))))

            lanes = (triangle,)
            kept = branch(triangle != NO_TRIANGLE, keep, lambda triangle: module.Bool(False), lanes, "peeled surface")
            if number < layers:
                found.append(dr.full(module.UInt32, NO_TRIANGLE, dr.width(triangle)))
            found = [dr.select(kept & (used == k), triangle, old) for k, old in enumerate(found)]
            used = used + dr.select(kept, module.UInt32(1), 0)
            dr.eval(found, used)
    return found[:layers], records


def deepest(
    positions: Float,
    faces: UInt32,
    resolution: tuple[int, int],
    *,
    batch: int = 1,
    passed: Callable[[RasterOutput], Float],
    most: int,
) -> tuple[int, int]:
    """(surfaces that take light away, surfaces) along the rays of pixels, at the most. Reads back; detached.

    Args:
        positions, faces, resolution, batch: as of :func:`peeled_layers`.
        passed: share of the light that surfaces let through, 0..1, from a detached :class:`RasterOutput`.
        most: of surfaces that are looked at. Nor are those looked at that hardly any light reaches.
    """
    flat, indices, batch, vertices = check_mesh(positions, faces, batch, False)
    size = (batch, vertices, *check_resolution(resolution))
    module = backend(flat)
    with dr.suspend_grad():
        flat = dr.detach(flat)
        keys: UInt64 | None = None
        used, left = (kind(start) for kind, start in ((module.UInt32, 0), (module.Float, 1)))
        for number in range(most):
            keys, records = nearest_fragments(flat, indices, *size, behind=keys, peel=True)
            seen = located(flat, indices, triangle_of(keys), records, *size)
            through = dr.select(seen.valid, dr.detach(passed(seen)), 1)
            reached = seen.valid & (left > LEAST_LIGHT)
            used = used + dr.select(reached & (through < 1 - LEAST_LOSS), module.UInt32(1), 0)
            left = left * through
            dr.eval(used, left, keys)
            if not dr.any(reached):
                return int(dr.max(used).numpy()[0]), number
    return int(dr.max(used).numpy()[0]), most
