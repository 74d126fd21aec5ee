"""Cameras of photographs against OpenCV, COLMAP and what Mitsuba renders through them."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import shadowmap_dr
from shadowmap_dr import ShadowmapError, cameras
from shadowmap_dr.cameras import Camera

cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install '.[photos]'")

COLMAP = Path(__file__).parent / "colmap"
DISTORTIONS = {
    "none": ((), False),
    "four": ((-0.2, 0.05, 1e-3, -2e-3), False),
    "five": ((-0.2, 0.05, 1e-3, -2e-3, 0.01), False),
    "eight": ((-0.1, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.01), False),
    "twelve": ((-0.1, 0.05, 1e-3, -2e-3, 0.01, 0.1, 0.02, 0.01, 1e-3, -1e-3, 2e-3, 1e-3), False),
    "fisheye": ((0.02, -0.01, 3e-3, -1e-3), True),
}
K = np.array([[150.0, 0, 70], [0, 130, 44], [0, 0, 1]])


def placed(**changes: Any) -> Camera:
    """A camera that looks at the origin from somewhere."""
    camera = cameras.look_at((1, 2, 5), (0.1, 0, 0), (0, 1, 0), fov=40, width=128, height=96)
    return dataclasses.replace(camera, **changes)


def points(count: int = 50) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (count, 3))


@pytest.mark.parametrize(("coefficients", "fisheye"), DISTORTIONS.values(), ids=DISTORTIONS)
@pytest.mark.parametrize("as_vector", [False, True])
def test_projections_are_those_of_opencv(coefficients: tuple[float, ...], fisheye: bool, as_vector: bool) -> None:
    turn, t = cv2.Rodrigues(np.array([0.3, -0.5, 0.2]))[0], np.array([0.1, -0.2, 4.0])
    camera = cameras.from_opencv(K, cv2.Rodrigues(turn)[0] if as_vector else turn, t, 128, 96, coefficients, fisheye)
    if fisheye:
        expected, _ = cv2.fisheye.projectPoints(points()[:, None], cv2.Rodrigues(turn)[0], t, K, np.array(coefficients))
    else:
        expected, _ = cv2.projectPoints(points(), turn, t, K, np.array(coefficients) if coefficients else None)
    np.testing.assert_allclose(camera.project(points()) - 0.5, expected.reshape(-1, 2), atol=1e-6)
    np.testing.assert_array_equal(camera.K, K)


def test_text_for_scene_files_is_the_same_sensor(variant: str, tmp_path: Path) -> None:
    camera = placed(fx=140.0, fy=140.0, cx=70.5, cy=41.5)
    file = tmp_path / "scene.xml"
    file.write_text(f'<scene version="3.0.0">{camera.xml("view", near=0.1)}</scene>')
    read = mi.load_file(str(file)).sensors()[0]
    same = cameras.from_sensor(read)
    assert read.id() == "view" and read.near_clip() == pytest.approx(0.1) and (same.width, same.height) == (128, 96)
    np.testing.assert_allclose(same.K, camera.K, rtol=1e-6)
    np.testing.assert_allclose(same.to_world, camera.to_world, atol=1e-6)
    with pytest.raises(ShadowmapError, match=r"take camera.undistorted\(\)"):
        placed(fx=100.0, fy=120.0).xml()


def test_rotation_vectors_are_those_of_opencv() -> None:
    for vector in (np.zeros(3), *np.random.default_rng(0).normal(size=(10, 3)), np.array([math.pi, 0, 0])):
        np.testing.assert_allclose(cameras.camera.rotation_from_vector(vector), cv2.Rodrigues(vector)[0], atol=1e-12)


def seen_at(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(positions (N, 3) that pixels show, centres (N, 2) of these pixels)."""
    row, column = np.nonzero(image[..., 6])
    return image[row, column, 3:6], np.stack([column, row], -1) + 0.5


