"""Parts of scenes that cannot be rendered: one warning names them, and the rest is rendered as if they were not there."""

from __future__ import annotations

import re
import warnings
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from broken_scenes import SIZE, lamp, scene

from shadowmap_dr import Renderer
from shadowmap_dr.scene.load import load

OPTIONS = {"type": "shadowmap", "area_light_samples": 4, "environment_light_samples": 8, "soft_map_resolution": 32}


def blob() -> dict[str, Any]:
    """A shape that is not supported, out of view."""
    grid = mi.TensorXf(np.linspace(-1, 1, 27, dtype=np.float32).reshape(3, 3, 3, 1))
    return {"type": "sdfgrid", "grid": grid, "to_world": mi.ScalarTransform4f().translate([50, 50, -50])}


def ball(**changes: Any) -> dict[str, Any]:
    return {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.3, **changes}


def warnings_of(made: Any, integrator: Any = None) -> tuple[list[str], np.ndarray]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        image = mi.render(made, integrator=integrator or mi.load_dict(OPTIONS)).numpy()
    return [str(w.message) for w in caught if issubclass(w.category, UserWarning)], image


def unsupported() -> dict[str, tuple[dict[str, Any], dict[str, Any], str]]:
    """Name -> (parts of a scene, those that are rendered, what the warning says)."""
    fog = {"type": "homogeneous", "albedo": 0.5}
    glass = {"type": "dielectric", "id": "glass"}
    return {
        "shape": ({"blob": blob()}, {}, r"'blob' \(SDFGrid\)"),
        "sky": ({"sky": {"type": "timed_sunsky"}}, {}, r"'sky' \(TimedSunskyEmitter\)"),
        "beam": (
            {"ball": ball(glow={"type": "directionalarea"})},
            {"ball": ball()},
            r"of shape 'ball' \(DirectionalArea\) shines along the normals of a Sphere",
        ),
        "shape with light": ({"blob": {**blob(), "glow": {"type": "area"}}}, {}, "'blob' is left out with its shape"),
        "medium": ({"ball": ball(interior=fog, bsdf={"type": "diffuse"})}, {"ball": ball()}, "'ball' bounds a medium"),
        "glass": (
            {"ball": ball(bsdf=glass)},
            {"ball": ball(bsdf={"type": "diffuse", "reflectance": 0.0})},
            r"'glass' \(SmoothDielectric\) of shape 'ball' has no smooth component and renders black",
        ),
        "thin glass": (
            {"lamp": lamp(), "ball": ball(bsdf={"type": "thindielectric", "id": "pane"})},
            {},
            r"'pane' \(ThinDielectric\) of shape 'ball' shows no mirror images of lights, only the light that it lets through",
        ),
        "plastic": ({"lamp": lamp(), "ball": ball(bsdf={"type": "plastic"})}, {}, "'ball' shows no mirror images of lights"),
    }


@pytest.mark.parametrize("name", ["shape", "sky", "beam", "shape with light", "medium", "glass", "thin glass", "plastic"])
def test_is_named_and_left_out(variant: str, name: str) -> None:
    parts, rendered, words = unsupported()[name]
    messages, image = warnings_of(scene(**parts))
    assert len(messages) == 1
    assert re.search(words, messages[0]) and "\n" not in messages[0]
    assert image.max() > 0.1
    if name not in ("plastic", "thin glass"):
        none, without = warnings_of(scene(**rendered))
        assert not none
        assert np.abs(image - without).max() < 1e-4


def test_one_warning_names_it_all(variant: str) -> None:
    parts = {key: value for name, (more, _, _) in unsupported().items() if name != "shape" for key, value in more.items()}
    balls = {f"mirror{k}": ball(bsdf={"type": "ref", "id": "mirror"}) for k in range(6)}
    made = scene(mirror={"type": "conductor"}, **balls, **parts)
    messages, _ = warnings_of(made)
    assert len(messages) == 1
    for words in ("'blob'", "'sky'", "SmoothConductor", "'mirror0', 'mirror1', 'mirror2', 'mirror3' and 2 more"):
        assert words in messages[0]


def test_once_for_a_scene_and_an_integrator(variant: str) -> None:
    first, second, integrator = scene(blob=blob()), scene(blob=blob()), mi.load_dict(OPTIONS)
    counts = [len(warnings_of(made, integrator)[0]) for made in (first, first, second, first, second)]
    assert counts == [1, 0, 1, 0, 0]
    params = mi.traverse(first)
    params["box.faces"] = mi.UInt32(np.roll(params["box.faces"].numpy(), 3))
    params.update()
    assert warnings_of(first, integrator)[0] == []
    assert len(warnings_of(first)[0]) == 1


def test_supported_scenes_warn_of_nothing(variant: str) -> None:
    plastic = ball(bsdf={"type": "plastic"})
    messages, image = warnings_of(scene(ball=plastic))
    assert messages == [] and image.shape[:2] == (SIZE, SIZE)


def test_scenes_read_by_hand_warn_once_too(variant: str) -> None:
    for call in (load, Renderer.from_scene):
        with pytest.warns(UserWarning, match="'blob'") as caught:
            call(scene(blob=blob()))
        assert len(caught) == 1


def test_warnings_point_to_the_caller(variant: str) -> None:
    for call in (load, Renderer.from_scene, lambda made: mi.render(made, integrator=mi.load_dict(OPTIONS))):
        with pytest.warns(UserWarning, match="'blob'") as caught:
            call(scene(blob=blob()))
        assert caught[0].filename == __file__
