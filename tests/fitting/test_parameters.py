"""Entries of the list of things that vary, and the parameters that a scene has for them."""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from fitting_scenes import OPTIONS, box, camera, renderer_of, varied_scene
from hypothesis import example, given
from hypothesis import strategies as st

from shadowmap_dr import Renderer
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting.arrays import MeshVertices, TextureValues
from shadowmap_dr.fitting.motions import host_matrix
from shadowmap_dr.fitting.parameters import Scale
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.scene_change import SceneChange
from shadowmap_dr.fitting.starts import half_ranges
from shadowmap_dr.fitting.vary import KINDS, Vary

LONG, WORDS = 5000 * "x", 900 * "two words "

# ------------------------------------------------------------------------------------------------------------------ entries


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bunny", Vary("bunny")),
        ("bunny:pose", Vary("bunny", "pose")),
        (" bunny:translation:xz", Vary("bunny", "translation", "xz")),
        ("sun:direction,spread=60", Vary("sun", "direction", spread=60)),
        ("wall.bsdf.reflectance, min=0.1, max=0.8", Vary("wall.bsdf.reflectance", low=0.1, high=0.8)),
        ("car_*:pose,prior=5e-1", Vary("car_*", "pose", prior=0.5)),
    ],
)
def test_entries_are_parsed(text: str, expected: Vary) -> None:
    assert Vary.parse(text) == Vary.of(text) == expected
    assert Vary.of(expected.plain()) == expected and Vary.of(expected) is expected
    assert Vary.parse(expected.label) == Vary(expected.name, expected.kind, expected.axes)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the name is missing"),
        (":pose", "the name is missing"),
        ("bunny:poes", "there is no kind 'poes': choose from pose, .* Did you mean 'pose'?"),
        ("bunny:pose:x", "only rotation, translation, position have axes"),
        ("bunny:rotation:w", "axes are letters out of xyz"),
        ("bunny:rotation:xx", "axes are letters out of xyz"),
        ("bunny,mni=3", "'mni=3' is not understood: write min, max, prior, spread = a number"),
        ("bunny,min", "'min' is not understood"),
        ("bunny,min=low", "min is 'low'; give a number"),
        ("bunny,min=nan", "low is nan; give a finite number"),
        ("bunny,max=inf", "high is inf; give a finite number"),
        ("bunny,prior=0", "prior is 0; give a positive number"),
        ("bunny,spread=-1", "spread is -1; give a positive number"),
        ("bunny,min=2,max=1", "min is 2 and max is 1; give min below max"),
        ("bunny,min=1,max=1", "give min below max"),
        ("bunny,max=1e300", "high is 1e.300; give a number of a size up to 1e.12"),
        ("bunny,min=-1e300", "low is -1e.300; give a number of a size up to 1e.12"),
        (f"{LONG}:rotation,", "'' is not understood"),
        (f"bunny:{LONG}", "there is no kind 'x+…x+': choose from pose, "),
        (f"bunny:rotation:{LONG}", "axes are letters out of xyz"),
        (f"bunny,{LONG}", "'x+…x+' is not understood"),
        (f"bunny,min={LONG}", "min is 'x+…x+'; give a number"),
        (f"{WORDS},min={WORDS}", "min is 'two words .*….*'; give a number"),
    ],
)
def test_bad_texts_are_refused(text: str, words: str) -> None:
    with pytest.raises(ShadowmapError, match=words) as raised:
        Vary.parse(text)
    assert str(raised.value).startswith("vary ") and "\n" not in str(raised.value) and len(str(raised.value)) <= 600


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (3, "3 is a int; give text such as 'bunny:pose', or a mapping"),
        (None, "is a NoneType"),
        ({}, "the name is missing"),
        ({"name": "sun", "kidn": "pose"}, "there is no key 'kidn': there are name, kind, axes, min, max, prior, spread"),
        ({"name": 3}, "name is 3; give text"),
        ({"name": "sun", "kind": ["pose"]}, "give text"),
        ({"name": "sun", "min": True}, "low is True; give a finite number"),
        ({"name": "sun", "min": "3"}, "low is '3'; give a finite number"),
        ({"name": "sun", "min": 10**400}, "give a finite number"),
        ({"name": "sun", "min": 10**5000}, "low is a very long int; give a finite number"),
        ({"name": "sun", 5000 * "x": 1}, "there is no key 'x+…x+': there are name"),
    ],
)
def test_bad_mappings_are_refused(entry: Any, words: str) -> None:
    with pytest.raises(ShadowmapError, match=words) as raised:
        Vary.of(entry)
    assert "\n" not in str(raised.value)


