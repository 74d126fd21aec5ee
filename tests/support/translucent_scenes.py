"""Small scenes with translucent surfaces, and their path-traced references."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

Spec = dict[str, Any]


def veil(opacity: Any, colour: tuple[float, float, float] = (0.2, 0.4, 0.6)) -> Spec:
    """A diffuse surface that lets a share of the light pass straight on."""
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}
    return {"type": "mask", "opacity": opacity, "nested": {"type": "twosided", "nested": diffuse}}


def glass(*tint: float) -> Spec:
    """A thin pane of glass, clear without a tint."""
    return {"type": "thindielectric"} | ({"specular_transmittance": {"type": "rgb", "value": list(tint)}} if tint else {})


def leaf() -> Spec:
    """Opacity of an ellipse with a soft outline, as a texture."""
    y, x = np.mgrid[0:64, 0:64] / 31.5 - 1
    opacity = np.clip((0.7 - np.hypot(x, 1.4 * y)) / 0.2 + 0.5, 0, 1)
    return {"type": "bitmap", "bitmap": mi.Bitmap(opacity.astype(np.float32)[..., None]), "raw": True, "wrap_mode": "clamp"}


def pane(bsdf: Spec, height: float = 0.8, x: float = 0.1, tilt: float = 10, half: float = 0.6) -> Spec:
    """A square above the floor."""
    T = mi.ScalarTransform4f
    return {"type": "rectangle", "to_world": T().translate([x, 0, height]).rotate([0, 1, 0], tilt).scale(half), "bsdf": bsdf}


def standing(bsdf: Spec, y: float = 0.0) -> Spec:
    """A square that leans backwards, and cuts the floor and the ball."""
    T = mi.ScalarTransform4f
    place = T().translate([0.05, y - 0.1, 0.2]).rotate([0, 0, 1], 20).rotate([1, 0, 0], 60).scale([0.6, 0.45, 1])
    return {"type": "rectangle", "to_world": place, "bsdf": bsdf}


def along() -> Spec:
    """A sun whose light runs along the leaning square, which casts no shadow then."""
    up = np.array(standing({})["to_world"].matrix)[:3, 1]
    return {"type": "directional", "direction": list(-up), "irradiance": 3.0}


def sun(x: float = 0.3) -> Spec:
    return {"type": "directional", "direction": [x, 0.1, -1], "irradiance": 3.0}


def lights() -> dict[str, Spec]:
    """One light of each kind, by name."""
    T = mi.ScalarTransform4f
    slanted = T().look_at([-1, -0.5, 3], [0, 0, 0.3], [0, 1, 0])
    down = T().translate([-0.6, -0.4, 2.5]).rotate([1, 0, 0], 180).scale(0.3)
    return {
        "sun": sun(),
        "spot": {"type": "spot", "to_world": slanted, "intensity": 40.0, "cutoff_angle": 40},
        "point": {"type": "point", "position": [-0.6, -0.4, 2.5], "intensity": 20.0},
        "area": {"type": "rectangle", "to_world": down, "emitter": {"type": "area", "radiance": 30.0}},
        "sky": {"type": "constant", "radiance": 1.0},
    }


def camera(size: int = 64, x: float = 0.0) -> Spec:
    """Looks at the ball, or past it at a place further right."""
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    to_world = mi.ScalarTransform4f().look_at([x, -3.5, 3], [x, 0, 0.3], [0, 0, 1])
    return {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}


def scene_of(size: int = 64, light: Spec | None = None, **parts: Spec | None) -> mi.Scene:
    """A floor, a ball on it unless that is None, and other parts."""
    T = mi.ScalarTransform4f
    ball = {"type": "sphere", "center": [0.1, -0.2, 0.35], "radius": 0.25, "bsdf": {"type": "diffuse", "reflectance": 0.5}}
    floor = {"type": "rectangle", "to_world": T().scale(2), "bsdf": {"type": "diffuse", "reflectance": 0.7}}
    full = {
        "type": "scene",
        "camera": camera(size),
        "light": light or sun(),
        "floor": floor,
        "ball": ball,
    }
    return mi.load_dict({name: part for name, part in (full | parts).items() if part is not None}, optimize=False)


def panes() -> dict[str, dict[str, Spec]]:
    """Single panes."""
    return {
        "thin_veil": {"pane": pane(veil(0.3))},
        "dense_veil": {"pane": pane(veil(0.7))},
        "clear_glass": {"pane": pane(glass())},
        "red_glass": {"pane": pane(glass(0.9, 0.1, 0.1))},
    }


def stacks() -> dict[str, dict[str, Spec]]:
    """Scenes of 1 to 30 layers."""
    T = mi.ScalarTransform4f
    five = {f"p{k}": pane(veil(0.3, (0.2 + 0.1 * k, 0.4, 0.8 - 0.1 * k)), 0.2 + 0.2 * k, 0.1 * k - 0.2, 5 * k) for k in range(5)}
    many = {
        f"p{k}": pane(veil(0.1, (0.2 + 0.02 * k, 0.4, 0.8 - 0.02 * k)), 0.1 + 0.04 * k, 0.02 * k - 0.3, 2 * k) for k in range(30)
    }
    mixed = {"type": "blendbsdf", "weight": 0.6, "one": veil(1.0, (0.5, 0.5, 0.5)), "two": glass(0.2, 0.9, 0.3)}
    return {
        "two": {"veil": pane(veil(0.5)), "glass": pane(glass(0.9, 0.2, 0.1), 1.1, -0.2)},
        "five": five,
        "thirty": many,
        "null": {"bounds": {"type": "cube", "to_world": T().scale(1.5), "bsdf": {"type": "null"}}, "pane": pane(veil(0.5))},
        "around": {"bubble": {"type": "sphere", "center": [0.1, -0.2, 0.4], "radius": 0.38, "bsdf": veil(0.4)}},
        "blend": {"pane": pane(mixed)},
        "leaves": {f"leaf{k}": pane(veil(leaf(), (0.2, 0.6, 0.1)), 0.5 + 0.2 * k, 0.2 * k - 0.3, 20 * k - 20) for k in range(4)},
    }


def traced(scene: mi.Scene, spp: int, seed: int = 3) -> np.ndarray:
    """Direct light as Mitsuba traces it; surfaces that let light pass straight on are no bounces."""
    return np.array(mi.render(scene, integrator=mi.load_dict({"type": "volpath", "max_depth": 2}), spp=spp, seed=seed))


def relative_error(image: np.ndarray, reference: np.ndarray, where: np.ndarray | None = None) -> float:
    """Root mean square of the difference over that of the reference. ``where``: mask of the pixels that count."""
    chosen = np.ones(image.shape[:2], bool) if where is None else where
    return float(np.sqrt(np.mean((image - reference)[chosen] ** 2) / np.mean(reference[chosen] ** 2)))
