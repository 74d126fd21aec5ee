"""Targets from pictures: colours and weights against Mitsuba's decoder, OpenCV and brute force."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.fitting import targets
from shadowmap_dr.fitting.targets import Target, is_same_shape, make_target, read_target, short_names
from shadowmap_dr.io.images import to_srgb, write_exr, write_png
from shadowmap_dr.jit.threads import second_thread


def noise(*shape: int, seed: int = 0, most: float = 0.95) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0, most, shape).astype(np.float32)


def by_mitsuba(path: Path) -> np.ndarray:
    """Linear colours of a file."""
    return np.array(mi.Bitmap(str(path)).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False))


def by_brute_force(image: np.ndarray, weight: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Weighted averages over the areas of pixels, which are looked at one by one."""
    rows, columns = weight.shape
    colours, weights = np.zeros((height, width, 3)), np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            total = 0.0
            for i in range(rows):
                for j in range(columns):
                    tall = min((y + 1) * rows / height, i + 1) - max(y * rows / height, i)
                    wide = min((x + 1) * columns / width, j + 1) - max(x * columns / width, j)
                    if tall > 0 and wide > 0:
                        share = tall * wide * weight[i, j]
                        total += share
                        colours[y, x] += share * image[i, j]
            weights[y, x] = total / (rows / height * columns / width)
            colours[y, x] = colours[y, x] / total if total > 0 else 0
    return colours, weights


def save(path: Path, values: np.ndarray) -> Path:
    """Write sRGB values in 0..1 with 8 bits, with 16 if the name says so."""
    if "16" in path.stem:
        deep = np.rint(values * 65535).astype(np.uint16)
        order = {3: [2, 1, 0], 4: [2, 1, 0, 3]}.get(values.shape[-1] if values.ndim == 3 else 1, [0])
        assert cv2.imwrite(str(path), deep[..., order] if values.ndim == 3 else deep)
    else:
        Image.fromarray(np.rint(values * 255).astype(np.uint8)).save(path)
    return path


@pytest.mark.parametrize(
    "name", ["8.png", "16.png", "8.jpg", "8.tif", "16.tif", "8.webp", "16 ü.png", "grey8.png", "grey16.png", "grey16.tif"]
)
def test_colours_are_linear(tmp_path: Path, variant: str, name: str) -> None:
    values = noise(9, 12) if "grey" in name else noise(9, 12, 3)
    path = save(tmp_path / name, values)
    target = read_target(path, sensor=3)
    if path.suffix in (".png", ".jpg"):
        shown = by_mitsuba(path)
    else:
        with_opencv = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        encoded = (cv2.cvtColor(with_opencv, cv2.COLOR_BGR2RGB) if values.ndim == 3 else with_opencv[..., None]) / float(
            np.iinfo(with_opencv.dtype).max
        )
        shown = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4) * np.ones(3)
    # Mitsuba's and our decoders of JPEG may differ in the last bit.
    counts = target.weight == 1
    assert counts.mean() > 0.95
    np.testing.assert_allclose(target.image[counts], shown[counts], atol=0.012 if path.suffix == ".jpg" else 3e-6)
    assert target.image.dtype == target.weight.dtype == np.float32
    assert (target.sensor, target.name, target.width, target.height) == (3, str(path), 12, 9)


@pytest.mark.parametrize("name", ["16.png", "16.tif", "grey16.png"])
def test_sixteen_bits_show_what_eight_do_not(tmp_path: Path, name: str) -> None:
    values = np.tile(np.linspace(0.5, 0.503, 64), (2, 1))
    image = read_target(save(tmp_path / name, values if "grey" in name else np.repeat(values[..., None], 3, 2))).image
    assert len(np.unique(image)) == 64