_WORDS = st.sampled_from(["bunny", ":", ",", "=", "pose", "rotation", "xyz", "min", "max", "spread", "1", "-2", "nan", " ", "*"])
_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4), lambda own: st.lists(own, max_size=2)
)


@given(text=st.text(max_size=12) | st.lists(_WORDS, max_size=8).map("".join))
@example("a,min=1_0,max=0x1")
def test_texts_end_in_an_entry_or_one_kind_of_error(text: str) -> None:
    try:
        entry = Vary.parse(text)
    except ShadowmapError:
        return
    assert Vary.of(entry.plain()) == entry


@given(
    entry=_JSON
    | st.dictionaries(st.sampled_from(["name", "kind", "axes", "min", "max", "low", "prior", "spread", "else"]) | _WORDS, _JSON)
)
def test_mappings_end_in_an_entry_or_one_kind_of_error(entry: Any) -> None:
    try:
        found = Vary.of(entry)
    except ShadowmapError:
        return
    assert Vary.of(found.plain()) == found


# ----------------------------------------------------------------------------------------------------------------- resolver


@pytest.fixture(scope="module")
def resolver() -> Resolver:
    mi.set_variant("llvm_ad_rgb")
    return Resolver(Renderer.from_scene(varied_scene(), **OPTIONS))


@pytest.mark.parametrize(
    ("text", "kind", "labels", "units"),
    [
        ("ball", "pose", ["rotation x", "rotation y", "rotation z", "translation x", "translation y", "translation z"], None),
        ("ball:rotation:yx", "rotation", ["rotation y", "rotation x"], ["deg", "deg"]),
        ("ball:translation:z", "translation", ["translation z"], ["units"]),
        ("ball:position", "translation", ["translation x", "translation y", "translation z"], ["units"] * 3),
        ("ball:scale", "scale", ["scale"], ["times"]),
        ("sun", "direction", ["turn 1", "turn 2"], ["deg", "deg"]),
        ("spot:direction", "direction", ["turn 1", "turn 2"], ["deg", "deg"]),
        ("spot", "pose", None, ["deg"] * 3 + ["units"] * 3),
        ("lamp", "translation", ["translation x", "translation y", "translation z"], ["units"] * 3),
        ("lamp:translation:x", "translation", ["translation x"], ["units"]),
        ("camera", "pose", ["tilt", "pan", "roll", "translation x", "translation y", "translation z"], None),
        ("camera:rotation:y", "rotation", ["pan"], ["deg"]),
        ("camera:fov", "fov", ["angle of view"], ["deg"]),
        ("sun:value", "value", ["red", "green", "blue"], ["", "", ""]),
        ("sun:brightness", "value", ["factor"], ["times"]),
        ("sky:sky", "value", ["factor"], ["times"]),
        ("panel:brightness", "value", ["factor"], ["times"]),
        ("lamp.intensity", "value", ["red", "green", "blue"], ["", "", ""]),
        ("spot.cutoff_angle", "value", ["value"], ["deg"]),
        ("ball.bsdf.diffuse_reflectance", "value", ["red", "green", "blue"], None),
        ("ball.bsdf.alpha", "value", ["value"], [""]),
    ],
)
def test_objects_and_their_kinds(
    resolver: Resolver, text: str, kind: str, labels: list[str] | None, units: list[str] | None
) -> None:
    found = resolver.parameter(Vary.parse(text))
    assert not isinstance(found, (MeshVertices, TextureValues))
    assert found.kind == kind
    assert labels is None or list(found.labels) == labels
    assert units is None or list(found.units) == units


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("sun.irradiance", "sun.irradiance.value"),
        ("sun.irradiance.value", "sun.irradiance.value"),
        ("sun:brightness", "sun.irradiance.value"),
        ("sky:value", "sky.radiance.value"),
        ("panel:value", "panel.emitter.radiance.value"),
        ("car_body:value", "car_body.bsdf.reflectance.value"),
        ("floor:texture", "floor.bsdf.reflectance.data"),
        ("floor.bsdf:texture", "floor.bsdf.reflectance.data"),
        ("floor.bsdf.reflectance.data:texture", "floor.bsdf.reflectance.data"),
    ],
)
def test_short_names_of_values(resolver: Resolver, text: str, key: str) -> None:
    assert resolver.parameter(Vary.parse(text)).key == key  # type: ignore[union-attr]