@pytest.mark.parametrize("square", [True, False])
def test_renderers_see_what_opencv_projects(variant: str, square: bool) -> None:
    """A principal point off the middle; and pixels that are not square, which records keep."""
    camera = placed(fx=150.0, fy=150.0 if square else 121.0, cx=70.5, cy=40.25)
    ball = {"type": "sphere", "radius": 1.2}
    scene = {"type": "scene", "camera": placed().sensor(), "ball": ball, "sun": {"type": "directional", "direction": [0, -1, -1]}}
    renderer = shadowmap_dr.Renderer.from_scene(mi.load_dict(scene), aovs=("position", "depth"))
    position, pixel = seen_at(np.array(renderer.render(sensor=camera.record())))
    assert len(position) > 1000
    projected, _ = cv2.projectPoints(position, camera.rotation, camera.translation, camera.K, None)
    assert np.abs(projected.reshape(-1, 2) + 0.5 - pixel).max() < 0.02
    if square:
        traced = mi.render(mi.load_dict({**scene, "camera": camera.sensor()}), spp=1, integrator=mi.load_dict({
            "type": "aov", "aovs": "position:position,depth:depth", "nested": {"type": "direct"},
        }))  # fmt: skip
        image = np.array(traced)
        position, pixel = seen_at(image)
        projected = camera.project(position)
        # Mitsuba's rays pass anywhere through a pixel.
        assert len(position) > 1000 and np.abs(projected - pixel).max() < 0.5 + 1e-3 and abs((projected - pixel).mean()) < 0.02


def test_sensors_become_cameras_again(variant: str) -> None:
    camera = placed(cx=70.5, cy=40.25)
    for again in (cameras.from_sensor(mi.load_dict(camera.sensor())), cameras.from_sensor(camera.record())):
        np.testing.assert_allclose(again.project(points()), camera.project(points()), atol=1e-3)
        assert (again.width, again.height) == (128, 96)
    window = cameras.from_sensor(mi.load_dict(camera.sensor(crop_offset_x=10, crop_offset_y=20, crop_width=50, crop_height=40)))
    np.testing.assert_allclose(window.project(points()) + [10, 20], camera.project(points()), atol=1e-3)
    assert (window.width, window.height) == (50, 40)
    uneven = placed(fx=150.0, fy=121.0)
    assert cameras.from_sensor(uneven.record()).fy == pytest.approx(121, rel=1e-5)
    with pytest.raises(ShadowmapError, match="no single perspective camera"):
        cameras.from_sensor(mi.load_dict({"type": "orthographic"}))


@pytest.mark.parametrize(("coefficients", "fisheye"), DISTORTIONS.values(), ids=DISTORTIONS)
def test_undistorted_pictures_are_those_of_a_pinhole(coefficients: tuple[float, ...], fisheye: bool) -> None:
    """A picture whose colours are functions of directions, so that its undistorted form is known."""
    camera = placed(fx=110.0, fy=131.0, cx=66.0, cy=45.0, distortion=coefficients, fisheye=fisheye)

    def colours(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(3 * x + y), np.cos(2 * y), x * y], -1).astype(np.float32)

    row, column = np.mgrid[:96, :128].reshape(2, -1)
    places = np.stack([column, row], -1).astype(np.float64)[:, None]
    undo = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    flat = undo(places, camera.K, np.array(coefficients or (0.0,) * 4)).reshape(-1, 2)
    photo = colours(*flat.T).reshape(96, 128, 3)
    picture, shown = cameras.undistort(photo, camera)
    pinhole = camera.undistorted()
    assert pinhole.is_square and (pinhole.width, pinhole.height) == (128, 81) and picture.shape == (81, 128, 3)
    row, column = np.mgrid[:81, :128]
    expected = colours((column + 0.5 - pinhole.cx) / pinhole.fx, (row + 0.5 - pinhole.cy) / pinhole.fy)
    assert shown.mean() > 0.8
    np.testing.assert_allclose(picture[shown], expected[shown], atol=4e-3)
    assert np.all(picture[~shown] == 0)


def test_masks_and_types_of_pictures() -> None:
    camera = placed(fy=121.0, distortion=(-0.2, 0.05, 0, 0))
    mask = np.ones((96, 128), bool)
    mask[40:50, 60:70] = False
    for kind in (np.uint8, np.uint16, np.float32, np.float64):
        photo = np.full((96, 128, 3), 100, kind)
        picture, shown = cameras.undistort(photo, camera, mask)
        assert picture.dtype == kind and np.all(picture[shown] == 100) and 100 < (~shown).sum() < 3000
    assert cameras.undistort(np.zeros((96, 128)), camera)[0].ndim == 2
    plain = np.random.default_rng(0).uniform(size=(96, 128))
    np.testing.assert_array_equal(cameras.undistort(plain, placed())[0], plain)
    with pytest.raises(ShadowmapError, match="96 rows and 128 columns"):
        cameras.undistort(np.zeros((48, 64, 3)), camera)
    with pytest.raises(ShadowmapError, match="give one of the picture's size"):
        cameras.undistort(np.zeros((96, 128, 3)), camera, np.ones((3, 3), bool))