def test_exr_files_are_as_they_are(tmp_path: Path) -> None:
    values = noise(6, 8, 3, most=300)
    write_exr(tmp_path / "a.exr", dict(zip("RGB", np.moveaxis(values, -1, 0), strict=True)))
    target = read_target(tmp_path / "a.exr")
    np.testing.assert_array_equal(target.image, values)
    assert (target.weight == 1).all()
    np.testing.assert_array_equal(read_target(tmp_path / "a.exr", saturation=200).weight == 0, (values >= 200).any(-1))
    write_exr(tmp_path / "y.exr", {"Y": values[..., 0].astype(np.float16), "depth.Z": values[..., 1]})
    np.testing.assert_array_equal(read_target(tmp_path / "y.exr").image, values[..., :1].astype(np.float16) * np.ones(3))


def test_files_of_mitsubas_renderings(tmp_path: Path, variant: str) -> None:
    """Transparent ones, too: colours are premultiplied there."""
    scene = mi.cornell_box()
    scene["sensor"]["film"] |= {"width": 16, "height": 12, "pixel_format": "rgba", "rfilter": {"type": "box"}}
    del scene["back"]
    image = mi.render(mi.load_dict(scene), spp=4)
    with second_thread():
        mi.Bitmap(image).write(str(tmp_path / "a.exr"))
    target, same = read_target(tmp_path / "a.exr"), make_target(image)
    values = image.numpy()
    np.testing.assert_array_equal(target.image, same.image)
    np.testing.assert_allclose(target.weight, values[..., 3], rtol=1e-3)
    np.testing.assert_allclose(
        target.image * target.weight[..., None], values[..., :3] * (values[..., 3:] > 0), rtol=2e-3, atol=1e-4
    )


@pytest.mark.parametrize("name", ["8.png", "16.png", "8.webp", "16.tif"])
def test_transparent_pixels_do_not_count(tmp_path: Path, name: str) -> None:
    values = noise(8, 12, 4)
    values[:4, :6, 3], values[4:, 6:, 3] = 0, 1
    if name == "8.webp":
        Image.fromarray(np.rint(values * 255).astype(np.uint8)).save(tmp_path / name, lossless=True, exact=True)
    else:
        save(tmp_path / name, values)
    target = read_target(tmp_path / name)
    levels = 65535 if "16" in name else 255
    np.testing.assert_allclose(target.weight, np.rint(values[..., 3] * levels) / levels, atol=1e-6)
    # Straight alpha: colours are those of the file.
    seen = target.weight > 0
    straight = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)[..., :3]
    np.testing.assert_allclose(target.image[seen], straight[seen], atol=0.005 if levels == 255 else 2e-5)
    assert not target.image[~seen].any()
    small = target.resized(3, 2)
    expected = by_brute_force(target.image, target.weight, 2, 3)
    np.testing.assert_allclose(small.image, expected[0], rtol=1e-5)
    np.testing.assert_allclose(small.weight, expected[1], rtol=1e-5)


def test_premultiplied_colours(tmp_path: Path) -> None:
    colours, alpha = noise(4, 6, 3, most=5), noise(4, 6, 1, seed=1)
    alpha[0, 0] = 0
    premultiplied = np.concatenate([colours * alpha, alpha], -1)
    premultiplied[0, 0, :3] = 7  # glows, but does not count
    write_exr(tmp_path / "a.exr", dict(zip("RGBA", np.moveaxis(premultiplied, -1, 0), strict=True)))
    for target in (read_target(tmp_path / "a.exr"), make_target(premultiplied)):
        np.testing.assert_allclose(target.image[1:], colours[1:], rtol=1e-5)
        np.testing.assert_allclose(target.weight, alpha[..., 0], rtol=1e-6)
        assert not target.image[0, 0].any()