def test_patterns_move_shapes_together(resolver: Resolver) -> None:
    """As one body: about the middle of both boxes at x = -1 and x = 1."""
    both = resolver.parameter(Vary.parse("car_*:pose"))
    assert both.shapes == ("car_body", "car_wheel")  # type: ignore[union-attr]
    joined = resolver.parameter(Vary.parse("car_wheel+car_body:pose"))
    assert joined.shapes == both.shapes
    with pytest.raises(ShadowmapError, match="the scene has no shape 'car_seat'"):
        resolver.parameter(Vary.parse("car_wheel+car_seat:pose"))
    np.testing.assert_allclose(both.pivot, [0, 0, 0.5], atol=1e-6)  # type: ignore[union-attr]
    one = resolver.parameter(Vary.parse("car_wheel"))
    np.testing.assert_allclose(one.pivot, [1, 0, 0.5], atol=1e-6)  # type: ignore[union-attr]
    with pytest.raises(ShadowmapError, match=r"vary car_\*:vertices: 2 shapes are called 'car_\*'; name one mesh"):
        resolver.parameter(Vary.parse("car_*:vertices"))
    with pytest.raises(ShadowmapError, match=r"no object or value 'bus_\*'"):
        resolver.parameter(Vary.parse("bus_*:pose"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("bal:pose", "vary bal:pose: the scene has no object or value 'bal'; --list lists all. Did you mean 'ball'?"),
        ("car_bodi", "Did you mean 'car_body'?"),
        ("sun.iradiance", "Did you mean 'sun.irradiance'?"),
        ("camra:pose", "Did you mean 'camera'?"),
        ("ball:fov", "'ball' is a shape and has the kinds pose, rotation, translation, scale."),
        ("ball:direction", "'ball' is a shape"),
        ("sun:pose", "'sun' is a DirectionalLight and has the kinds direction, brightness."),
        ("lamp:direction", "'lamp' is a PointLight and has the kinds position, brightness."),
        ("spot:scale", "'spot' is a SpotLight and has the kinds pose, rotation, direction, position, brightness."),
        ("camera:scale", "'camera' is a camera and has the kinds pose, rotation, translation, fov."),
        ("camera:direction", "'camera' is a camera"),
        ("flat:fov", "the sensor is orthographic and has no angle of view."),
        ("sun.irradiance:pose", "is a value and has the kinds value, brightness."),
        ("floor.bsdf.reflectance.data", "has 96 values; give the kind texture."),
        ("panel.bsdf.reflectance:brightness", "a factor of zero changes nothing: give the kind value."),
        ("sun.sampling_weight", "to which no derivatives flow."),
        ("camera.x_fov", "to which no derivatives flow."),
        ("lamp.position", "the position of a light is a kind of it: give lamp:position."),
        ("ball:texture", "'ball' has no texture; textures: floor.bsdf.reflectance.data."),
        ("nothing:vertices", "0 shapes are called 'nothing'; name one mesh."),
    ],
)
def test_what_a_scene_does_not_have(resolver: Resolver, text: str, words: str) -> None:
    with pytest.raises(ShadowmapError) as raised:
        resolver.parameter(Vary.parse(text))
    message = str(raised.value)
    assert words in message and message.startswith(f"vary {text}: ") and "\n" not in message


