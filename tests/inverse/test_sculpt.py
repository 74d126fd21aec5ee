"""Shadow art: views, shadow images, smoothness, and the sculptor."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.experiments.common.objects import occluder
from shadowmap_dr.inverse import Sculptor, even_sphere, shadow_view
from shadowmap_dr.inverse.shadow_art.smoothness import inverted_share, normal_consistency
from shadowmap_dr.raster import build_topology
from shadowmap_dr.rendering.receivers.shadow_images import shadow_images
from shadowmap_dr.rendering.receivers.shadow_views import BESIDE, FOV_DEG, LOOKS_AT, WAVE_HEIGHT, height

SIZE = 48


def flat(array):
    return mi.Float(np.asarray(array, np.float32).ravel())


def square(x0, x1, y0, y1):
    """Target: dark between these coordinates of the receiver (-2..2, y up), lit elsewhere."""
    line = 4 * (np.arange(SIZE) + 0.5) / SIZE - 2
    x, y = np.meshgrid(line, -line)
    return np.where((x > x0) & (x < x1) & (y > y0) & (y < y1), 0.0, 1.0)


def small(variant, targets=None, views=None, **options):
    vertices, faces = even_sphere(8, 0.9)
    return Sculptor(vertices, faces, views or [shadow_view(size=SIZE)], targets, map_resolution=SIZE, filter_size=3, **options)


def overlap(image, target):
    dark, wanted = image < 0.5, target < 0.5
    return (dark & wanted).sum() / (dark | wanted).sum()


def test_sphere_is_closed_with_equal_triangles():
    vertices, faces = even_sphere(40, 1.5)
    assert faces.shape == (12_800, 3) and vertices.shape == (6_402, 3)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.5, rtol=1e-6)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(edge) for edge in directed.tolist()} == {tuple(edge[::-1]) for edge in directed.tolist()}
    p = vertices[faces].astype(np.float64)
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    assert ((normal * p.mean(1)).sum(1) > 0).all()
    area = 0.5 * np.linalg.norm(normal, axis=1)
    assert area.max() < 2 * area.min() and area.sum() == pytest.approx(4 * np.pi * 2.25, rel=2e-3)


def test_orthographic_pixels_lie_on_the_receiver_in_reading_order():
    view = shadow_view(size=32)
    np.testing.assert_allclose(view.points[..., 2], -4)
    np.testing.assert_allclose(view.points[0, 0, :2], [-1.9375, 1.9375])
    np.testing.assert_allclose(view.points[0, -1, :2], [1.9375, 1.9375])
    side = shadow_view((-1, 0, 0), size=32)
    np.testing.assert_allclose(side.points[0, -1], [-4, 1.9375, -1.9375])


@pytest.mark.parametrize("receiver", ["plane", "wavy"])
def test_perspective_pixels_see_the_first_point_of_the_receiver(receiver):
    view = shadow_view(size=64, receiver=receiver, camera="perspective")
    assert 0.3 < view.seen.mean() < 0.9
    p = view.points.astype(np.float64) - [0, 0, -4]
    np.testing.assert_allclose(p[..., 2][view.seen], height(receiver, p[..., 0], 2.0)[view.seen], atol=1e-5)
    # Seen from the camera, each point lies where its pixel is, and nothing of the receiver lies before it.
    offset = p - np.array(BESIDE)
    ahead = np.subtract(LOOKS_AT, BESIDE) / np.linalg.norm(np.subtract(LOOKS_AT, BESIDE))
    right = np.cross(ahead, [0, 1, 0]) / np.linalg.norm(np.cross(ahead, [0, 1, 0]))
    scale = np.tan(np.radians(FOV_DEG / 2)) * (offset @ ahead)
    row, column = np.nonzero(view.seen)
    np.testing.assert_allclose(((offset @ right) / scale)[view.seen], (2 * column + 1) / 64 - 1, atol=1e-4)
    np.testing.assert_allclose(((offset @ np.cross(right, ahead)) / scale)[view.seen], 1 - (2 * row + 1) / 64, atol=1e-4)
    for share in np.linspace(0.02, 0.98, 60):
        between = np.array(BESIDE) + share * offset
        above = between[..., 2] > height(receiver, between[..., 0], 2.0)
        assert (above | (np.abs(between[..., 0]) > 2) | (between[..., 2] > WAVE_HEIGHT))[view.seen].all()


def test_views_refuse_what_makes_no_sense():
    for arguments in (
        {"receiver": "ball"},
        {"camera": "fisheye"},
        {"size": 4},
        {"half": -1},
        {"direction": (0, 2, 0)},
        {"direction": (0, 0, 0)},
        {"up": (np.nan, 0, 0)},
        {"up": "up"},
        {"direction": None},
        {"direction": [(1, 2), 3]},
        {"size": "large"},
        {"size": 32.5},
        {"half": None},
        {"receiver": []},
        {"camera": {}},
    ):
        with pytest.raises(ShadowmapError):
            shadow_view(**arguments)


def test_shadow_of_a_sphere_has_its_area_and_place(variant):
    vertices, faces = even_sphere(24, 0.7)
    vertices = vertices + np.float32([0.5, 0.25, -0.5])
    views = [shadow_view(size=128), shadow_view((-1, 0, 0), size=128)]
    shadows = shadow_images(vertices, faces, views, map_resolution=128, filter_size=3)
    front, side = (1 - image for image in shadows.images(shadows.visibility(flat(vertices))))
    line = 4 * (np.arange(128) + 0.5) / 128 - 2
    for image, (x, y) in ((front, (0.5, 0.25)), (side, (0.5, 0.25))):  # the side's right is -z
        assert image.sum() * (4 / 128) ** 2 == pytest.approx(np.pi * 0.49, rel=6e-3)
        assert (image.sum(0) @ line) / image.sum() == pytest.approx(x, abs=2e-3)
        assert (image.sum(1) @ -line) / image.sum() == pytest.approx(y, abs=2e-3)
        assert image.min() == pytest.approx(0, abs=1e-4) and image.max() == pytest.approx(1, abs=1e-4)


def test_wavy_receivers_have_the_same_shadow_from_the_light(variant):
    vertices, faces = even_sphere(16, 0.8)
    images = []
    for receiver in ("plane", "wavy"):
        shadows = shadow_images(vertices, faces, [shadow_view(size=SIZE, receiver=receiver)], map_resolution=SIZE)
        images += shadows.images(shadows.visibility(flat(vertices)))
    np.testing.assert_allclose(*images, atol=2e-5)


@pytest.mark.parametrize(("receiver", "camera"), [("plane", "orthographic"), ("wavy", "perspective")])
def test_shadows_are_where_mitsubas_rays_meet_the_object(variant, receiver, camera):
    vertices, faces = even_sphere(16)
    vertices = vertices * np.float32([1.2, 0.7, 1.0]) + np.sin(5 * vertices[:, [1, 2, 0]]) * np.float32(0.25)
    views = [shadow_view(direction, size=64, receiver=receiver, camera=camera) for direction in ((0, 0, -1), (-1, 0, 0.5))]
    shadows = shadow_images(vertices, faces, views, map_resolution=128, filter_size=3)
    scene = mi.load_dict({"type": "scene", "object": occluder("object", vertices.astype(np.float32), faces)})
    for view, image in zip(views, shadows.images(shadows.visibility(flat(vertices))), strict=True):
        points = mi.Point3f(*(flat(view.points.reshape(-1, 3)[:, c]) for c in range(3)))
        lit = ~np.array(scene.ray_test(mi.Ray3f(points, mi.Vector3f(*(-view.forward).tolist())))).reshape(64, 64)
        assert ((image > 0.5) == lit)[view.seen].mean() > 0.985
        assert 0.1 < lit[view.seen].mean() < 0.9


@pytest.mark.parametrize("camera", ["orthographic", "perspective"])
def test_shadow_images_have_the_derivative_of_differences(variant, camera):
    vertices, faces = even_sphere(10, 0.8)
    shadows = shadow_images(vertices, faces, [shadow_view(size=SIZE, camera=camera)], map_resolution=SIZE)
    wanted = flat(np.linspace(0, 1, SIZE)[:, None] * np.linspace(1, 0.5, SIZE))
    velocity = flat(vertices * [1.0, 0.5, 0.0] + [0.2, 0.0, 0.0])

    def loss(t):
        seen = shadows.visibility(flat(vertices) + t * velocity)
        return dr.sum(shadows.weight * dr.square(seen - wanted))

    # The derivative's integral: single ones differ by a few per cent, with where outlines lie between texels.
    slopes = []
    for middle in np.linspace(-0.1, 0.1, 33)[1::2]:
        t = mi.Float(middle)
        dr.enable_grad(t)
        dr.backward(loss(t))
        slopes.append(float(dr.grad(t)[0]))
    difference = float(loss(mi.Float(0.1))[0] - loss(mi.Float(-0.1))[0])
    assert 0.2 * np.mean(slopes) == pytest.approx(difference, rel=0.02) and abs(difference) > 0.01


def test_normal_consistency_of_a_fold(variant):
    faces = np.array([[0, 1, 2], [1, 0, 3]])
    for angle in (0.0, 0.5, 2.5, 2.7):
        vertices = np.array([[0, 0, 0], [0, 1, 0], [-1, 0.3, 0], [np.cos(angle), 0.6, np.sin(angle)]], np.float32)
        topology = build_topology(faces, vertices, mi.UInt32)
        p = flat(vertices)
        dr.enable_grad(p)
        value = normal_consistency(p, topology)
        assert float(value[0]) == pytest.approx(1 - np.cos(angle), abs=1e-5)
        dr.backward(value)
        turn = np.array([-np.sin(angle), 0, np.cos(angle)])
        assert np.array(dr.grad(p)).reshape(-1, 3)[3] @ turn == pytest.approx(np.sin(angle), abs=1e-4)
        assert inverted_share(vertices, faces) == float(angle > np.radians(150))


def test_triangles_without_area_leave_the_derivative_finite(variant):
    vertices = np.array([[0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, 0.5, 0]], np.float32)
    p = flat(vertices)
    dr.enable_grad(p)
    dr.backward(normal_consistency(p, build_topology(np.array([[0, 1, 2], [1, 0, 3]]), vertices, mi.UInt32)))
    assert np.isfinite(np.array(dr.grad(p))).all()


def test_folded_triangles_are_counted():
    vertices, faces = even_sphere(6)
    assert inverted_share(vertices, faces) == 0
    vertices[0] = [0, 1, 0.6]  # the pole is pulled over the ring around it
    assert 2 / len(faces) <= inverted_share(vertices, faces) <= 16 / len(faces)


def test_recorded_steps_reach_targets_that_change(variant):
    sculptor = small(variant, [square(-1.2, 1.2, -0.8, 0.8)])
    for _ in range(60):
        sculptor.step()
    assert overlap(sculptor.visibility()[0], sculptor.target(0)) > 0.93
    recordings = sculptor.recordings()
    sculptor.set_target(0, square(-0.7, 0.7, -1.3, 1.3))
    before = overlap(sculptor.visibility()[0], sculptor.target(0))
    for _ in range(60):
        sculptor.step()
    assert before < 0.6 and overlap(sculptor.visibility()[0], sculptor.target(0)) > 0.93
    assert sculptor.recordings() == recordings and sculptor.steps == 120
    assert inverted_share(sculptor.vertices(), sculptor.faces) < 0.005
    for size in range(12):  # wherever in memory they happen to be
        kept = [np.zeros(size + 1, np.float32), square(-0.1 * size, 0.9, -0.9, 0.9)]
        sculptor.set_target(0, kept[1])
        sculptor.step()
    assert sculptor.recordings() == recordings


def test_recorded_steps_serve_two_views(variant):
    views = [shadow_view(size=SIZE), shadow_view((-1, 0, 0), size=SIZE)]
    sculptor = small(variant, [square(-1.2, 1.2, -1, 1), square(-0.6, 0.6, -1, 1)], views)
    for _ in range(80):
        sculptor.step()
    for k, image in enumerate(sculptor.visibility()):
        assert overlap(image, sculptor.target(k)) > 0.92
    extent = np.ptp(sculptor.vertices(), axis=0)
    assert extent[0] == pytest.approx(2.4, abs=0.2) and extent[2] == pytest.approx(1.2, abs=0.2)


def test_without_targets_recorded_steps_keep_the_shadow(variant):
    sculptor = small(variant, consistency=0.0)
    np.testing.assert_allclose(sculptor.target(0), sculptor.visibility()[0])
    loss = sculptor.step()
    assert float(loss[0]) < 1e-9
    assert np.abs(sculptor.vertices() - even_sphere(8, 0.9)[0]).max() < 0.02


def test_recorded_consistency_smooths_the_surface(variant):
    vertices, faces = even_sphere(8, 0.9)
    vertices *= np.random.default_rng(0).uniform(0.85, 1.15, (len(vertices), 1)).astype(np.float32)
    topology = build_topology(faces, vertices, mi.UInt32)
    rough = []
    for consistency in (0.0, 0.2):
        sculptor = Sculptor(vertices, faces, [shadow_view(size=SIZE)], map_resolution=SIZE, smoothness=1, consistency=consistency)
        for _ in range(10):
            sculptor.step()
        rough.append(float(normal_consistency(flat(sculptor.vertices()), topology)[0]))
    assert rough[1] < 0.7 * rough[0]


def test_recorded_state_goes_on_exactly(variant):
    target = square(-1.2, 1.2, -0.8, 0.8)
    first, second = small(variant, [target]), small(variant, [target])
    for _ in range(3):
        first.step()
    second.load_state(first.state())
    losses = [(float(first.step()[0]), float(second.step()[0])) for _ in range(3)]
    for a, b in losses:
        assert a == pytest.approx(b, rel=1e-4)
    np.testing.assert_allclose(first.vertices(), second.vertices(), atol=1e-4)
    assert second.steps == 6


def test_recorded_reset_and_calm(variant):
    sculptor = small(variant, [square(-1.2, 1.2, -0.8, 0.8)])
    for _ in range(3):
        sculptor.step()
    moved = sculptor.vertices()
    sculptor.calm()
    np.testing.assert_allclose(sculptor.vertices(), moved, atol=1e-5)
    assert not sculptor.state()["m"].any() and sculptor.state()["u"].any()
    sculptor.reset()
    np.testing.assert_allclose(sculptor.vertices(), even_sphere(8, 0.9)[0], atol=1e-5)
    sculptor.reset(moved)
    np.testing.assert_allclose(sculptor.vertices(), moved, atol=1e-5)


def test_sculptors_refuse_what_they_cannot_use(variant):
    vertices, faces = even_sphere(4)
    views = [shadow_view(size=SIZE)]
    lit = np.ones((SIZE, SIZE))
    for arguments in (
        (vertices, faces, []),
        (vertices, faces, views, []),
        (vertices, faces, views, [lit[:-1]]),
        (vertices, faces, views, [lit * 2]),
        (vertices, faces, views, [lit * np.nan]),
        (vertices[:, :2], faces, views),
        (vertices * np.nan, faces, views),
        (vertices, faces + 100, views),
        (vertices, faces.astype(np.int64) - 1, views),
        (vertices, faces.astype(float), views),
        (vertices.astype(complex), faces, views),
        ("sphere", faces, views),
        (vertices, None, views),
        (vertices, faces, views, [lit.astype(complex)]),
        (vertices, faces, views, ["lit"]),
    ):
        with pytest.raises(ShadowmapError):
            Sculptor(*arguments, map_resolution=SIZE)
    for options in (
        {"step_size": 0},
        {"smoothness": -1},
        {"consistency": np.nan},
        {"map_resolution": 0},
        {"method": "magic"},
        {"step_size": "x"},
        {"smoothness": None},
        {"consistency": True},
    ):
        with pytest.raises(ShadowmapError):
            Sculptor(vertices, faces, views, **options)
    sculptor = Sculptor(vertices, faces, views, [lit], map_resolution=SIZE)
    for change, *arguments in (
        (sculptor.set_target, 1, lit),
        (sculptor.set_target, "a", lit),
        (sculptor.set_target, 0, lit[1:]),
        (sculptor.reset, vertices[1:]),
    ):
        with pytest.raises(ShadowmapError):
            change(*arguments)
    np.testing.assert_array_equal(sculptor.target(0), lit)