def test_pictures_with_alpha_have_an_opaque_self() -> None:
    colours, alpha = noise(4, 6, 3, most=5), noise(4, 6, 1, seed=1)
    alpha[0, 0], mask = 0, np.ones((4, 6))
    mask[3, 3:] = 0
    target = make_target(np.concatenate([colours, alpha], -1), mask, sensor=2, exposure=1.5)
    seen = target.opaque
    assert seen is not None and (seen.sensor, seen.exposure, seen.opaque) == (2, 1.5, None)
    np.testing.assert_array_equal(seen.weight, mask)
    np.testing.assert_allclose(seen.image, colours * mask[..., None], rtol=1e-6)
    assert make_target(colours, mask).opaque is None
    small, expected = target.resized(3, 2).opaque, by_brute_force(seen.image, seen.weight, 2, 3)
    assert small is not None
    np.testing.assert_allclose(small.image, expected[0], rtol=1e-5)
    np.testing.assert_allclose(small.weight, expected[1], rtol=1e-5)


@pytest.mark.parametrize(("name", "levels"), [("8.png", 255), ("16.png", 65535), ("8.tif", 255), ("16.tif", 65535)])
def test_saturated_pixels_do_not_count(tmp_path: Path, name: str, levels: int) -> None:
    values = np.full((4, 6, 3), 0.5)
    values[0, 0, 1], values[1, 1, 0], values[2, 2, 2], values[3, 3] = 1, 254 / 255, 253 / 255, 1
    path = save(tmp_path / name, values)
    expected = np.ones((4, 6))
    expected[[0, 1, 3], [0, 1, 3]] = 0
    target = read_target(path)
    np.testing.assert_array_equal(target.weight, expected)
    assert not target.image[expected == 0].any()
    assert (read_target(path, saturation=np.inf).weight == 1).all()
    np.testing.assert_array_equal(read_target(path, saturation=0.99).weight[[0, 1, 2, 3], [0, 1, 2, 3]], 0)


def test_pixels_that_are_not_finite_do_not_count(tmp_path: Path) -> None:
    values = noise(4, 6, 3)
    values[0, 0, 0], values[1, 1, 1], values[2, 2, 2], values[3, 3, 0] = np.nan, np.inf, -np.inf, -0.5
    write_exr(tmp_path / "a.exr", dict(zip("RGB", np.moveaxis(values, -1, 0), strict=True)))
    for target in (read_target(tmp_path / "a.exr"), make_target(values), make_target(values.astype(np.float64))):
        assert np.isfinite(target.image).all() and target.image.min() >= 0
        assert target.image[3, 3, 0] == 0 and target.weight[3, 3] == 1
        np.testing.assert_array_equal(np.argwhere(target.weight == 0), [[0, 0], [1, 1], [2, 2]])
        assert np.isfinite(target.resized(2, 2).image).all() if target.width == target.height else True
    assert (make_target(np.full((2, 2, 3), 1e300)[..., :3] * np.eye(2)[..., None] + 0.5).weight == 1 - np.eye(2)).all()
    huge = make_target(np.full((4, 4, 3), 3e38, np.float32)).resized(2, 2)
    assert np.isfinite(huge.image).all() and huge.image.min() > 2.9e38