def test_every_name_with_every_kind(resolver: Resolver) -> None:
    """Numbers, labels, units and ranges are as many as one another; all else is one line."""
    names = [
        *resolver.shapes,
        *resolver.lights,
        *resolver.sensors,
        *(sky.name for sky in resolver.renderer.data.environments),
        *resolver.keys,
        "car_*",
        "*",
        "x",
        "ball.",
    ]
    count = 0
    for name in names:
        for kind in ("", *KINDS):
            try:
                found = resolver.parameter(Vary(name, kind))
            except ShadowmapError as error:
                assert "\n" not in str(error) and str(error).startswith("vary ")
                continue
            count += 1
            if isinstance(found, (MeshVertices, TextureValues)):
                assert found.start.ndim == 1 and np.isfinite(found.start).all()
                continue
            n = len(found.labels)
            assert n > 0 and len(found.units) == n == len(found.usual) == len(found.scale.shown(np.zeros(n)))
            assert (np.asarray(found.usual) > 0).all()
            assert (found.scale.shown(np.zeros(n)) >= found.natural[0]).all()
    assert count > 60


def test_the_list_names_what_can_vary(resolver: Resolver) -> None:
    """Each name with each of its kinds is a parameter; no object is left out."""
    listed = {one.name: one.kinds for one in resolver.candidates()}
    assert {"ball", "car_body", "sun", "lamp", "spot", "camera", "flat", "sky.radiance.value"} <= listed.keys()
    assert "fov" in listed["camera"] and "fov" not in listed["flat"]
    assert not any("sampling_weight" in name or name.endswith(".position") or name.startswith("camera.") for name in listed)
    for name, kinds in listed.items():
        for kind in kinds:
            resolver.parameter(Vary(name, kind))


def test_textures_and_vertices(resolver: Resolver) -> None:
    texture = resolver.parameter(Vary.parse("floor:texture"))
    assert isinstance(texture, TextureValues) and texture.shape == (4, 8, 3) and (texture.low, texture.high) == (0, 1)
    np.testing.assert_allclose(texture.start, np.linspace(0.1, 0.9, 96), atol=1e-6)
    mesh = resolver.parameter(Vary.parse("car_wheel:vertices"))
    table = mi.traverse(resolver.renderer.data.scene)
    assert isinstance(mesh, MeshVertices)
    np.testing.assert_allclose(mesh.start, table["car_wheel.vertex_positions"].numpy(), atol=1e-6)
    np.testing.assert_array_equal(mesh.faces.ravel(), table["car_wheel.faces"].numpy())
    few, many = resolver.parameters([Vary("sun"), Vary("floor", "texture"), Vary("ball", "scale")])
    assert [one.vary.label for one in few] == ["sun", "ball:scale"] and [one.vary.label for one in many] == ["floor:texture"]


@pytest.mark.parametrize(
    ("text", "natural"),
    [
        ("ball.bsdf.diffuse_reflectance", (0, 1)),
        ("ball.bsdf.alpha", (1e-3, 1)),
        ("sun.irradiance", (0, math.inf)),
        ("spot.cutoff_angle", (0.1, 179)),
        ("sun:brightness", (0, math.inf)),
        ("camera:fov", (1, 170)),
    ],
)
def test_bounds_from_the_meaning_of_values(resolver: Resolver, text: str, natural: tuple[float, float]) -> None:
    assert resolver.parameter(Vary.parse(text)).natural == natural  # type: ignore[union-attr]


