"""Scenes with something broken in them, by name. Run as a script with names as arguments: renders them, one line each."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

SIZE = 16
NAN, INF = float("nan"), float("inf")


def look_at(origin: list[float], target: list[float], up: list[float]) -> Any:
    return mi.ScalarTransform4f().look_at(origin, target, up)


def film(size: int = SIZE) -> dict[str, Any]:
    return {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}


def camera(**changes: Any) -> dict[str, Any]:
    return {"type": "perspective", "fov": 45, "to_world": look_at([2, -3, 4], [0, 0, 0], [0, 0, 1]), "film": film(), **changes}


def scene(**changes: Any) -> Any:
    """A cube over a floor in the sun, with other parts; None leaves one out."""
    parts: dict[str, Any] = {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 1]).scale(0.4)},
        "camera": camera(),
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": 2.0},
        **changes,
    }
    return mi.load_dict({k: v for k, v in parts.items() if v is not None}, optimize=False)


def mesh(positions: Any, faces: Any, name: str = "broken") -> Any:
    made = mi.Mesh(name, len(positions), len(faces))
    params = mi.traverse(made)
    params["vertex_positions"] = mi.Float(np.asarray(positions, np.float32).ravel())
    params["faces"] = mi.UInt32(np.asarray(faces, np.uint32).ravel())
    params.update()
    return made


def smooth() -> Any:
    """A triangle with normals and texture coordinates."""
    made = mi.Mesh("smooth", 3, 1, has_vertex_normals=True, has_vertex_texcoords=True)
    return with_parameters(
        made,
        vertex_positions=mi.Float(np.ravel(TRIANGLE)),
        vertex_normals=mi.Float([0, 0, 1] * 3),
        vertex_texcoords=mi.Float([0, 0, 1, 0, 0, 1]),
        faces=mi.UInt32([0, 1, 2]),
    )


def with_parameters(made: Any, **values: Any) -> Any:
    """A scene whose parameters were set later; ``__`` in names stands for a dot."""
    later(**values)(made)
    return made


def later(**values: Any) -> Callable[[Any], None]:
    """Sets parameters of a scene."""

    def change(made: Any) -> None:
        params = mi.traverse(made)
        for name, value in values.items():
            params[name.replace("__", ".")] = value
        params.update()

    return change


def picture(value: Any, height: int = 2, width: int = 2) -> Any:
    data = np.ones((height, width, 3), np.float32)
    data[0, 0] = value
    return mi.Bitmap(data)


def texture(value: Any) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": picture(value), "raw": True}


def overhead(**changes: Any) -> dict[str, Any]:
    return {"to_world": look_at([0.3, 0.2, 3], [0, 0, 0], [0, 1, 0]), **changes}


def lamp(radiance: Any = 5.0, to_world: Any = None, **changes: Any) -> dict[str, Any]:
    place = look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]) @ mi.ScalarTransform4f().scale(0.5)
    shape = {"type": "rectangle", "to_world": to_world or place, **changes}
    return {**shape, "glow": {"type": "area", "radiance": radiance}}


def singular() -> Any:
    return mi.ScalarTransform4f().translate([0, 0, 1]) @ mi.ScalarTransform4f().scale([1, 0, 1])


TRIANGLE = [[-1, -1, 1.0], [1, -1, 1.0], [0, 1, 1.0]]
NOT_FINITE = [[-1, -1, 1.0], [1, NAN, 1.0], [0, 1, 1.0]]

#: What comes of a scene: a finite image, one that is not finite where it shows what is not finite, an error of this library, or
#: an error of Mitsuba's own, which does not load it.
IMAGE, PARTLY, ERROR, NOT_LOADED = "image", "partly", "error", "not loaded"

#: Name -> (makes the scene, or a pair of it and of what happens to it between two images; what comes of it).
CASES: dict[str, tuple[Callable[[], Any], str]] = {
    "plain": (lambda: scene(), IMAGE),
    # ------------------------------------------------------------------------------------------------------------- geometry
    "vertex_nan": (lambda: scene(box=mesh(NOT_FINITE, [[0, 1, 2]])), ERROR),
    "vertex_inf": (lambda: scene(box=mesh([[-1, -1, 1], [INF, 0, 1], [0, 1, 1]], [[0, 1, 2]])), ERROR),
    "vertex_nan_later": (
        lambda: with_parameters(scene(box=mesh(TRIANGLE, [[0, 1, 2]])), box__vertex_positions=mi.Float(np.ravel(NOT_FINITE))),
        ERROR,
    ),
    "vertex_nan_between": (
        lambda: (scene(box=mesh(TRIANGLE, [[0, 1, 2]])), later(box__vertex_positions=mi.Float(np.ravel(NOT_FINITE)))),
        ERROR,
    ),
    "all_vertices_nan_between": (
        lambda: (scene(box=mesh(TRIANGLE, [[0, 1, 2]])), later(box__vertex_positions=mi.Float([NAN] * 9))),
        ERROR,
    ),
    "vertex_huge_between": (
        lambda: (scene(box=mesh(TRIANGLE, [[0, 1, 2]])), later(box__vertex_positions=mi.Float(np.ravel(TRIANGLE) * 1e30))),
        IMAGE,
    ),
    "collapsed_between": (
        lambda: (scene(box=mesh(TRIANGLE, [[0, 1, 2]])), later(box__vertex_positions=mi.Float([0, 0, 1] * 3))),
        IMAGE,
    ),
    "huge_floor": (lambda: scene(floor={"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([1e20, 1e20, 1])}), IMAGE),
    "empty": (lambda: scene(box=mi.Mesh("empty", 0, 0)), ERROR),
    "no_faces": (lambda: scene(box=mesh(TRIANGLE, np.zeros((0, 3)))), ERROR),
    "normals_nan": (lambda: scene(box=with_parameters(smooth(), vertex_normals=mi.Float([NAN] * 9))), IMAGE),
    "normals_zero": (lambda: scene(box=with_parameters(smooth(), vertex_normals=mi.Float([0] * 9))), IMAGE),
    "texcoords_nan": (lambda: scene(box=with_parameters(smooth(), vertex_texcoords=mi.Float([NAN] * 6))), IMAGE),
    "no_area": (lambda: scene(box=mesh([[0, 0, 1]] * 3, [[0, 1, 2], [0, 0, 0]])), IMAGE),
    "one_vertex_triangle": (lambda: scene(box=mesh(TRIANGLE, [[0, 1, 2], [1, 1, 1], [0, 1, 1]])), IMAGE),
    "all_without_area": (lambda: scene(box=None, floor=mesh([[0, 0, 0]] * 3, [[0, 1, 2]])), ERROR),
    "huge": (lambda: scene(box=mesh(np.multiply(TRIANGLE, 1e20), [[0, 1, 2]])), IMAGE),
    "far_away": (lambda: scene(box={"type": "cube", "to_world": mi.ScalarTransform4f().translate([1e20, 0, 0])}), IMAGE),
    "tiny": (lambda: scene(box=mesh(np.multiply(TRIANGLE, 1e-30), [[0, 1, 2]])), IMAGE),
    "flat_sphere": (lambda: scene(box={"type": "sphere", "to_world": mi.ScalarTransform4f().scale([1, 1, 1e-12])}), IMAGE),
    "singular_cube": (lambda: scene(box={"type": "cube", "to_world": singular()}), IMAGE),
    "singular_sphere": (lambda: scene(box={"type": "sphere", "to_world": singular()}), IMAGE),
    "singular_rectangle": (lambda: scene(box={"type": "rectangle", "to_world": singular()}), IMAGE),
    "no_radius": (lambda: scene(box={"type": "sphere", "radius": 0.0}), IMAGE),
    "behind_camera": (lambda: scene(camera=camera(to_world=look_at([0, 0, 9], [0, 0, 20], [0, 1, 0]))), IMAGE),
    # -------------------------------------------------------------------------------------------------------------- cameras
    "no_fov": (lambda: scene(camera=camera(fov=0.0)), NOT_LOADED),
    "orthographic_singular": (
        lambda: scene(camera={"type": "orthographic", "to_world": singular(), "film": film()}),
        IMAGE,
    ),
    "one_pixel": (lambda: scene(camera=camera(film=film(1))), IMAGE),
    "narrow": (lambda: scene(camera=camera(fov=1e-4)), IMAGE),
    "wide": (lambda: scene(camera=camera(fov=179.9)), IMAGE),
    "up_parallel": (lambda: scene(camera=camera(to_world=look_at([0, 0, 4], [0, 0, 0], [0, 0, 1]))), IMAGE),
    "camera_singular": (lambda: scene(camera=camera(to_world=singular())), NOT_LOADED),
    "camera_in_box": (lambda: scene(camera=camera(to_world=look_at([0, 0, 1], [0, 0, 0], [0, 1, 0]))), IMAGE),
    "camera_on_vertex": (lambda: scene(camera=camera(to_world=look_at([0.4, 0.4, 1.4], [0, 0, 0], [0, 1, 0]))), IMAGE),
    "camera_at_nan": (
        lambda: with_parameters(scene(), camera__to_world=mi.Transform4f(mi.Matrix4f(NAN))),
        IMAGE,
    ),
    # --------------------------------------------------------------------------------------------------------------- lights
    "sun_nan": (lambda: with_parameters(scene(), sun__irradiance__value=mi.Float(NAN)), PARTLY),
    "sun_nan_between": (lambda: (scene(), later(sun__irradiance__value=mi.Float(NAN))), PARTLY),
    "sun_without_direction_between": (lambda: (scene(), later(sun__to_world=mi.Transform4f(mi.Matrix4f(0)))), PARTLY),
    "sun_at_nan_between": (lambda: (scene(), later(sun__to_world=mi.Transform4f(mi.Matrix4f(NAN)))), PARTLY),
    "point_at_nan_between": (
        lambda: (
            scene(sun={"type": "point", "position": [1, 0, 3], "intensity": 5.0}),
            later(sun__position=mi.Point3f(NAN, 0, 0)),
        ),
        PARTLY,
    ),
    "sun_negative": (lambda: with_parameters(scene(), sun__irradiance__value=mi.Float(-3.0)), IMAGE),
    "point_at_nan": (lambda: scene(sun={"type": "point", "position": [NAN, 0, 3], "intensity": 5.0}), PARTLY),
    "point_in_box": (lambda: scene(sun={"type": "point", "position": [0, 0, 1], "intensity": 5.0}), IMAGE),
    "point_on_floor": (lambda: scene(sun={"type": "point", "position": [0.5, 0.2, 0], "intensity": 5.0}), IMAGE),
    "point_on_vertex": (lambda: scene(sun={"type": "point", "position": [0.4, 0.4, 1.4], "intensity": 5.0}), IMAGE),
    "point_far_away": (lambda: scene(sun={"type": "point", "position": [0, 0, 1e20], "intensity": 5.0}), IMAGE),
    "point_negative": (lambda: scene(sun={"type": "point", "position": [1, 0, 2], "intensity": -5.0}), IMAGE),
    "spot_singular": (lambda: scene(sun={"type": "spot", "to_world": singular()}), IMAGE),
    "spot_up_parallel": (
        lambda: scene(sun={"type": "spot", "intensity": 5.0, "to_world": look_at([0, 0, 4], [0, 0, 0], [0, 0, 1])}),
        IMAGE,
    ),
    "spot_no_angle": (lambda: scene(sun={"type": "spot", "cutoff_angle": 0.0, **overhead()}), IMAGE),
    "spot_no_angle_between": (
        lambda: (scene(sun={"type": "spot", **overhead()}), later(sun__cutoff_angle=mi.Float(0))),
        IMAGE,
    ),
    "spot_nan_angle_between": (
        lambda: (scene(sun={"type": "spot", **overhead()}), later(sun__cutoff_angle=mi.Float(NAN))),
        IMAGE,
    ),
    "spot_no_falloff": (lambda: scene(sun={"type": "spot", "cutoff_angle": 20.0, "beam_width": 20.0, **overhead()}), IMAGE),
    "spot_texture_nan": (lambda: scene(sun={"type": "spot", "texture": texture(NAN), **overhead()}), PARTLY),
    "projector_singular": (
        lambda: scene(sun={"type": "projector", "irradiance": texture(1), "fov": 40, "to_world": singular()}),
        IMAGE,
    ),
    "projector_nan": (lambda: scene(sun={"type": "projector", "irradiance": texture(NAN), "fov": 40, **overhead()}), PARTLY),
    "projector_narrow": (lambda: scene(sun={"type": "projector", "irradiance": texture(1), "fov": 1e-4, **overhead()}), IMAGE),
    "projector_wide": (lambda: scene(sun={"type": "projector", "irradiance": texture(1), "fov": 179.0, **overhead()}), IMAGE),
    # ------------------------------------------------------------------------------------------------------ extended lights
    "lamp": (lambda: scene(lamp=lamp()), IMAGE),
    "lamp_black": (lambda: scene(sun=None, lamp=lamp(0.0)), IMAGE),
    "lamp_negative": (lambda: scene(sun=None, lamp=lamp(-1.0)), IMAGE),
    "lamp_nan": (lambda: scene(lamp=lamp(texture(NAN))), ERROR),
    "lamp_no_area": (lambda: scene(lamp=lamp(to_world=mi.ScalarTransform4f().translate([0, 0, 3]).scale(1e-20))), IMAGE),
    "lamp_singular": (lambda: scene(lamp=lamp(to_world=singular())), IMAGE),
    "lamp_collapses_between": (
        lambda: (scene(lamp=lamp()), later(lamp__to_world=mi.Transform4f(singular()))),
        IMAGE,
    ),
    "lamp_vertex_nan_between": (
        lambda: (scene(lamp=lamp(**{"type": "cube"})), later(lamp__vertex_positions=mi.Float([NAN] * 72))),
        ERROR,
    ),
    "lamp_nan_between": (
        lambda: (scene(lamp=lamp()), later(lamp__emitter__radiance__value=mi.Color3f(NAN))),
        IMAGE,
    ),
    "lamp_on_floor": (lambda: scene(lamp=lamp(to_world=mi.ScalarTransform4f().scale(0.5))), IMAGE),
    "lamp_alone": (lambda: scene(box=None, floor=None, lamp=lamp()), IMAGE),
    "lamp_ball_no_radius": (
        lambda: scene(lamp={"type": "sphere", "center": [0, 0, 3], "radius": 0.0, "glow": {"type": "area", "radiance": 5.0}}),
        IMAGE,
    ),
    "beam_nan": (lambda: scene(lamp={**lamp(), "glow": {"type": "directionalarea", "radiance": texture(NAN)}}), PARTLY),
    "beam_singular": (lambda: scene(lamp={**lamp(to_world=singular()), "glow": {"type": "directionalarea"}}), IMAGE),
    "sky_one_pixel": (lambda: scene(sky={"type": "envmap", "bitmap": picture(2, 1, 1)}), IMAGE),
    "sky_four_pixels": (lambda: scene(sky={"type": "envmap", "bitmap": picture(2)}), IMAGE),
    "sky_black": (lambda: scene(sky={"type": "envmap", "bitmap": mi.Bitmap(np.zeros((4, 8, 3), np.float32))}), IMAGE),
    "sky_nan": (lambda: scene(sky={"type": "envmap", "bitmap": picture(NAN, 4, 8)}), ERROR),
    "sky_inf": (lambda: scene(sky={"type": "envmap", "bitmap": picture(INF, 4, 8)}), ERROR),
    "sky_singular": (lambda: scene(sky={"type": "envmap", "bitmap": picture(1, 4, 8), "to_world": singular()}), ERROR),
    "constant_black": (lambda: scene(sky={"type": "constant", "radiance": 0.0}), IMAGE),
    "constant_negative": (lambda: with_parameters(scene(sky={"type": "constant"}), sky__radiance__value=mi.Float(-1)), IMAGE),
    # ------------------------------------------------------------------------------------------------------------ materials
    "albedo_nan": (lambda: scene(box={"type": "cube", "bsdf": {"type": "diffuse", "reflectance": texture(NAN)}}), PARTLY),
    "opacity_nan": (
        lambda: scene(box={"type": "cube", "bsdf": {"type": "mask", "opacity": texture(NAN), "b": {"type": "diffuse"}}}),
        PARTLY,
    ),
}


def result_of(name: str) -> str:
    """One line about what comes of a case, with the kind of result first, or ``unexpected``."""
    from shadowmap_dr import ShadowmapError

    make, _ = CASES[name]
    try:
        made = make()
    except Exception as error:
        return f"{NOT_LOADED}: {str(error).splitlines()[-1]}"
    made, change = made if isinstance(made, tuple) else (made, None)
    options = {"soft_map_resolution": 32, "area_light_samples": 4, "environment_light_samples": 8, "shadow_map_resolution": 64}
    integrator = mi.load_dict({"type": "shadowmap", **options})
    try:
        if change is not None:
            mi.render(made, integrator=integrator).numpy()
            change(made)
        return _image(made, integrator)
    except Exception as error:
        trace = traceback.format_exc()
        while error.__cause__ is not None or error.__context__ is not None:
            error = error.__cause__ or error.__context__  # Dr.Jit wraps what an integrator raises
        if isinstance(error, ShadowmapError) and "\n" not in str(error):
            return f"{ERROR}: {error}"
        return f"unexpected {type(error).__name__}: {error} {trace.splitlines()}"


def _image(made: Any, integrator: Any) -> str:
    params = mi.traverse(made)
    key = next((k for k in ("floor.to_world", "floor.vertex_positions") if k in params), None)
    x = mi.Float(0)
    dr.enable_grad(x)
    if key == "floor.to_world":
        params[key] = mi.Transform4f().translate([x, 0, 0.1 * x]) @ mi.Transform4f(params[key])
    params.update()
    image = mi.render(made, params, integrator=integrator)
    values = image.numpy()
    share = np.isfinite(values).mean()
    text = f"{share:.3f} finite, mean {values[np.isfinite(values)].mean() if share > 0 else NAN:.3g}"
    if share < 1:
        return f"{PARTLY}: {text}" if share > 0 else f"unexpected: {text}"
    if dr.grad_enabled(image):
        dr.backward(dr.sum(image))
        if not np.isfinite(dr.grad(x).numpy()).all():
            return f"unexpected: {text}, gradient {dr.grad(x)}"
    return f"{IMAGE}: {text}"


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    import shadowmap_dr  # noqa: F401  (registers the integrator)

    for case in sys.argv[1:] or CASES:
        # Before, too: a crash leaves the name of what caused it.
        print(f"\n@{case}", flush=True)
        print(f"@{case} {result_of(case)}", flush=True)