@pytest.mark.parametrize(
    ("size", "to"),
    [((12, 18), (4, 6)), ((12, 18), (5, 7)), ((30, 40), (7, 9)), ((9, 12), (2, 3)), ((5, 5), (4, 4)), ((7, 5), (1, 1))],
)
def test_resized_against_brute_force(size: tuple[int, int], to: tuple[int, int]) -> None:
    image, weight = noise(*size, 3, most=4), noise(*size, seed=5)
    weight[: size[0] // 2, : size[1] // 2] = 0
    image[weight == 0] = 0
    small = Target(image, weight, 2, "a.png").resized(to[1], to[0])
    colours, weights = by_brute_force(image, weight, *to)
    np.testing.assert_allclose(small.image, colours, rtol=2e-5)
    np.testing.assert_allclose(small.weight, weights, rtol=2e-5)
    assert (small.sensor, small.name) == (2, "a.png")
    assert (small.image[small.weight == 0] == 0).all()


def test_colours_of_masked_pixels_do_not_bleed() -> None:
    image = np.full((40, 40, 3), 0.25, np.float32)
    image[13:, 17:] = 100
    target = make_target(image, image[..., 0] < 1)
    for side in (39, 17, 8, 3):
        small = target.resized(side, side)
        np.testing.assert_allclose(small.image[small.weight > 0], 0.25, rtol=1e-5)
        assert small.weight.mean() == pytest.approx(target.weight.mean(), rel=1e-4)


def test_to_the_same_size_is_the_same() -> None:
    target = make_target(noise(4, 6, 3))
    assert target.resized(6, 4) is target


@pytest.mark.parametrize(
    ("width", "height", "words"),
    [
        (80, 60, "a.png has 40 x 30 pixels, fewer than 80 x 60: give a larger picture, or fit at a lower resolution"),
        (30, 30, "a.png has 40 x 30 pixels, but 30 x 30 are wanted, of another aspect ratio.*film 30 x 22 pixels"),
        (0, 3, "0 x 3 pixels are no size"),
    ],
)
def test_sizes_that_do_not_fit(width: int, height: int, words: str) -> None:
    with pytest.raises(ShadowmapError, match=words):
        make_target(noise(30, 40, 3), name="a.png").resized(width, height)


def test_shapes_of_rounded_sizes_are_the_same() -> None:
    for long in range(1, 200):
        assert is_same_shape((3024, 4032), (round(long * 3 / 4) or 1, long)), long
        assert is_same_shape((max(1, int(long * 3 / 4)), long), (3024, 4032)), long
    assert not is_same_shape((100, 100), (99, 90)) and not is_same_shape((3024, 4032), (4032, 3024))
    assert not is_same_shape((1080, 1920), (480, 640))


# --------------------------------------------------------------------------------------------------------------------- masks


def masks(folder: Path, mask: np.ndarray) -> dict[str, Any]:
    """A mask of bool in all forms in which it may be given."""
    grey = np.where(mask, 255, 0).astype(np.uint8)
    Image.fromarray(grey).save(folder / "grey.png")
    Image.fromarray(mask).save(folder / "bits.png")
    Image.fromarray(np.repeat(grey[..., None], 3, 2)).save(folder / "colour mask.png")
    Image.fromarray(np.stack([np.full_like(grey, 255)] * 3 + [grey], -1)).save(folder / "cut out.png")
    cv2.imwrite(str(folder / "deep.png"), grey.astype(np.uint16) * 257)
    write_exr(folder / "mask.exr", {"Y": mask.astype(np.float32)})
    names = ["grey.png", "bits.png", "colour mask.png", "cut out.png", "deep.png", "mask.exr"]
    arrays = {"bool": mask, "uint8": grey, "int": mask.astype(int), "float": mask.astype(float), "rows": mask[..., None]}
    return {name: folder / name for name in names} | arrays | {"string": str(folder / "grey.png"), "mi": mi.TensorXf(mask * 1.0)}


def test_masks_in_all_forms(tmp_path: Path, variant: str) -> None:
    mask = np.zeros((8, 12), bool)
    mask[2:6, 3:9] = True
    path = save(tmp_path / "8.png", noise(8, 12, 3))
    for name, form in masks(tmp_path, mask).items():
        target = read_target(path, form)
        np.testing.assert_array_equal(target.weight, mask, err_msg=name)
        assert not target.image[~mask].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channels", ["R", "RGB", "A"])
def test_mask_pixels_that_are_not_finite_do_not_count(tmp_path: Path, value: float, channels: str) -> None:
    """As those of pictures. Large numbers are white."""
    path, mask = save(tmp_path / "8.png", noise(8, 12, 3)), {name: np.ones((8, 12), np.float32) for name in "RGBA"}
    for name in channels:
        mask[name][2, 3] = value
    for name in "RGB":
        mask[name][4, 5] = 3e38
    write_exr(tmp_path / "mask.exr", mask)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        weight = read_target(path, tmp_path / "mask.exr").weight
    expected = np.ones((8, 12))
    expected[2, 3] = 0
    np.testing.assert_array_equal(weight, expected)


@pytest.mark.parametrize("times", [2, 5, 0.5])
def test_masks_of_other_sizes(tmp_path: Path, times: float) -> None:
    mask = np.zeros((round(8 * times), round(12 * times)), bool)
    mask[: round(4 * times), : round(6 * times)] = True
    target = make_target(noise(8, 12, 3), mask)
    expected = np.zeros((8, 12))
    expected[:4, :6] = 1
    np.testing.assert_allclose(target.weight, expected, atol=1e-6)


def test_soft_masks_and_alpha_multiply(tmp_path: Path) -> None:
    image = np.concatenate([noise(4, 4, 3), np.full((4, 4, 1), 0.5, np.float32)], -1)
    np.testing.assert_allclose(make_target(image, np.full((4, 4), 0.25)).weight, 0.125)


def test_masks_of_turned_photographs(tmp_path: Path) -> None:
    """Cameras turn pictures by a note in the file; masks are painted on what is shown."""
    exif = Image.Exif()
    exif[0x0112] = 6
    values = np.rint(noise(8, 12, 3) * 255).astype(np.uint8)
    Image.fromarray(values).save(tmp_path / "a.png", exif=exif)
    mask = np.zeros((12, 8), bool)
    mask[:3] = True
    target = read_target(tmp_path / "a.png", mask)
    np.testing.assert_allclose(to_srgb(target.image[:3]) * 255, np.rot90(values, -1)[:3], atol=1e-3)
    assert not target.weight[3:].any()


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        (np.ones((8, 8), bool), "the mask of .*8.png has 8 x 8 pixels, but .*8.png has 12 x 8, another aspect ratio"),
        (np.zeros((8, 12), bool), "the mask of .*8.png is black everywhere: paint white over the pixels that count"),
        (np.ones((8, 12, 3)), r"the mask of .*8.png has the shape \(8, 12, 3\)"),
        (np.full((8, 12), 2.0), "numbers from 2 to 2: give numbers in 0..1"),
        (np.full((8, 12), np.nan), "give numbers in 0..1"),
        (np.full((8, 12), "x"), "is an array of <U1"),
        (np.zeros((0, 12), bool), "not empty"),
        ("none.png", "no image 'none.png': the file does not exist"),
    ],
)
def test_masks_that_do_not_fit(tmp_path: Path, mask: Any, words: str) -> None:
    path = save(tmp_path / "8.png", noise(8, 12, 3))
    with pytest.raises(ShadowmapError, match=words) as caught:
        read_target(path, mask)
    assert "\n" not in str(caught.value)