# ------------------------------------------------------------------------------------------------------------------- scales


@given(
    offset=st.floats(1e-3, 1e3),
    factor=st.floats(1e-3, 1e3),
    logarithmic=st.booleans(),
    value=st.floats(1e-3, 1e3),
    n=st.integers(1, 3),
)
def test_numbers_and_shown_values_are_inverse(offset: float, factor: float, logarithmic: bool, value: float, n: int) -> None:
    scale = Scale(np.full(n, offset), np.full(n, factor), logarithmic)
    np.testing.assert_allclose(scale.shown(scale.number(value)), value, rtol=1e-9, atol=1e-9 * (offset + factor))
    np.testing.assert_allclose(scale.shown(np.zeros(n)), offset)
    # Widths are the derivative times the half-widths.
    x, step = scale.number(value), 1e-6
    slope = (scale.shown(x + step) - scale.shown(x - step)) / (2 * step)
    np.testing.assert_allclose(scale.widths(x, np.full(n, 0.3)), 0.3 * np.abs(slope), rtol=1e-4)


def test_zero_is_no_positive_value() -> None:
    assert (Scale(np.ones(2), np.ones(2), logarithmic=True).number(0) == -np.inf).all()


@pytest.mark.parametrize("text", ["sun.irradiance", "ball.bsdf.alpha", "ball.bsdf.diffuse_reflectance", "spot.cutoff_angle"])
def test_values_of_numbers_are_those_that_are_shown(resolver: Resolver, text: str) -> None:
    """Reports show the values that are written into the scene."""
    parameter = resolver.parameter(Vary.parse(text))
    assert not isinstance(parameter, (MeshVertices, TextureValues))
    x = np.linspace(-0.1, 0.2, len(parameter.labels))
    change = SceneChange(resolver.renderer)
    parameter.put([mi.Float(float(number)) for number in x], change)
    np.testing.assert_allclose(parameter.arrays(resolver.renderer, change)["value"], parameter.scale.shown(x), rtol=1e-5)


def test_motions_of_numbers_are_those_that_are_shown(resolver: Resolver) -> None:
    """Half a turn of 60 degrees about the middle, and an offset in units of the scene."""
    parameter = resolver.parameter(Vary.parse("car_wheel:pose"))
    assert not isinstance(parameter, (MeshVertices, TextureValues))
    shown = np.array([0, 0, 60, 0.1, 0.2, -0.3])
    x = shown / parameter.scale.factor
    change = SceneChange(resolver.renderer)
    parameter.put([mi.Float(float(number)) for number in x], change)
    matrix = host_matrix(change.placements["car_wheel"])
    np.testing.assert_allclose(matrix @ [1, 0, 0.5, 1], [1.1, 0.2, 0.2, 1], atol=1e-5)  # the middle
    np.testing.assert_allclose(matrix @ [1, 0, 0, 0], [0.5, math.sqrt(0.75), 0, 0], atol=1e-5)  # anticlockwise
    change = SceneChange(resolver.renderer)
    scale = resolver.parameter(Vary.parse("ball:scale"))
    scale.put([mi.Float(math.log(2))], change)  # type: ignore[union-attr, arg-type]
    np.testing.assert_allclose(host_matrix(change.placements["ball"]) @ [0.4, 1, 0.5, 1], [0.8, 1, 0.5, 1], atol=1e-5)


def test_motions_of_one_shape_follow_one_another(resolver: Resolver) -> None:
    """A turn after a move is one about the moved middle."""
    change = SceneChange(resolver.renderer)
    move, turn = (resolver.parameter(Vary.parse(f"car_wheel:{text}")) for text in ("translation:x", "rotation:z"))
    move.put([mi.Float(2 / move.extent)], change)  # type: ignore[union-attr, arg-type]
    turn.put([mi.Float(math.pi)], change)  # type: ignore[union-attr, arg-type]
    np.testing.assert_allclose(host_matrix(change.placements["car_wheel"]) @ [1.5, 0, 0.5, 1], [2.5, 0, 0.5, 1], atol=1e-5)


