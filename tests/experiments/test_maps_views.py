"""Contacts and cities of the comparison of shadow maps: shapes, views, measures, and a small run."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mitsuba_baselines.derivatives import agreement
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.maps import experiment as maps
from shadowmap_dr.experiments.maps import view_run
from shadowmap_dr.experiments.maps.city import SIDE, City, make_city
from shadowmap_dr.experiments.maps.city_views import city_views, file_meshes, file_views, protocol_places
from shadowmap_dr.experiments.maps.contacts import CONTACTS
from shadowmap_dr.experiments.maps.experiment import MapsOptions, run_maps
from shadowmap_dr.experiments.maps.solids import Solid, prism, rectangle, roof, turned
from shadowmap_dr.experiments.maps.view import points_of, seen_by
from shadowmap_dr.experiments.maps.view_metrics import FARTHEST, Truth, detachment, view_metrics
from shadowmap_dr.rendering.renderer import Renderer


@pytest.fixture(scope="module")
def city() -> City:
    """The city of the experiment."""
    return make_city()


@pytest.fixture(scope="module")
def hamlet() -> City:
    """A city of a few blocks, in which everything occurs."""
    return make_city(scale=0.1)


def volume(solid: Solid) -> float:
    """Signed volume, positive if faces look outwards."""
    a, b, c = (solid.points[solid.faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


@pytest.mark.parametrize(
    ("solid", "expected"),
    [
        (prism(rectangle(0, 0, 2, 3), 1.0, 5.0), 24.0),
        (roof(rectangle(0, 0, 4, 2), 1.0, 3.0, True), 12.0),
        (roof(rectangle(0, 0, 4, 2), 1.0, 3.0, False, 0.5), 8.0),
        (turned([(1.0, 0.0), (1.0, 2.0)], 64), 2 * np.pi),
    ],
)
def test_solids_are_closed_and_turned_outwards(solid: Solid, expected: float) -> None:
    assert volume(solid) == pytest.approx(expected, rel=2e-3)
    edges = np.concatenate([solid.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    assert {tuple(edge) for edge in edges.tolist()} == {tuple(edge) for edge in edges[:, ::-1].tolist()}
    assert solid.rise.shape == (len(solid.points),)


def test_the_city_is_large_and_the_same_each_time(city: City) -> None:
    points = np.concatenate([body.solid.points for body in city.bodies])
    assert np.all(np.abs(np.ptp(points, axis=0)[:2] - SIDE) < 0.1 * SIDE)
    assert 30_000 <= city.triangles <= 50_000 and 300 <= len(city.bodies) <= 1000
    names = [body.name for body in city.bodies]
    assert len(set(names)) == len(names) and names[0] == "ground"
    assert {"house", "church", "tower", "column", "statue", "fence", "mast", "lamp"} <= {name.split("_")[0] for name in names}
    again = make_city()
    assert all(np.array_equal(a.solid.points, b.solid.points) for a, b in zip(city.bodies, again.bodies, strict=True))
    assert not np.array_equal(make_city(seed=4).bodies[0].solid.points, city.bodies[0].solid.points)


def test_scale_is_the_size_of_the_city(city: City) -> None:
    """A city of 6 has 5,000 shapes and 300,000 triangles."""
    large = make_city(scale=2.0)
    assert large.triangles / city.triangles == pytest.approx(2, rel=0.15)
    assert len(large.bodies) / len(city.bodies) == pytest.approx(2, rel=0.15)


def test_heights_of_buildings_change(city: City) -> None:
    body = city.buildings[7]
    low, high = (city.building_points(7, body.height + change) for change in (0.0, 2.0))
    np.testing.assert_allclose(low, body.solid.points, atol=1e-4)
    up = high - low
    assert up.shape == body.solid.points.shape and np.abs(up[:, :2]).max() == 0
    np.testing.assert_allclose(up[:, 2], 2 * body.solid.rise, atol=1e-4)
    assert set(np.unique(body.solid.rise)) == {0.0, 1.0}


def test_streets_are_low_places(variant: str, hamlet: City) -> None:
    first, second, air = protocol_places(hamlet.meshes())
    ground = hamlet.bodies[0].solid.points
    for street in (first, second):
        near = np.argmin(np.hypot(ground[:, 0] - street.origin[0], ground[:, 1] - street.origin[1]))
        assert street.origin[2] - 5 == pytest.approx(ground[near, 2], abs=1.0)
    assert first.origin[2] <= second.origin[2] < air.origin[2]


def test_views_of_a_city_have_motions_with_one_sun(variant: str, hamlet: City) -> None:
    views = list(city_views(hamlet))
    assert len(views) == 16 and len({view.name for view in views}) == 16
    moving = [view for view in views if view.motions]
    assert len(moving) == len({view.origin for view in moving}) == 4
    assert moving[-1].motions.keys() == {"sun", "height", "place"}


def test_motions_and_scenes_agree(variant: str) -> None:
    view = CONTACTS["box"]()
    moved = {shape.id(): shape for shape in view.scene(16, "place", 0.25).shapes()}
    np.testing.assert_allclose(points_of(moved["box"]) - points_of(view.meshes["box"]), [[0.25, 0, 0]] * 8, atol=1e-6)
    np.testing.assert_array_equal(points_of(moved["table"]), points_of(view.meshes["table"]))
    turned_sun = mi.traverse(view.scene(16, "sun", 0.1))["sun.to_world"]
    np.testing.assert_allclose(np.array(turned_sun.matrix)[:3, 2].ravel(), view.direction(0.1), atol=1e-6)
    assert view.step("place", 256) == 2 * view.step("place", 512)


@pytest.mark.parametrize("motion", ["sun", "place"])
def test_derivatives_are_those_of_the_motions(variant: str, motion: str) -> None:
    """Against differences of our own images. The map is fitted anew for each sun: texels differ a little."""
    view = CONTACTS["box"]()
    step = view.step(motion, 128)
    derivative = view.derivative(Renderer.from_scene(view.scene(128)), motion)
    low, high = (np.array(Renderer.from_scene(view.scene(128, motion, s * step)).render())[..., :3] for s in (-1, 1))
    found = agreement(derivative, (high - low) / np.float32(2 * step), 4.0)
    assert found.cosine > 0.92 and found.scale == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("name", CONTACTS)
def test_contacts_have_shadows_in_view(variant: str, name: str) -> None:
    view = CONTACTS[name]()
    scene = view.scene(96)
    seen = seen_by(view, scene, 96)
    assert np.isfinite(seen.p_world[seen.shape >= 0]).all() and np.isnan(seen.p_world[seen.shape < 0]).all()
    assert not view.caster or (seen.shape == list(view.meshes).index(view.caster)).sum() > 50
    assert (seen.caster >= 0).any() and np.array_equal(seen.caster >= 0, np.isfinite(seen.p_caster[..., 0]))
    assert seen.lit.any() and not (seen.lit & (seen.caster >= 0)).any()
    traced = np.array(mi.render(scene, integrator=mi.load_dict({"type": "direct"}), spp=4))
    bare = np.array(Renderer.from_scene(scene, shadow_method="none").render())
    dark = Truth.of(traced, bare).dark.mean()
    assert 0.0003 < dark < 0.5, dark


def rows(*values: float) -> np.ndarray:
    """A visibility image of 40 equal rows."""
    return np.tile(np.array(values, np.float32), (40, 1))


def truth_of(visibility: np.ndarray) -> Truth:
    bare = np.full((*visibility.shape, 3), 0.5, np.float32)
    return Truth.of(bare * visibility[..., None], bare)


def test_view_metrics_tell_light_in_shadow_from_dark_in_light() -> None:
    visibility = np.ones((40, 40), np.float32)
    visibility[10:30, 10:30] = 0
    truth = truth_of(visibility)
    assert truth.dark.sum() == 400 and truth.lit.sum() == 1200
    right = view_metrics(0.5 * visibility[..., None].repeat(3, -1), truth)
    assert all(value == 0 for value in right.values()), right
    leaking = visibility.copy()
    leaking[10:30, 10:12] = 1  # light along a border, two pixels wide
    found = view_metrics(0.5 * leaking[..., None].repeat(3, -1), truth)
    assert found["light_in_shadow"] == pytest.approx(0.1) and found["light_in_shadow_inside"] == found["dark_in_light"] == 0
    stained = visibility * np.where(visibility > 0, np.float32(0.75), np.float32(1))
    assert view_metrics(0.5 * stained[..., None].repeat(3, -1), truth)["dark_in_light"] == pytest.approx(0.25)
    nothing = view_metrics(np.zeros((40, 40, 3), np.float32), truth_of(np.ones((40, 40), np.float32)))
    assert np.isnan(nothing["light_in_shadow"]) and nothing["rmse"] == 1


def test_detachment_is_a_distance_from_the_caster() -> None:
    truth = truth_of(rows(1, 1, 1, 0, 0, 0, 0, 0, *[1] * 30))
    caster = np.zeros_like(truth.dark)
    caster[:, :3] = True
    assert detachment(truth.visibility, truth, caster, (1, 0)) == 0
    for lit in (1, 3):
        late = rows(1, 1, 1, *[1] * lit, *[0] * (5 - lit), *[1] * 30)
        assert detachment(late, truth, caster, (1, 0)) == lit
    assert detachment(np.ones_like(late), truth, caster, (1, 0)) == FARTHEST
    # A gap in the traced image does not count; shadows on the other side are not looked for.
    apart = truth_of(rows(1, 1, 1, 1, 0, 0, 0, 0, *[1] * 30))
    assert detachment(rows(1, 1, 1, 1, 1, 0, 0, 0, *[1] * 30), apart, caster, (1, 0)) == 1
    assert np.isnan(detachment(truth.visibility, truth, caster, (-1, 0)))


def test_a_city_of_a_file(variant: str, tmp_path: Path, hamlet: City) -> None:
    folder = tmp_path / "munich"
    folder.mkdir()
    lines = []
    for name, mesh in hamlet.meshes().items():
        mesh.write_ply(str(folder / f"{name}.ply"))
        lines.append(f'<shape type="ply" id="mesh-{name}"><string name="filename" value="{name}.ply"/></shape>')
    (folder / "munich.xml").write_text(f'<scene version="2.1.0">{"".join(lines)}<bsdf type="unknown"/></scene>')
    meshes = file_meshes(folder / "munich.xml")
    assert len(meshes) == len(hamlet.bodies)
    np.testing.assert_allclose(points_of(meshes["mesh-ground"]), hamlet.bodies[0].solid.points, atol=1e-3)
    # A building in two materials is one mesh.
    text, (one, two) = (folder / "munich.xml").read_text(), [f"mesh-{body.name}" for body in hamlet.bodies[1:3]]
    both = text.replace(f'"{one}"', '"mesh-inn-itu_marble"').replace(f'"{two}"', '"mesh-inn-itu_metal"')
    (folder / "munich.xml").write_text(both)
    joined = file_meshes(folder / "munich.xml")
    assert len(joined) == len(meshes) - 1
    points = np.concatenate([points_of(meshes[one]), points_of(meshes[two])])
    np.testing.assert_array_equal(points_of(joined["mesh-inn"]), points)
    corners = [points_of(mesh)[np.array(mesh.faces_buffer()).reshape(-1, 3)] for mesh in (meshes[one], meshes[two])]
    own = np.array(joined["mesh-inn"].faces_buffer()).reshape(-1, 3)
    np.testing.assert_array_equal(points_of(joined["mesh-inn"])[own], np.concatenate(corners))
    (folder / "munich.xml").write_text(text)
    assert next(file_views(folder / "munich.xml")).name == "munich, street 0, sun 20"
    assert MapsOptions(city_folder=tmp_path).city_folder == tmp_path
    with pytest.raises(ShadowmapError, match="munich"):
        MapsOptions(city_folder=folder)
    (folder / "house_000.ply").write_text("no mesh")
    with pytest.raises(ShadowmapError, match="munich.xml"):
        file_meshes(folder / "munich.xml")
    (folder / "munich.xml").write_text("<scene/>")
    with pytest.raises(ShadowmapError, match="no meshes"):
        file_meshes(folder / "munich.xml")


def test_small_run_of_views(variant: str, tmp_path: Path) -> None:
    options = MapsOptions(
        scenes=("box",), candidates=("evsm4",), resolution=96, view_spp=4, pose_runs=0, rounds=2, out=tmp_path / "m"
    )
    record = run_maps(options)
    stored = json.loads((tmp_path / "m" / "maps.json").read_text())
    assert stored["scenes"] == {} and stored["views"].keys() == {"box"}
    assert (tmp_path / "m" / "views.png").stat().st_size > 1000 and not (tmp_path / "m" / "maps.png").exists()
    entry = record["views"]["box"]["methods"]["evsm4"]
    assert 0 < entry["light_in_shadow"] < 0.5 and entry["rmse"] < 0.2 and abs(entry["detachment_pixels"]) < 3
    assert entry["derivatives"].keys() == {"sun", "place"} and entry["derivatives"]["place"]["cosine"] > 0.7
    assert np.isfinite(entry["seconds"])
    faults, derivatives = maps.tables(record)
    assert faults.row_count == derivatives.row_count == 1
    assert view_run.faults_table({"scenes": {}}) is None


def test_views_that_are_hardly_dark_are_left_out(variant: str, hamlet: City) -> None:
    view = next(iter(city_views(hamlet)))
    options = view_run.ViewOptions({}, 16, 64, 3, 4)
    away = view.__class__(view.name, view.meshes, (0, 0, 500), (0, 0, 900), 20, least_dark=0.01)
    assert view_run.measure(away, options, lambda text: None) == ({}, {})