# ----------------------------------------------------------------------------------------------------------- arrays, bad input


def test_arrays_of_all_kinds(variant: str) -> None:
    values = noise(4, 6, 3, most=3)
    grey = make_target(values[..., 0])
    np.testing.assert_array_equal(grey.image, values[..., :1] * np.ones(3, np.float32))
    np.testing.assert_array_equal(make_target(values[..., :1]).image, grey.image)
    attached = mi.TensorXf(values)
    import drjit as dr

    dr.enable_grad(attached)
    for form in (values, values.tolist(), values.astype(np.float64), mi.TensorXf(values), attached, mi.Bitmap(values)):
        np.testing.assert_array_equal(make_target(form).image, values)
    np.testing.assert_array_equal(make_target(values.astype(np.float16)).image, values.astype(np.float16))
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(make_target(torch.tensor(values, requires_grad=True)).image, values)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((4, 4, 3), np.uint8), "an array of uint8: give linear floats"),
        (np.zeros((4, 4, 2)), r"the shape \(4, 4, 2\): give an array"),
        (np.zeros((0, 4, 3)), "not empty"),
        (np.zeros(4), r"the shape \(4,\)"),
        (np.full((4, 4, 3), np.nan), "no pixel counts; 100 % of them are not finite"),
        (np.zeros((4, 4, 4)), "no pixel counts; 100 % of them are transparent"),
        ([[1.0], [1.0, 2.0]], "NumPy makes no array"),
        ("a.png", "give linear floats"),
    ],
)
def test_bad_arrays(image: Any, words: str) -> None:
    with pytest.raises(ShadowmapError, match=words):
        make_target(image, name="my picture")