def test_directions_turn_by_the_angle_that_is_shown(resolver: Resolver) -> None:
    for name in ("sun", "spot"):
        parameter = resolver.parameter(Vary(name, "direction"))
        change = SceneChange(resolver.renderer)
        parameter.put([mi.Float(0.3), mi.Float(-0.4)], change)  # type: ignore[union-attr, arg-type]
        before, after = (
            np.array(dr.detach(light.direction), np.float64).ravel()[:3]
            for light in (resolver.renderer.light(name), change.light(name))
        )
        cosine = before @ after / np.linalg.norm(before) / np.linalg.norm(after)
        assert math.acos(cosine) == pytest.approx(0.5, abs=1e-4)


def test_cameras_go_around_what_they_see(resolver: Resolver) -> None:
    """The point straight ahead, at the scene's distance, stays where it is in the picture."""
    parameter = resolver.parameter(Vary("camera"))
    change = SceneChange(resolver.renderer)
    parameter.put([mi.Float(v) for v in (0.2, -0.3, 0.1, 0, 0, 0)], change)  # type: ignore[union-attr, misc]
    ahead = np.array([0, 0, parameter.distance, 1])  # type: ignore[union-attr]
    before = host_matrix(resolver.renderer.data.cameras(0)[0].to_world)
    after = host_matrix(change.camera(0).to_world)
    np.testing.assert_allclose(after @ ahead, before @ ahead, atol=1e-4)
    assert np.linalg.norm((after - before)[:3, 3]) > 0.5
    fov = resolver.parameter(Vary("camera", "fov"))
    fov.put([mi.Float(float(fov.scale.number(60.0)[0]))], change)  # type: ignore[union-attr, arg-type]
    assert float(dr.detach(change.camera(0).x_fov)[0]) == pytest.approx(60, rel=1e-5)


def test_the_space_of_an_orthographic_camera_is_scaled() -> None:
    """Without an effect on how it goes around what it sees."""
    found = []
    for scale in (1, 4):
        to_world = camera()["to_world"] @ mi.ScalarTransform4f().scale(scale)
        own = Resolver(renderer_of(camera={"type": "orthographic", "to_world": to_world, "film": camera()["film"]}))
        change = SceneChange(own.renderer)
        own.parameter(Vary("camera")).put([mi.Float(v) for v in (0.2, -0.3, 0.1, 0, 0, 0)], change)  # type: ignore[union-attr, misc]
        found.append(host_matrix(change.camera(0).to_world)[:3, 3])
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)


def test_one_of_several_textures_is_to_be_named() -> None:
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32)), "raw": True}
    both = {"type": "roughplastic", "diffuse_reflectance": texture, "specular_reflectance": texture}
    own = Resolver(renderer_of(box={**box(0), "bsdf": both}))
    keys = [f"box.bsdf.{name}_reflectance.data" for name in ("diffuse", "specular")]
    with pytest.raises(ShadowmapError, match=f"vary box:texture: there are several, {', '.join(keys)}; name one"):
        own.parameter(Vary("box", "texture"))
    assert own.parameter(Vary(keys[1], "texture")).key == keys[1]  # type: ignore[union-attr]


def test_ranges_of_starts_are_in_units_of_the_report(resolver: Resolver) -> None:
    entries = [
        Vary("sun", "direction", spread=60),
        Vary("sun", "brightness", spread=2),
        Vary("ball", "translation", "x", spread=0.5),
    ]
    few, _ = resolver.parameters(entries)
    extent = few[2].extent  # type: ignore[attr-defined]
    np.testing.assert_allclose(half_ranges(few), [math.pi / 3] * 2 + [math.log(2), 0.5 / extent])
    assert half_ranges([]).shape == (0,)