def test_polynomials_that_turn_back_show_nothing_twice() -> None:
    """Beyond its range, strong distortion would show the middle of the photo again."""
    camera = placed(fx=60.0, fy=60.0, distortion=(-0.4, 0, 0, 0))
    _, shown = cameras.undistort(np.ones((96, 128)), camera)
    outer = np.abs(np.arange(128) + 0.5 - camera.cx) / camera.fx > 1 / math.sqrt(3 * 0.4) + 0.02
    assert outer.any() and not shown[:, outer].any() and shown[:, 64].any()


def test_resized_pictures_show_the_same() -> None:
    camera = placed(fx=150.0, fy=130.0, cx=70.0)
    half = camera.resized(64)
    np.testing.assert_allclose(2 * half.project(points()), camera.project(points()))
    assert (half.width, half.height) == (64, 48)
    with pytest.raises(ShadowmapError, match="give whole pixels"):
        camera.resized(0)


def test_points_behind_a_camera_are_nan() -> None:
    assert np.isnan(placed().project([[10.0, 20, 50]])).all()


# ------------------------------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_reconstructions_of_colmap(kind: str) -> None:
    """Nine camera models, with and without points; places by COLMAP itself (`make_colmap.py`)."""
    stored = json.loads((COLMAP / "places.json").read_text())
    found = cameras.from_colmap(COLMAP / kind)
    assert list(found) == sorted(stored["places"]) and len(found) == 9
    for name, camera in found.items():
        np.testing.assert_allclose(camera.project(stored["points"]), stored["places"][name], atol=1e-9)
        assert camera.name == name and (camera.width, camera.height) == (640, 480)