@pytest.mark.parametrize("option", [{"saturation": 0.0}, {"saturation": np.nan}, {"longer_side": 0}])
def test_bad_options(option: dict[str, Any]) -> None:
    with pytest.raises(ShadowmapError, match=f"{next(iter(option))}: .*, but must be"):
        make_target(noise(4, 4, 3), **option)


def test_bad_files(tmp_path: Path) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.jpg").write_text("no picture")
    path = save(tmp_path / "16.png", noise(30, 40, 3))
    (tmp_path / "cut.png").write_bytes(path.read_bytes()[:3000])
    (tmp_path / "cut.exr").write_bytes(b"v/1\x01" + bytes(100))
    write_exr(tmp_path / "depth.exr", {"depth.Z": noise(3, 3)})
    write_png(tmp_path / "white.png", np.ones((4, 4, 3)))
    for name, words in (
        ("none.png", "the file does not exist"),
        ("empty.png", "it is no image, or it is damaged"),
        ("text.jpg", "it is no image, or it is damaged"),
        ("cut.png", "it is no image, or it is damaged"),
        ("cut.exr", "it is no OpenEXR file, or it is damaged"),
        ("depth.exr", "it has no colour channels, only depth.Z"),
        ("white.png", "no pixel counts; 100 % of them are saturated. Give another picture or mask"),
        (".", "it is a folder; give a file"),
    ):
        with pytest.raises(ShadowmapError, match=words) as caught:
            read_target(tmp_path / name)
        assert name in str(caught.value) and "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------------------------- large pictures


@pytest.mark.parametrize("name", ["8.png", "16.png"])
def test_large_pictures_are_reduced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    values = noise(30, 44, 4, most=1)
    path = save(tmp_path / name, values)
    mask = noise(30, 44, seed=3) > 0.4
    whole = read_target(path, mask)
    monkeypatch.setattr(targets, "LONGER_SIDE", 1)  # is a default value, bound before
    small = read_target(path, mask, longer_side=16)
    assert (small.width, small.height) == (16, 11)
    expected = by_brute_force(whole.image, whole.weight, 11, 16)
    np.testing.assert_allclose(small.image, expected[0], rtol=2e-5)
    np.testing.assert_allclose(small.weight, expected[1], rtol=2e-5)


def test_large_pictures_need_little_more_memory_than_their_pixels(tmp_path: Path) -> None:
    Image.new("RGB", (6000, 4000), (90, 120, 150)).save(tmp_path / "large.png", compress_level=1)
    code = (
        "import resource, sys; from shadowmap_dr.fitting.targets import read_target\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "target = read_target(sys.argv[1])\n"
        "assert target.image.shape == (1365, 2048, 3), target.image.shape\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024)"
    )
    run = subprocess.run([sys.executable, "-c", code, str(tmp_path / "large.png")], capture_output=True, text=True, check=True)
    pixels = 6000 * 4000 * 4
    assert int(run.stdout) < 5 * pixels, f"{int(run.stdout) / pixels:.2f} times the pixels"


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (["a/photo.png"], ["photo.png"]),
        (["a/left.png", "a/right.png"], ["left.png", "right.png"]),
        (["one/photo.png", "two/photo.png"], ["one/photo.png", "two/photo.png"]),
        (["x/one/photo.png", "y/one/photo.png", "y/other.png"], ["x/one/photo.png", "y/one/photo.png", "other.png"]),
        (["a/photo.png", "a/photo.png"], ["photo.png (sensor 0)", "photo.png (sensor 1)"]),
        ([""], [""]),
    ],
)
def test_short_names_tell_pictures_apart(given: list[str], expected: list[str]) -> None:
    image = np.ones((2, 2, 3), np.float32)
    targets = [replace(make_target(image), name=name, sensor=number) for number, name in enumerate(given)]
    assert short_names(targets) == expected
