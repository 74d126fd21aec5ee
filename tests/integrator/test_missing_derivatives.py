"""Derivatives that are missing, as docs/limits.md says: images change, and their derivative is zero."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import shadowmap_dr  # noqa: F401  (registers the integrator)

SIZE, STEP = 24, 0.05


def cases() -> dict[str, tuple[dict[str, Any], str, list[float], bool]]:
    """Shapes, parameter, direction of the motion, and whether the image changes."""
    t = mi.ScalarTransform4f
    board = {"type": "diffuse", "reflectance": {"type": "checkerboard", "to_uv": t().scale(3)}}
    floor = {"type": "rectangle", "to_world": t().translate([0, 0, -1]).scale(3)}
    high = {"type": "rectangle", "to_world": t().translate([0, 0, 6]).scale(0.5)}
    return {
        "edges within a texture": ({"board": {**floor, "bsdf": board}}, "board.to_world", [1, 0, 0], True),
        "a caster along the light": ({"floor": floor, "caster": high}, "caster.to_world", [0, 0, 1], False),
    }


@pytest.mark.parametrize("name", ["edges within a texture", "a caster along the light"])
def test_derivative_is_zero(variant: str, name: str) -> None:
    shapes, key, direction, changes = cases()[name]
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    place = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    camera = {"type": "perspective", "fov": 40, "to_world": place, "film": film}
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 3.0}
    scene = mi.load_dict({"type": "scene", "camera": camera, "sun": sun, **shapes}, optimize=False)
    params, integrator = mi.traverse(scene), mi.load_dict({"type": "shadowmap"})
    rest = mi.Transform4f(params[key])

    def render(x: Any) -> Any:
        params[key] = mi.Transform4f().translate(mi.Vector3f(direction) * x) @ rest
        params.update()
        return mi.render(scene, params, integrator=integrator, spp=4)

    images = [render(mi.Float(x)).numpy() for x in (-STEP, STEP)]
    assert (np.abs(images[1] - images[0]).mean() > 0.01) == changes
    x = mi.Float(0)
    dr.enable_grad(x)
    image = render(x)
    dr.forward(x)
    assert image.numpy().std() > 0.05 and np.abs(dr.grad(image).numpy()).max() < 1e-4
