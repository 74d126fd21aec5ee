"""Surfaces that one may see through: where one does, their outlines hide nothing and have no derivatives."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import image_and_derivative

SIZE = 64


def scene(opacity: Any = None) -> Any:
    """A card above a floor, and close above it a larger veil with an opacity, or none."""
    T = mi.ScalarTransform4f
    red = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.2, 0.1]}}}
    green = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.3, 0.2]}}
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    look = T().look_at([0, -0.3, 5], [0, 0, 0], [0, 1, 0])
    parts: dict[str, Any] = {
        "camera": {"type": "perspective", "fov": 40, "to_world": look, "film": film},
        "card": {"type": "rectangle", "to_world": T().rotate([0, 0, 1], 20).scale(0.5), "bsdf": red},
        "floor": {"type": "rectangle", "to_world": T().translate([0, 0, -0.5]).scale(3), "bsdf": green},
        "sun": {"type": "directional", "direction": [0.1, 0.05, -1]},
    }
    if opacity is not None:
        place = T().translate([0, 0, 0.01]).rotate([0, 0, 1], 20).scale(0.52)
        veil = red if opacity == "opaque" else {"type": "mask", "opacity": opacity, "bsdf": red}
        parts["veil"] = {"type": "rectangle", "to_world": place, "bsdf": veil}
    return mi.load_dict({"type": "scene", **parts}, optimize=False)


def quad(name: str, corners: list[list[float]], bsdf: dict[str, Any]) -> Any:
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(name, 4, 2, props=props)
    params = mi.traverse(mesh)
    params["vertex_positions"], params["faces"] = np.ravel(corners).astype(np.float32), [0, 1, 2, 0, 2, 3]
    params.update()
    return mesh


def moved_right(made: Any, name: str, method: str = "evsm4") -> tuple[np.ndarray, np.ndarray]:
    return image_and_derivative(made, name, (1, 0, 0), shadow_map_resolution=128, shadow_method=method)


def test_what_is_not_seen_has_no_outline(variant: str) -> None:
    expected, derivative = moved_right(scene(), "card")
    found, other = moved_right(scene(0.0), "card")
    assert np.abs(derivative).sum() > 100
    # Shadow maps cover a little more.
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert np.abs(other - derivative).sum() < 0.03 * np.abs(derivative).sum()
    assert np.abs(moved_right(scene(0.0), "veil")[1]).sum() < 0.01 * np.abs(derivative).sum()


def test_what_is_seen_of_a_veil_has_its_outline(variant: str) -> None:
    # Translucent casters have moments in their shadow maps. There, outlines of the card below multiply with those of the veil.
    expected, derivative = moved_right(scene("opaque"), "veil", "msm")
    found, other = moved_right(scene(1.0), "veil", "msm")
    np.testing.assert_allclose(found, expected, atol=0.01)
    assert np.mean(np.abs(found - expected) > 1e-3) < 0.005
    assert np.abs(other - derivative).sum() < 0.03 * np.abs(derivative).sum()
    # Of a veil with a hole in the middle that shows the card, too.
    hole = np.ones((16, 16, 1), np.float32)
    hole[4:12, 4:12] = 0
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(hole), "raw": True, "filter_type": "nearest"}
    _, other = moved_right(scene(texture), "veil", "msm")
    assert np.abs(other - derivative).sum() < 0.03 * np.abs(derivative).sum()


@pytest.mark.parametrize("first", ["front", "side"])
def test_veils_that_border_on_what_is_opaque(variant: str, first: str) -> None:
    """The opaque one ends at a corner beyond which a veil goes on, turned away: whichever comes first."""
    T = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    red = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.2, 0.1]}}}

    def corner(side: Any) -> Any:
        quads = {
            "front": quad("front", [[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], red),
            "side": quad("side", [[0.5, -0.5, 0], [0.5, -0.5, -1], [0.5, 0.5, -1], [0.5, 0.5, 0]], side),
        }
        order = [first, *(name for name in quads if name != first)]
        look = T().look_at([-0.7, 0.1, 4], [0, 0, 0], [0, 1, 0])
        parts = {
            "camera": {"type": "perspective", "fov": 30, "to_world": look, "film": film},
            **{name: quads[name] for name in order},
            "floor": {"type": "rectangle", "to_world": T().translate([0, 0, -2]).scale(4)},
            "sun": {"type": "directional", "direction": [0.1, 0.05, -1]},
        }
        return mi.load_dict({"type": "scene", **parts}, optimize=False)

    expected, derivative = moved_right(corner(red), "front")
    found, other = moved_right(corner({"type": "mask", "opacity": 1.0, "bsdf": red}), "front")
    assert np.abs(derivative).sum() > 30
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.abs(other - derivative).sum() < 0.03 * np.abs(derivative).sum()