def test_folders_of_colmap(tmp_path: Path) -> None:
    shutil.copytree(COLMAP / "text", tmp_path / "project" / "sparse" / "0")
    assert len(cameras.from_colmap(tmp_path / "project")) == 9
    with pytest.raises(ShadowmapError, match="has no cameras.bin and images.bin"):
        cameras.from_colmap(tmp_path)


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_damaged_files_of_colmap(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "sparse"
    shutil.copytree(COLMAP / kind, folder)
    for file in list(folder.iterdir()):
        whole = file.read_bytes()
        for end in range(0, len(whole), 97):
            file.write_bytes(whole[:end])
            try:
                cameras.from_colmap(folder)  # text may end after a whole line
            except ShadowmapError as error:
                assert str(folder) in str(error) and "\n" not in str(error)
        file.write_bytes(whole)


def test_lenses_that_opencv_does_not_have(tmp_path: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 FOV 640 480 600 600 320 240 0.1\n")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    with pytest.raises(ShadowmapError, match="model FOV, which is not supported: undistort"):
        cameras.from_colmap(tmp_path)
    (tmp_path / "cameras.txt").write_text("1 MAGIC 640 480 600\n")
    with pytest.raises(ShadowmapError, match="'MAGIC' is not known"):
        cameras.from_colmap(tmp_path)


def nerf_file(folder: Path, **values: Any) -> Path:
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
    path = folder / "transforms.json"
    path.write_text(json.dumps({"frames": [{"file_path": "r_0", "transform_matrix": matrix}], **values}))
    return path


def test_files_of_nerf(tmp_path: Path) -> None:
    """A camera at (0, 0, 4) that looks along -z, with x to the right and y up."""
    (camera,) = cameras.from_nerf(nerf_file(tmp_path, camera_angle_x=math.radians(90)), width=100, height=80).values()
    expected = [[50, 40], [75, 40], [50, 15]]
    np.testing.assert_allclose(camera.project([[0, 0, 0], [2, 0, 0], [0, 2, 0]]), expected, atol=1e-9)
    path = nerf_file(tmp_path, fl_x=60.0, fl_y=50, cx=52, cy=38.5, w=100, h=80, k1=-0.1, p1=1e-3)
    (camera,) = cameras.from_nerf(path).values()
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (100, 80, 60, 50, 52, 38.5)
    assert camera.distortion == (-0.1, 0, 1e-3, 0, 0, 0, 0, 0) and not camera.fisheye
    (half,) = cameras.from_nerf(path, width=50, height=40).values()
    np.testing.assert_allclose(2 * half.project(points()), camera.project(points()))
    fisheye = nerf_file(tmp_path, camera_model="OPENCV_FISHEYE", fl_x=60, w=100, h=80, k1=0.1, k4=0.01)
    (camera,) = cameras.from_nerf(fisheye).values()
    assert camera.fisheye and camera.distortion == (0.1, 0, 0, 0.01) and camera.fy == 60
    mi_size = nerf_file(tmp_path, camera_angle_x=1.0)
    from PIL import Image

    Image.new("RGB", (30, 20)).save(tmp_path / "r_0.png")
    assert next(iter(cameras.from_nerf(mi_size).values())).width == 30


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"frames": []}, "no list 'frames'"),
        ({"w": 10, "h": 10}, "no focal length"),
        ({"fl_x": 10}, "the size of its picture is unknown"),
        ({"fl_x": "ten", "w": 10, "h": 10}, "fl_x is 'ten'"),
        ({"fl_x": 10, "w": 10, "h": 10, "camera_model": "EQUIRECTANGULAR"}, "undistort the pictures first"),
        ({"fl_x": 10, "w": 10, "h": 10, "frames": [{"transform_matrix": [1]}]}, "has not 4 x 4 numbers"),
        ({"fl_x": -10, "w": 10, "h": 10}, "fl_x is -10: a positive number"),
        ({"fl_x": 10, "w": 0, "h": 10}, "w is 0: a positive number"),
    ],
)
def test_files_of_nerf_that_lack_something(tmp_path: Path, values: dict[str, Any], message: str) -> None:
    with pytest.raises(ShadowmapError, match=message):
        cameras.from_nerf(nerf_file(tmp_path, **values))
    (tmp_path / "broken.json").write_text("{")
    for name, wrong in (("broken.json", "is no JSON file"), ("none.json", "cannot be read: No such file")):
        with pytest.raises(ShadowmapError, match=wrong):
            cameras.from_nerf(tmp_path / name)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"width": 0}, "whole pixels"),
        ({"width": 10.5}, "whole pixels"),
        ({"fx": 0.0}, "fx = 0: give a positive number"),
        ({"cx": math.nan}, "finite"),
        ({"rotation": 2 * np.eye(3)}, "is no rotation"),
        ({"rotation": np.diag([1.0, 1, -1])}, "mirrors"),
        ({"rotation": np.eye(4)}, r"shape \(4, 4\): give 3 x 3"),
        ({"translation": "far"}, "no array of numbers"),
        ({"distortion": (0.1,)}, "1 coefficients of distortion: give one of 0, 4, 5, 8, 12"),
        ({"distortion": (0.1,) * 5, "fisheye": True}, "give one of 0, 4 of them"),
    ],
)
def test_numbers_that_no_camera_has(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ShadowmapError, match=message):
        placed(**changes)


def test_cameras_that_mitsuba_does_not_have(variant: str) -> None:
    with pytest.raises(ShadowmapError, match=r"is distorted, which no sensor of Mitsuba's is: take camera.undistorted\(\)"):
        placed(distortion=(0.1, 0, 0, 0)).sensor()
    with pytest.raises(ShadowmapError, match="is distorted"):
        placed(fisheye=True).record()
    with pytest.raises(ShadowmapError, match="has fx = 100 and fy = 110"):
        placed(fx=100.0, fy=110.0).sensor()
    with pytest.raises(ShadowmapError, match="K has skew"):
        cameras.from_opencv([[100, 1, 50], [0, 100, 50], [0, 0, 1]], np.eye(3), np.zeros(3), 100, 100)
    with pytest.raises(ShadowmapError, match="coincide, or up is parallel"):
        cameras.look_at((0, 0, 1), (0, 0, 0), (0, 0, 1), fov=40, width=10, height=10)
    with pytest.raises(ShadowmapError, match="fov is 180"):
        cameras.look_at((0, 0, 1), (0, 0, 0), fov=180, width=10, height=10)
