"""Fitted scenes as files: textures, and colours that become textures."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scene_files import picture, read, scene, write

from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.scene_file import write_fitted_scene

FILE = '<string name="filename" value="t.png"/>'
TEXTURED = (
    '<shape type="rectangle" id="a"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
    f"{FILE}{{}}</texture></bsdf></shape>"
)


@pytest.mark.parametrize(
    ("body", "key"),
    [
        (TEXTURED.format(""), "a.bsdf.reflectance.data"),
        (TEXTURED.format('<boolean name="raw" value="true"/>'), "a.bsdf.reflectance.data"),
        (TEXTURED.format('<string name="format" value="fp16"/><string name="wrap_mode" value="clamp"/>'), None),
        ('<texture type="bitmap" id="tex"><string name="filename" value="t.png"/></texture><shape type="rectangle" id="a">'
         '<bsdf type="twosided"><bsdf type="diffuse"><ref id="tex" name="reflectance"/></bsdf></bsdf></shape>', None),
        ('<shape type="rectangle" id="a"><bsdf type="bumpmap"><texture type="bitmap"><string name="filename" value="t.png"/>'
         '<boolean name="raw" value="true"/></texture><bsdf type="diffuse"/></bsdf></shape>', "a.bsdf.nested_texture.data"),
        ('<emitter type="envmap" id="a"><string name="filename" value="t.png"/></emitter>', "a.data"),
        (f'<emitter type="projector" id="a"><texture type="bitmap" name="irradiance">{FILE}</texture></emitter>', None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("most", [1.0, 7.0])
def test_textures(tmp_path: Path, variant: str, body: str, key: str | None, most: float) -> None:
    picture(tmp_path / "t.png")
    file = scene(tmp_path, body)
    table = mi.traverse(mi.load_file(str(file), optimize=False))
    key = key or next(name for name in table.keys() if name.endswith(".data"))
    old = np.array(table[key])
    new = np.random.default_rng(1).uniform(0, most, old.shape).astype(np.float32)
    if key == "a.data":  # Mitsuba repeats the columns at the ends
        new[:, 0], new[:, -1] = new[:, -2], new[:, 1]
    written = write_fitted_scene(file, {}, Changes(values={key: new}), tmp_path / "out", names=list(table.keys()))
    if most > 1 and key != "a.data" and not written.notes:
        assert written.files[1].suffix == ".exr"
    assert not written.notes, written.notes
    again = read(written)
    key = next(name for name in again.keys() if name.endswith(".data"))
    np.testing.assert_allclose(np.array(again[key]), new, atol=1e-4 * most)
    assert len(written.files) == 2 and "t.png" not in written.files[0].read_text()


@pytest.mark.parametrize("key", ["a.bsdf.reflectance.value", "a.bsdf.reflectance.data"])
@pytest.mark.parametrize(
    "material",
    ["", '<bsdf type="diffuse"/>', '<bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf>'],
)
@pytest.mark.parametrize("size", [(5, 7, 3), (2, 2, 3)])
def test_colours_become_textures(tmp_path: Path, variant: str, key: str, material: str, size: tuple[int, ...]) -> None:
    body = f'<shape type="rectangle" id="a">{material}</shape>'
    new = np.random.default_rng(1).uniform(0, 1, size).astype(np.float32)
    written = write(scene(tmp_path, body), tmp_path, values={key: new})
    assert not written.notes
    np.testing.assert_allclose(np.array(read(written)["a.bsdf.reflectance.data"]), new, atol=1e-4)
    assert np.asarray(Image.open(written.files[1])).shape == size, "others read it, too"
