"""Shadow maps without the backs of closed shapes: which faces that are, in which maps, and that shadows stay what they are."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr import Renderer, ShadowmapError
from shadowmap_dr.raster import visible_triangles
from shadowmap_dr.rendering import shadow_pass

CORNERS = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float32)
# Two triangles a side, counter-clockwise from outside: bottom, top, then the sides.
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (3, 2, 6, 7), (1, 3, 7, 5), (2, 0, 4, 6)]
BOX = np.array([t for a, b, c, d in SIDES for t in ((a, b, c), (a, c, d))])
TOP = slice(2, 4)
TURNED = BOX.copy()
TURNED[TOP] = BOX[TOP][:, ::-1]
SETTINGS: dict[str, Any] = {"shadow_method": "vsm", "shadow_map_resolution": 128}


def box(faces: np.ndarray = BOX) -> mi.Mesh:
    """A box that is sunk into the floor by half."""
    mesh = mi.Mesh("box", len(CORNERS), len(faces))
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float((0.7 * CORNERS + [0, 0, 0.1]).ravel().astype(np.float32))
    params["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    params.update()
    return mesh


def scene(faces: np.ndarray = BOX, **more: Any) -> mi.Scene:
    """The box on a floor, from above, under an oblique sun."""
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 45,
                "to_world": mi.ScalarTransform4f().look_at([-2, -3, 4], [0, 0, 0], [0, 0, 1]),
                "film": {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}},
            },
            "sun": {"type": "directional", "direction": [0.8, 0.3, -1.0], "irradiance": 3.0},
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale([3, 3, 1])},
            "box": box(faces),
            **more,
        },
        optimize=False,
    )


def renderers(of: mi.Scene) -> tuple[Renderer, Renderer]:
    """Without the option and with it."""
    return Renderer.from_scene(of, **SETTINGS), Renderer.from_scene(of, shadow_cull_backfaces=True, **SETTINGS)


def image_and_gradient(renderer: Renderer) -> tuple[np.ndarray, np.ndarray]:
    """The image of the box, moved a little, and the derivative of its weighted sum by an offset of the box."""
    offset = mi.Vector3f(0.05, -0.02, 0.03)
    dr.enable_grad(offset)
    rest = dr.detach(renderer.data.geometry.shape_positions("box"))
    image = renderer.render(vertex_positions={"box": rest + offset})
    weights = mi.TensorXf(np.random.default_rng(0).random(image.shape).astype(np.float32))
    dr.backward(dr.sum(image * weights, axis=None))
    return image.numpy(), np.array(dr.grad(offset)).ravel()


def wrong_pixels(renderer: Renderer, image: np.ndarray) -> int:
    """Number of pixels that clearly differ."""
    return int((np.abs(renderer.render().numpy() - image).max(-1) > 0.05).sum())


def test_closed_shapes_cast_the_same_shadows(variant: str) -> None:
    plain, culled = renderers(scene())
    assert plain.outward is None and sorted(np.array(culled.outward)) == [False] * 2 + [True] * 12
    (image, gradient), (same, same_gradient) = image_and_gradient(plain), image_and_gradient(culled)
    np.testing.assert_allclose(same, image, atol=1e-6)
    np.testing.assert_allclose(same_gradient, gradient, rtol=1e-4, atol=1e-4 * np.abs(gradient).max())


@pytest.mark.parametrize(
    "faces", [BOX[4:], np.delete(BOX, TOP, 0), BOX[:, ::-1], TURNED], ids=["tube", "open", "inward", "turned"]
)
def test_other_shapes_keep_their_backs(variant: str, faces: np.ndarray) -> None:
    """Open ones, ones turned inwards, and ones whose faces are not turned alike."""
    plain, culled = renderers(scene(faces))
    image = plain.render().numpy()
    np.testing.assert_array_equal(culled.render().numpy(), image)
    # Had they been taken for closed ones, light would pass through them.
    culled.outward = dr.full(mi.Bool, True, dr.width(culled.outward))
    assert wrong_pixels(culled, image) > 10


def test_lights_inside_of_a_shape_see_its_backs(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only the maps of directional lights begin before all casters."""
    bulb = {"type": "point", "position": [0.1, 0.0, 0.4], "intensity": 3.0}
    plain, culled = renderers(scene(bulb=bulb))
    image = plain.render().numpy()
    np.testing.assert_allclose(culled.render().numpy(), image, atol=1e-6)
    monkeypatch.setattr(shadow_pass, "_culled", lambda plan, count, outward: outward)
    assert wrong_pixels(culled, image) > 10


def test_alpha_tested_scenes_keep_their_backs(variant: str) -> None:
    veil = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 2]),
        "bsdf": {"type": "mask", "opacity": {"type": "checkerboard", "color0": 0.0, "color1": 1.0}, "b": {"type": "diffuse"}},
    }
    plain, culled = renderers(scene(veil=veil))
    np.testing.assert_array_equal(culled.render().numpy(), plain.render().numpy())


def test_faces_are_chosen_for_each_image(variant: str) -> None:
    """One triangle, seen from both sides by two images each: culled in one of them."""
    front = np.array([[-0.5, -0.5, 0, 1], [-0.5, 0.5, 0, 1], [0.5, 0, 0, 1]], np.float32)  # clockwise
    back = front[[0, 2, 1]]
    positions = mi.Float(np.stack([front, front, back, back]).ravel())

    def seen(one_sided: list[bool]) -> list[bool]:
        raster = visible_triangles(positions, mi.UInt32([0, 1, 2]), (16, 16), batch=4, one_sided=mi.Bool(one_sided))
        return raster.valid.numpy().reshape(4, -1).any(1).tolist()

    assert seen([True]) == [True, True, False, False]
    assert seen([False]) == [True] * 4
    assert seen([True, False, True, False]) == [True, True, False, True]


def test_plug_in(variant: str) -> None:
    of = scene()
    common = {"type": "shadowmap", "shadow_method": "vsm", "shadow_map_resolution": 128}
    integrators = [mi.load_dict({**common, "shadow_cull_backfaces": cull}) for cull in (False, True)]
    plain, culled = (np.array(mi.render(of, integrator=integrator)) for integrator in integrators)
    np.testing.assert_allclose(culled, plain, atol=1e-6)
    with pytest.raises(ShadowmapError, match="do not combine it with cull_backfaces"):
        Renderer.from_scene(of, compat=True, shadow_cull_backfaces=True)
