"""Inputs of fits: pictures without content, bounds that are reached, and what tells one fit from another."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import box, camera, scene_of, sun

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import fit, make_target, prepared

Image = npt.NDArray[np.float32]
SIZE = {"width": 48, "height": 36}


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Checks of inputs do not depend on it."""
    mi.set_variant("llvm_ad_rgb")


def scene(**parts: Any) -> mi.Scene:
    return scene_of(**{"camera": camera(film=SIZE), **parts})


@pytest.fixture(scope="module")
def picture() -> Image:
    """The box on the floor under the sun, as the scene has them."""
    mi.set_variant("llvm_ad_rgb")
    return np.array(mi.render(scene(), integrator=mi.load_dict({"type": "direct"}), spp=64))[..., :3]


def test_black_pictures_are_refused() -> None:
    """With an exposure of nothing, anything is like them."""
    with pytest.raises(ShadowmapError, match="is black where it counts"):
        fit(scene(), np.zeros((36, 48, 3)), ["box:pose"], exposure=True)


def test_numbers_at_bounds_are_named(picture: Image) -> None:
    result = fit(scene(), picture, ["sun.irradiance:brightness,min=1.2,max=2", "box:translation:x,max=0.5"], starts=1)
    assert [words for words in result.words if " at its " in words] == [
        "sun.irradiance:brightness is at its min: the pictures ask for less."
    ]


def test_other_fits_are_not_gone_on_with(picture: Image) -> None:
    """Of another scene, a mirrored picture, another exposure of it."""

    def of(image: Any = picture, **parts: Any) -> str:
        return prepared(scene(**parts), image, ["box:pose"])._fingerprint()

    same = of()
    assert of() == same
    others = [of(picture[:, ::-1].copy()), of(box=box(0.3)), of(sun=sun(irradiance={"type": "rgb", "value": 2.5}))]
    others += [of(make_target(picture, exposure=2.0)), of(camera=camera(film=SIZE, fov=46))]
    assert same not in others and len(set(others)) == len(others)
