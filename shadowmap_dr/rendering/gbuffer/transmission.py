"""Light that passes surfaces straight on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from ...jit.types import Bool, Color3f, Float, Point3f, UInt32, Vector3f
from ...raster import LEAST_LOSS, NO_TRIANGLE, RasterOutput
from ...scene.geometry import Geometry
from ...scene.load import SceneData
from ...scene.sensor import Sensor
from ...scene.sums import attached_parameters, evaluate
from ...shadow import Views
from .surface import Surface, normals_at, surface_at
from .surface_points import hits_at
from .translucent_faces import Faces

# More BSDFs are called through pointers.
_MANY_BSDFS = 32


def transmittance_of(seen: Surface, bsdfs: Sequence[mi.BSDF]) -> Color3f:
    """Share of the light (colour, N) that passes surfaces straight on, 0 where there is none. Attached to all.

    ``bsdfs``: all that let light pass.
    """

    def through(own: tuple[mi.SurfaceInteraction3f, mi.BSDFPtr, Bool]) -> Color3f:
        si, pointer, active = own
        if len(bsdfs) > _MANY_BSDFS:
            return mi.UnpolarizedSpectrum(pointer.eval_null_transmission(si, active))
        # One by one: in forward mode Dr.Jit 1.5 fails where several calls through pointers read the same parameter.
        passed = dr.zeros(mi.UnpolarizedSpectrum, dr.width(active))
        for bsdf in bsdfs:
            is_own = active & (pointer == mi.BSDFPtr(bsdf))
            passed = dr.select(is_own, mi.UnpolarizedSpectrum(bsdf.eval_null_transmission(si, is_own)), passed)
        return passed

    passed = evaluate(through, (seen.si, seen.bsdf, seen.active), bsdfs, dr.width(seen.shape))
    return dr.select(seen.active, passed, 0)


def whole_triangles(raster: RasterOutput, faces: Faces) -> UInt32:
    """Triangles of the scene for those of a raster of the translucent faces."""
    hit = raster.triangle != NO_TRIANGLE
    return dr.select(hit, dr.gather(mi.UInt32, faces.index, raster.triangle, hit), NO_TRIANGLE)


def loss_counts(data: SceneData, geometry: Geometry, camera: Sensor, faces: Faces) -> Callable[[RasterOutput], Bool] | None:
    """Mask of surfaces that take some light away, for rasters of the translucent faces; None if all of them count.

    A surface that takes nothing away now may still have a derivative by its opacity: all count where materials are attached.
    """
    if not faces.cutouts or attached_parameters(faces.bsdfs):
        return None

    passed = mean_transmittance(data, geometry, camera, faces)
    # Not "<": broken opacities (NaN) must not look like clear ones.
    return lambda raster: ~(passed(raster) >= 1 - LEAST_LOSS)


def mean_transmittance(data: SceneData, geometry: Geometry, camera: Sensor, faces: Faces) -> Callable[[RasterOutput], Float]:
    """Mean over colours of the share of the light that surfaces let through to a camera, for rasters of translucent faces."""

    def passed(raster: RasterOutput) -> Float:
        return dr.mean(_transmittance(data, geometry, camera, faces, raster, camera.wi_world))

    return passed


def towards_lights(
    data: SceneData, geometry: Geometry, camera: Sensor, faces: Faces
) -> Callable[[RasterOutput, Views], list[Float]]:
    """Function that returns the transmittance (colour channels) of the surfaces that the texels of shadow maps see.

    Its arguments are a raster of the translucent faces, and the light camera of each texel. Attached to the raster, to the
    cameras and to materials. ``camera``: any camera.
    """

    def through(raster: RasterOutput, view: Views) -> list[Float]:
        def towards(p_world: Point3f) -> Vector3f:
            along = dr.cross(mi.Vector3f(view.right), mi.Vector3f(view.up))  # `forward` may be another axis for depths
            way = dr.select(view.spread > 0, mi.Vector3f(view.origin) - mi.Vector3f(p_world), -along)
            length = dr.norm(way)
            return way / dr.select(length > 0, length, 1)

        passed = _transmittance(data, geometry, camera, faces, raster, towards)
        return [passed[k] for k in range(dr.size_v(mi.UnpolarizedSpectrum))]

    return through


def _transmittance(
    data: SceneData,
    geometry: Geometry,
    camera: Sensor,
    faces: Faces,
    raster: RasterOutput,
    towards: Callable[[Point3f], Vector3f],
) -> Color3f:
    """Transmittance (colour, N) of the surfaces in a raster of the translucent faces. ``towards``: directions from points."""
    hits = hits_at(geometry, whole_triangles(raster, faces), raster.u, raster.v)
    hits = replace(hits, wi_world=towards(hits.p_world))
    seen = surface_at(data, geometry, camera, hits, *normals_at(geometry, hits), frames=faces.cutouts)
    return transmittance_of(seen, faces.bsdfs)
