"""Fits of opacities and tints: light that passes straight through surfaces."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt
import pytest
from fitting_scenes import camera, diffuse, floor, renderer_of, rgb, scene_of, sun

from shadowmap_dr.fitting import prepared
from shadowmap_dr.fitting.arrays import TextureValues
from shadowmap_dr.fitting.reference import reference_integrator
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.vary import Vary

Image = npt.NDArray[np.float32]
DIRECTION = np.array([0.4, 0.3, -1]) / np.linalg.norm([0.4, 0.3, -1])


@pytest.fixture(autouse=True)
def one_backend() -> None:
    """Mitsuba renders: both backends have the same objects."""
    mi.set_variant("llvm_ad_rgb")


def sheet(material: dict[str, Any], lean: float = 20) -> dict[str, Any]:
    """A square that leans over the floor."""
    T = mi.ScalarTransform4f
    place = T().translate([-0.2, -0.1, 0.9]) @ T().rotate([1, 0.3, 0], lean) @ T().scale(0.7)
    return {"type": "rectangle", "to_world": place, "bsdf": material}


def cloth(opacity: float | dict[str, Any]) -> dict[str, Any]:
    return {"type": "mask", "opacity": opacity, "nested": {"type": "twosided", "nested": diffuse(0.7, 0.6, 0.5)}}


def glass(*tint: float) -> dict[str, Any]:
    return {"type": "thindielectric", "specular_transmittance": rgb(*tint)}


def lit(material: dict[str, Any], direction: npt.ArrayLike = DIRECTION, **parts: Any) -> dict[str, Any]:
    """Parts of a scene: the square in the sun above the floor."""
    light = sun(direction=np.asarray(direction).tolist(), irradiance=rgb(3.0))
    return {"box": None, "camera": camera(48, 48), "floor": floor(), "pane": sheet(material), "sun": light, **parts}


def photograph(material: dict[str, Any]) -> Image:
    volpath = mi.load_dict({"type": "volpath", "max_depth": 2})
    return np.array(mi.render(scene_of(**lit(material)), integrator=volpath, spp=1024, seed=3), np.float32)[..., :3]


def turned(degrees: float) -> npt.NDArray[np.float64]:
    aside = np.cross(DIRECTION, [0.3, 0.8, 0.1])
    angle = np.radians(degrees)
    return np.asarray(np.cos(angle) * DIRECTION + np.sin(angle) * aside / np.linalg.norm(aside))


def test_opacity_and_sun_are_found_together() -> None:
    scene = scene_of(**lit(cloth(0.3), turned(10)))
    result = prepared(scene, photograph(cloth(0.5)), ["pane.bsdf.opacity", "sun:direction"], starts=2, tries=1).run()
    opacity, direction = result.estimates
    assert result.found, result.words
    assert opacity.name == "pane.bsdf.opacity" and opacity.labels == ("value",)
    assert opacity.values[0] == pytest.approx(0.5, rel=0.03)
    assert 0 < opacity.half_width[0] < 0.03
    found = direction.arrays["direction"].ravel()
    assert np.degrees(np.arccos(min(1.0, float(found @ DIRECTION)))) < 0.5


def test_a_tint_is_found() -> None:
    scene = scene_of(**lit(glass(0.6, 0.6, 0.6)))
    result = prepared(scene, photograph(glass(0.9, 0.4, 0.2)), ["pane.bsdf.specular_transmittance"], starts=1, tries=1).run()
    (tint,) = result.estimates
    assert result.found, result.words
    assert tint.labels == ("red", "green", "blue")
    np.testing.assert_allclose(tint.values, [0.9, 0.4, 0.2], rtol=0.03)


def test_an_opacity_in_a_texture_is_fitted() -> None:
    def woven(values: npt.ArrayLike) -> dict[str, Any]:
        texels = mi.Bitmap(np.asarray(values, np.float32)[..., None])
        return cloth({"type": "bitmap", "bitmap": texels, "raw": True, "format": "variant"})

    truth = np.random.default_rng(4).uniform(0.2, 0.8, (4, 5))
    scene, picture = scene_of(**lit(woven(np.full((4, 5), 0.5)))), photograph(woven(truth))
    result = prepared(scene, picture, ["pane.bsdf.opacity:texture"], steps=150).run()
    found = result.estimates[0].arrays["texture"]
    assert np.sqrt(np.mean((found.reshape(4, 5) - truth) ** 2)) < 0.05


def test_opacities_and_tints_lie_between_zero_and_one() -> None:
    texels = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((5, 5, 3), 0.5, np.float32)), "raw": True, "format": "variant"}
    painted = {"type": "thindielectric", "specular_transmittance": texels}
    resolver = Resolver(renderer_of(pane=sheet(cloth(0.5)), glass=sheet(glass(0.5, 0.4, 0.3)), painted=sheet(painted)))
    few, many = resolver.parameters(
        [Vary("pane.bsdf.opacity"), Vary("glass.bsdf.specular_transmittance"), Vary("painted.bsdf", "texture")]
    )
    assert [parameter.natural for parameter in few] == [(0.0, 1.0), (0.0, 1.0)]
    assert not any(parameter.scale.logarithmic for parameter in few)
    (texture,) = many
    assert isinstance(texture, TextureValues)
    assert (texture.low, texture.high) == (0.0, 1.0)


@pytest.mark.parametrize(
    ("own", "name", "depth"),
    [
        (None, "VolumetricPathIntegrator", 2),
        ({"type": "direct", "hide_emitters": True}, "VolumetricPathIntegrator", 2),
        ({"type": "path", "max_depth": 4}, "VolumetricPathIntegrator", 4),
        ({"type": "prb", "max_depth": 3}, "VolumetricPathIntegrator", 3),
        ({"type": "path"}, "VolumetricPathIntegrator", 4294967295),
        ({"type": "volpathmis", "max_depth": 5}, "VolpathMisIntegratorImpl", 5),
    ],
)
def test_images_of_translucent_scenes_are_rendered_by_volpath(own: dict[str, Any] | None, name: str, depth: int) -> None:
    integrator = reference_integrator(renderer_of(pane=sheet(cloth(0.5)), integrator=own).data)
    assert integrator.class_name() == name
    assert f"max_depth = {depth}" in str(integrator)
    assert integrator.hide_emitters == bool(own and own.get("hide_emitters"))


def test_opaque_scenes_keep_their_integrator() -> None:
    assert reference_integrator(renderer_of(integrator={"type": "path", "max_depth": 3}).data).class_name() == "PathIntegrator"
    assert (
        reference_integrator(renderer_of(integrator={"type": "aov", "aovs": "d:depth"}).data).class_name() == "DirectIntegrator"
    )
