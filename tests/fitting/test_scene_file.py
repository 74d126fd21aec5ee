"""Fitted scenes as files: Mitsuba reads what was changed, and nothing else is another."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image

from shadowmap_dr.errors import OutputError, ShadowmapError
from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.scene_file import Written, write_fitted_scene
from shadowmap_dr.importing import ImportOptions, import_model

SCENES = Path(__file__).resolve().parents[2] / "scenes"
FILM = '<film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="8"/></film>'


def scene(folder: Path, body: str, name: str = "source.xml", version: str = "3.0.0") -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<scene version="{version}">\n    <!-- kept -->\n    {body}\n</scene>\n', encoding="utf-8")
    return path


def write(file: Path, folder: Path, given: Mapping[str, str] | None = None, **changes: Any) -> Written:
    return write_fitted_scene(file, given or {}, Changes(**changes), folder / "out")


def is_transform(value: Any) -> bool:
    return "Transform" in type(value).__name__


def numbers(value: Any) -> np.ndarray:
    found = np.array(value.matrix if is_transform(value) else value, np.float64)
    return found.reshape(found.shape[:2]) if is_transform(value) else found


def read(written: Written) -> mi.SceneParameters:
    return mi.traverse(mi.load_file(str(written.files[0]), optimize=False))


def turned(seed: int = 0) -> np.ndarray:
    """A rotation, a scale, and a translation."""
    rng = np.random.default_rng(seed)
    matrix = np.eye(4)
    matrix[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0] * 1.3
    matrix[:3, :3] *= np.sign(np.linalg.det(matrix[:3, :3]))
    matrix[:3, 3] = rng.normal(size=3)
    return matrix


# ------------------------------------------------------------------------------------------------------------ all parameters


def perturbed(table: mi.SceneParameters, key: str) -> np.ndarray | None:
    """Another value of a parameter that a fit may change; None of others."""
    last = key.rpartition(".")[2]
    if table.flags(key) & (mi.ParamFlags.NonDifferentiable | mi.ParamFlags.ReadOnly) or last.startswith(("vertex_", "face_")):
        return None
    if last == "to_world":
        rotation = turned()
        rotation[:3, :3] /= 1.3
        return rotation @ numbers(table[key])
    value = numbers(table[key])
    return None if last == "to_uv" or value.dtype.kind != "f" else value * 0.9 + 0.01


def check_all(file: Path, folder: Path, given: Mapping[str, str] | None = None) -> Written:
    """Change every parameter that may be, and compare all with what Mitsuba reads from the written file."""
    table = mi.traverse(mi.load_file(str(file), optimize=False, **(given or {})))
    values = {key: value for key in table.keys() if (value := perturbed(table, key)) is not None}
    written = write_fitted_scene(file, given or {}, Changes(values=values), folder / "out", names=list(table.keys()))
    again = read(written)
    assert len(again) == len(table)
    for old, new in zip(table.keys(), again.keys(), strict=True):
        if any(old.replace("object", "") in note for note in written.notes):
            continue
        expected, found = values.get(old), again[new]
        if expected is None:
            if is_transform(table[old]) or np.array(table[old]).dtype.kind in "fiu":
                np.testing.assert_allclose(numbers(found), numbers(table[old]), rtol=1e-4, atol=1e-5, err_msg=old)
        elif old.endswith("to_world") and "<vector" in file.read_text(encoding="utf-8") and old.startswith(("sun", "sky")):
            forward = expected[:3, 2] / np.linalg.norm(expected[:3, 2])
            np.testing.assert_allclose(numbers(found)[:3, 2], forward, atol=1e-5, err_msg=old)
        elif old.endswith("sun_direction"):
            np.testing.assert_allclose(numbers(found).ravel(), expected.ravel() / np.linalg.norm(expected), atol=1e-5)
        else:
            found, expected = np.broadcast_arrays(numbers(found).ravel(), expected.ravel())
            np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4, err_msg=old)
    return written


@pytest.mark.parametrize("name", ["gallery", "meadow", "pavilion", "pose", "still_life"])
def test_all_parameters_of_our_scenes(tmp_path: Path, variant: str, name: str) -> None:
    written = check_all(SCENES / f"{name}.xml", tmp_path)
    # Mitsuba takes pictures only for the one, and no transparent materials in `twosided` for the other.
    assert all(re.match(r"(spot|lamp)\.texture\.value |.*spec_trans\.value ", note) for note in written.notes), written.notes
    source, result = ((path).read_text(encoding="utf-8") for path in (SCENES / f"{name}.xml", written.files[0]))
    assert re.findall("<!--.*?-->", source, re.DOTALL) == re.findall("<!--.*?-->", result, re.DOTALL)
    assert re.findall(r'id="\w+"', source) == re.findall(r'id="\w+"', result)
    assert re.findall(r"\$\w+", source) == re.findall(r"\$\w+", result)


BODIES = {
    "medium": """<medium type="homogeneous" id="m"><rgb name="albedo" value="0.9, 0.8, 0.7"/>
    <float name="sigma_t" value="2"/></medium>
    <shape type="cube" id="a"><ref name="interior" id="m"/></shape>""",
    "sky": """<emitter type="sunsky" id="a"><float name="turbidity" value="4"/><rgb name="albedo" value="0.3"/>
    <vector name="sun_direction" x="0.2" y="0.5" z="1"/></emitter>""",
    "batch": f"""<sensor type="batch" id="a"><sensor type="perspective"><float name="fov" value="30"/>{FILM}</sensor>
    <sensor type="perspective">{FILM}</sensor>{FILM}</sensor>""",
    "forms": """<shape type="cube" id="a"><bsdf type="diffuse"><rgb name="reflectance" value="0.5, 0.4, 0.3"/></bsdf></shape>
    <shape type="cube" id="b"><bsdf type="diffuse"><spectrum name="reflectance" value="0.5"/></bsdf></shape>
    <shape type="cube" id="c"><bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
    <shape type="cube" id="e"><bsdf type="diffuse"><spectrum name="reflectance" value="400:0.2, 700:0.6"/></bsdf></shape>
    <shape type="cube" id="f"><bsdf type="diffuse"><rgb value='0.5,0.4 0.3' name = 'reflectance'></rgb></bsdf></shape>
    <shape type="cube" id="g"><bsdf type="principled"><float name="roughness" value="0.4"/><float name="metallic" value="0.2"/>
    </bsdf></shape>""",
    "defaults": """<emitter type="directional" id="sun"/><emitter type="point" id="bulb"/><emitter type="constant" id="grey"/>
    <shape type="cube" id="a"><bsdf type="diffuse"/></shape><shape type="cube" id="b"/><shape type="sphere" id="c"/>
    <shape type="cube" id="d"><bsdf type="plastic"/></shape><shape type="cube" id="e"><bsdf type="roughplastic"></bsdf></shape>
    <shape type="disk" id="f"><emitter type="area"/></shape>""",
    "emitters": """<emitter type="spot" id="spot"><float name="cutoff_angle" value="30"/></emitter>
    <emitter type="point" id="a"><rgb name="intensity" value="3"/></emitter>
    <emitter type="point" id="b"><spectrum name="intensity" value="3"/><point name="position" x="1" y="0" z="2"/></emitter>
    <emitter type="point" id="c"><transform name="to_world"><translate x="1" y="2"/></transform></emitter>
    <emitter type="directional" id="d"><transform name="to_world"><lookat origin="0,3,0" target="0,0,0" up="1,0,0"/></transform>
    </emitter>
    <emitter type="directional" id="sun"><vector name="direction" value="1, -1, 0.5"/></emitter>
    <shape type="rectangle" id="lamp"><emitter type="area"><spectrum name="radiance" type="blackbody">
    <float name="temperature" value="4000"/></spectrum></emitter></shape>""",
    "shared": """<bsdf type="diffuse" id="mat"/><texture type="checkerboard" id="checks"/>
    <bsdf type="twosided" id="both"><bsdf type="diffuse"><ref name="reflectance" id="checks"/></bsdf><ref id="mat"/></bsdf>
    <shape type="cube" id="a"><ref id="mat"/></shape><shape type="cube" id="b"><ref id="mat"/></shape>
    <shape type="cube" id="c"><ref id="both"/></shape>""",
    "nested": """<shape type="cube" id="a"><bsdf type="twosided"><bsdf type="blendbsdf"><float name="weight" value="0.3"/>
    <bsdf type="diffuse"/><bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.1, 0.2, 0.3"/></bsdf></bsdf>
    </bsdf></shape>
    <shape type="cube" id="b"><bsdf type="mask"><float name="opacity" value="0.7"/><bsdf type="twosided"><bsdf type="diffuse"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.3, 0.2, 0.1"/></bsdf></bsdf></bsdf></shape>""",
    "metals": """<shape type="cube" id="a"><bsdf type="roughconductor"><string name="material" value="Au"/></bsdf></shape>
    <shape type="cube" id="b"><bsdf type="conductor"><rgb name="eta" value="0.2, 0.4, 1.4"/><rgb name="k" value="4, 2.4, 1.6"/>
    </bsdf></shape>""",
    "glass": """<shape type="cube" id="a"><bsdf type="dielectric"><string name="int_ior" value="bk7"/></bsdf></shape>
    <shape type="cube" id="b"><bsdf type="roughdielectric"><float name="int_ior" value="1.4"/><float name="ext_ior" value="1.1"/>
    </bsdf></shape><shape type="cube" id="c"><bsdf type="plastic"><string name="ext_ior" value="water"/></bsdf></shape>""",
    "places": """<shape type="sphere" id="a"><point name="center" x="1" y="2" z="3"/><float name="radius" value="2"/></shape>
    <shape type="cylinder" id="b"><point name="p0" value="1, 0, 0"/><point name="p1" value="1, 2, 0"/>
    <float name="radius" value="0.3"/></shape>
    <shape type="disk" id="c"><transform name="to_world"><scale value="2"/><translate x="1"/></transform></shape>
    <shape type="rectangle" id="d"/>""",
    "unnamed": """<emitter type="point"/><emitter type="point"><point name="position" value="2, 0, 0"/></emitter>
    <shape type="sphere"/><shape type="rectangle"/><shape type="disk"><bsdf type="diffuse"/></shape>""",
    "hostile ids": """<bsdf type="diffuse" id="böse &amp; &lt;wild&gt;"/><shape type="sphere" id="日本 a">
    <ref id="böse &amp; &lt;wild&gt;"/></shape>
    <shape type="rectangle" id="a/b\\c"/><shape type="disk" id="it's &quot;it&quot;"/>""",
    "layout": """<shape  type = "sphere"
       id='a'  ><!-- <rgb name="reflectance"/> in a comment, and > --><bsdf
         type="diffuse"
       ><rgb name="reflectance"
             value="0.5"   /></bsdf
       ></shape ><?note of a program?>""",
    "mixed": """<shape type="cube" id="a"><bsdf type="diffuse"><texture type="checkerboard" name="reflectance">
    <rgb name="color0" value="0.2, 0.3, 0.4"/></texture></bsdf></shape>""",
}  # fmt: skip
AXES = ("x", "y", "diagonal", "smaller", "larger")
for axis in AXES:
    BODIES[f"fov {axis}"] = (
        f'<sensor type="perspective" id="s"><string name="fov_axis" value="{axis}"/><float name="fov" value="40"/>{FILM}</sensor>'
        f'<sensor type="thinlens" id="t"><float name="fov" value="30"/><float name="aperture_radius" value="0.1"/>'
        f'<string name="fov_axis" value="{axis}"/>{FILM.replace("12", "6")}</sensor>'
    )
BODIES["focal length"] = f'<sensor type="perspective" id="s"><string name="focal_length" value="50mm"/>{FILM}</sensor>'
BODIES["no fov"] = f'<sensor type="perspective">{FILM}</sensor><sensor type="orthographic" id="o">{FILM}</sensor>'


@pytest.mark.parametrize("name", BODIES)
def test_all_parameters(tmp_path: Path, variant: str, name: str) -> None:
    file = scene(tmp_path, BODIES[name])
    written = check_all(file, tmp_path)
    unwritable = r"spot\.texture\.value |.*\.(specular_\w+|spec_trans)\.value "
    assert all(re.match(unwritable, note) for note in written.notes), written.notes
    assert "<!-- kept -->" in written.files[0].read_text(encoding="utf-8")


def test_scenes_with_our_integrator(tmp_path: Path, variant: str) -> None:
    body = '<integrator type="shadowmap"><integer name="shadow_map_resolution" value="64"/></integrator>' + BODIES["defaults"]
    assert not check_all(scene(tmp_path, body), tmp_path).notes


@pytest.mark.parametrize(
    "kind",
    [
        *("diffuse", "conductor", "roughconductor", "dielectric", "roughdielectric", "thindielectric", "plastic", "roughplastic"),
        *("principled", "principledthin", "null", "bumpmap", "normalmap"),
    ],
)
def test_materials_of_all_kinds(tmp_path: Path, variant: str, kind: str) -> None:
    texture = '<texture type="checkerboard" name="normalmap"/>' if kind == "normalmap" else '<texture type="checkerboard"/>'
    inner = f'{texture}<bsdf type="diffuse"/>' if kind in ("bumpmap", "normalmap") else ""
    file = scene(tmp_path, f'<shape type="cube" id="a"><bsdf type="{kind}">{inner}</bsdf></shape>')
    assert not check_all(file, tmp_path).notes


def test_parameters_without_a_value(tmp_path: Path, variant: str) -> None:
    body = '<shape type="cube" id="a"><bsdf type="hair"/></shape><shape type="cube" id="b"><bsdf type="diffuse"/></shape>'
    written = write(scene(tmp_path, body), tmp_path, values={"b.bsdf.reflectance.value": np.array([0.1, 0.2, 0.3])})
    assert not written.notes


def test_spectra_in_files(tmp_path: Path, variant: str) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.spd").write_text("400 0.2\n550 0.5\n700 0.7\n")
    body = '<shape type="cube" id="{}"><bsdf type="diffuse"><spectrum name="reflectance" filename="a.spd"/></bsdf></shape>'
    file = scene(tmp_path / "in", body.format("a") + body.format("b"))
    written = write(file, tmp_path, values={"b.bsdf.reflectance.value": np.array([0.1, 0.2, 0.3])})
    assert not written.notes and 'filename="../in/a.spd"' in written.files[0].read_text()
    np.testing.assert_allclose(np.array(read(written)["b.bsdf.reflectance.value"]).ravel(), [0.1, 0.2, 0.3], rtol=1e-6)


def test_refraction_of_principled_materials(tmp_path: Path, variant: str) -> None:
    body = '<shape type="cube" id="a"><bsdf type="principled"><float name="eta" value="1.5"/></bsdf></shape>'
    written = write(scene(tmp_path, body), tmp_path, values={"a.bsdf.eta": np.array([1.3])})
    assert not written.notes and '<float name="eta" value="1.3"/>' in written.files[0].read_text()


_KINDS = ("sphere", "cube", "cylinder")


def test_maps_that_a_shape_does_not_take(tmp_path: Path, variant: str) -> None:
    file = scene(tmp_path, "".join(f'<shape type="{kind}" id="{name}"/>' for name, kind in zip("abc", _KINDS, strict=True)))
    matrix = np.diag([1.0, 2.0, 3.0, 1.0])
    written = write(file, tmp_path, transforms={"a": matrix, "b": matrix, "c": matrix})
    assert written.notes == [
        "a:pose could not be written into the scene file: Mitsuba draws a Sphere only round.",
        "c:pose could not be written into the scene file: Mitsuba draws a Cylinder only round.",
    ]
    assert "<matrix" in written.files[0].read_text()
    points = np.array(read(written)["b.vertex_positions"]).reshape(-1, 3)
    np.testing.assert_allclose(np.abs(points).max(0), [1, 2, 3])


def test_only_changed_lines_are_others(tmp_path: Path, variant: str) -> None:
    file = SCENES / "gallery.xml"
    written = write(file, tmp_path, values={"wall.bsdf.reflectance.value": np.array([0.1, 0.2, 0.3])})
    before, after = (path.read_text(encoding="utf-8").splitlines() for path in (file, written.files[0]))
    others = [(old, new) for old, new in zip(before, after, strict=True) if old != new]
    assert len(others) == 4 and not written.notes
    assert others[1] == (
        '            <rgb name="reflectance" value="0.62, 0.60, 0.56"/>',
        '            <rgb name="reflectance" value="0.1, 0.2, 0.3"/>',
    )
    assert all("filename" in old and "scenes/" in new for old, new in (others[0], others[2], others[3]))


def test_the_same_file_again_without_changes(tmp_path: Path, variant: str) -> None:
    for name in BODIES:
        file = scene(tmp_path, BODIES[name])
        written = write(file, tmp_path)
        assert written.files[0].read_bytes() == file.read_bytes() and not written.notes


def test_a_fit_of_a_fit(tmp_path: Path, variant: str) -> None:
    first = write(SCENES / "gallery.xml", tmp_path, transforms={"dragon": turned()}, values={"sun.to_world": turned(1)})
    second = write_fitted_scene(first.files[0], {}, Changes(transforms={"dragon": turned(2)}), tmp_path / "again")
    assert not second.notes
    old = np.array(mi.traverse(mi.load_file(str(SCENES / "gallery.xml"), optimize=False))["dragon.vertex_positions"])
    matrix = turned(2) @ turned()
    expected = old.reshape(-1, 3) @ matrix[:3, :3].T + matrix[:3, 3]
    np.testing.assert_allclose(np.array(read(second)["dragon.vertex_positions"]).reshape(-1, 3), expected, atol=1e-4)
    with pytest.raises(OutputError, match="the scene itself would be overwritten; give another folder"):
        write_fitted_scene(second.files[0], {}, Changes(), tmp_path / "again")


# -------------------------------------------------------------------------------------------------------------------- shapes


def mesh_file(path: Path, **options: Any) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.vertices *= np.array([1, 2, 3])
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".obj":
        lines = [f"v {x} {y} {z}\nvt {x} {y}" for x, y, z in mesh.vertices]
        lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in mesh.faces]
        path.write_text("\n".join(lines))
    else:
        mesh.export(path, **options)
    return mesh


PLY = '<shape type="ply" id="a"><string name="filename" value="a b.ply"/>{}</shape>'
SHAPES = {
    "ply": PLY.format(""),
    "obj": '<shape type="obj" id="a"><string name="filename" value="a.obj"/>'
           '<transform name="to_world"><scale value="2"/></transform></shape>',
    "faces": PLY.format('<boolean name="face_normals" value="true"/><float name="silhouette_sampling_weight" value="0.5"/>'),
    "flipped": PLY.format('<boolean name="flip_normals" value="true"/>'),
    "cube": '<shape type="cube" id="a"/>',
    "flipped cube": '<shape type="cube" id="a"><boolean name="flip_normals" value="true"/></shape>',
    "mirrored": PLY.format('<transform name="to_world"><scale x="-1"/></transform>'),
    "rectangle": '<shape type="rectangle" id="a"><transform name="to_world"><rotate x="1" angle="30"/></transform></shape>',
    "colours": '<shape type="ply" id="a"><string name="filename" value="colours.ply"/></shape>',
}  # fmt: skip
PLACED = {
    "sphere": '<shape type="sphere" id="a"><point name="center" value="1, 0, 0"/><float name="radius" value="2"/></shape>',
    "cylinder": '<shape type="cylinder" id="a"><point name="p0" value="1, 0, 0"/><point name="p1" value="1, 2, 0"/></shape>',
    "disk": '<shape type="disk" id="a"/>',
    "instance": '<shape type="shapegroup" id="g"><shape type="cube"/></shape><shape type="instance" id="a"><ref id="g"/></shape>',
    "curve": '<shape type="bsplinecurve" id="a"><string name="filename" value="curve.txt"/></shape>',
}


def shape_scene(folder: Path, body: str) -> Path:
    mesh_file(folder / "a b.ply")
    mesh_file(folder / "a.obj")
    path = folder / "colours.ply"
    rows = "".join(f"{x} {y} 0 {x} {y} 0.5\n" for x in (0, 1) for y in (0, 1))
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "r", "g", "b"))
    faces = "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex 4\n{names}{faces}{rows}3 0 1 2\n3 1 3 2\n")
    (folder / "curve.txt").write_text("\n".join(f"{k} {k * k} 0 0.1" for k in range(5)))
    return scene(folder, body)


@pytest.mark.parametrize("name", [*SHAPES, *PLACED])
def test_shapes_are_moved(tmp_path: Path, variant: str, name: str) -> None:
    file = shape_scene(tmp_path, (SHAPES | PLACED)[name])
    matrix = turned()
    if name in ("sphere", "disk", "cylinder"):
        assert np.linalg.det(matrix) > 0
    before = mi.load_file(str(file), optimize=False).shapes()[0]
    written = write(file, tmp_path, transforms={"a": matrix})
    assert not written.notes
    after = mi.load_file(str(written.files[0]), optimize=False).shapes()[0]
    if isinstance(before, mi.Mesh):
        points, moved = (np.array(shape.vertex_positions_buffer()).reshape(-1, 3) for shape in (before, after))
        np.testing.assert_allclose(moved, points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)
    else:
        key = "to_world" if name != "curve" else "control_points"
        old, new = (numbers(mi.traverse(shape)[key]) for shape in (before, after))
        if key == "to_world":
            np.testing.assert_allclose(new, matrix @ old, atol=1e-5)
        else:
            points, moved = (values.reshape(-1, 4)[:, :3] for values in (old, new))
            np.testing.assert_allclose(moved, points @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-5)


@pytest.mark.parametrize("name", SHAPES)
def test_vertices(tmp_path: Path, variant: str, name: str) -> None:
    """A picture of the written scene is that of the scene whose vertices were set."""
    light = '<emitter type="constant"/><integrator type="direct"/>'
    place = '<transform name="to_world"><lookat origin="1,-2,9" target="0,0,0" up="0,1,0"/></transform>'
    camera = f'<sensor type="perspective" id="c">{place}{FILM}</sensor>'
    file = shape_scene(tmp_path, light + camera + SHAPES[name])
    loaded = mi.load_file(str(file), optimize=False)
    shape = loaded.shapes()[0]
    old = np.array(shape.vertex_positions_buffer()).reshape(-1, 3)
    new = old + 0.2 * np.sin(3 * old[:, [1, 2, 0]]).astype(np.float32)
    written = write(file, tmp_path, vertices={"a": new})
    assert not written.notes
    after = mi.load_file(str(written.files[0]), optimize=False)
    weights = [float(mi.traverse(one)["a.silhouette_sampling_weight"]) for one in (loaded, after)]
    assert weights[0] == weights[1]
    assert [one.id() for one in after.shapes()] == ["a"] and written.files[1].name == "a.ply"
    np.testing.assert_allclose(np.array(after.shapes()[0].vertex_positions_buffer()).reshape(-1, 3), new, atol=1e-6)
    table = mi.traverse(loaded)
    if "a.vertex_positions" in table:
        table["a.vertex_positions"] = mi.Float(new.ravel())
        table.update()
        first, second = (np.array(mi.render(one, spp=16, seed=1)) for one in (loaded, after))
        assert first.max() > 0
        np.testing.assert_allclose(second, first, atol=2e-2)


def test_colours_of_vertices(tmp_path: Path, variant: str) -> None:
    file = shape_scene(tmp_path, SHAPES["colours"])
    colours = np.linspace(0, 1, 12)
    written = write(file, tmp_path, values={"a.vertex_color": colours}, transforms={"a": turned()})
    assert not written.notes
    np.testing.assert_allclose(np.array(read(written)["a.vertex_color"]).ravel(), colours, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"vertices": {"a": np.zeros((3, 3))}}, "a:vertices .*: 3 vertices were given, but the mesh has 42"),
        ({"vertices": {"a": np.full((42, 3), np.nan)}}, "some vertices are not finite"),
        ({"vertices": {"ball": np.zeros((3, 3))}}, "ball:vertices .*: the shape is a Sphere, no mesh"),
        ({"vertices": {"c": np.zeros((3, 3))}}, "c:vertices .*: the scene has no such shape, only 'a', 'ball', 'i'"),
        ({"transforms": {"i.part": np.eye(4)}}, "i.part:pose .*: it is a part of 'i', which other instances may share"),
        ({"transforms": {"none": np.eye(4)}}, "none:pose .*: the scene has no such shape"),
        ({"values": {"g.part.vertex_positions": np.zeros(72)}}, "its shape is part of a shape group"),
        ({"values": {"nothing.value": np.zeros(3)}}, "nothing.value .*: the scene file has no such parameter"),
        ({"values": {"ball.bsdf.reflectance.value": np.array([0.1, np.inf, 0.2])}}, "its value is not finite"),
        ({"values": {"ball.bsdf.reflectance.value": np.array([0.1, 0.2])}}, "it has 2 numbers"),
        ({"values": {"ball.bsdf.reflectance.value": np.array([3.0, 3.0, 3.0])}}, "reflectance.value .*Mitsuba"),
        ({"values": {"ball.to_world": np.zeros((2, 2))}}, "ball.to_world .*is not .4, 4."),
    ],
)  # fmt: skip
def test_notes_of_what_cannot_be(tmp_path: Path, variant: str, changes: dict[str, Any], words: str) -> None:
    group = '<shape type="shapegroup" id="g"><shape type="cube" id="part"/></shape>'
    group += '<shape type="instance" id="i"><ref id="g"/></shape>'
    body = SHAPES["ply"] + '<shape type="sphere" id="ball"><bsdf type="diffuse"/></shape>' + group
    file = shape_scene(tmp_path, body)
    good = {"ball.silhouette_sampling_weight": np.array(0.5)}
    values = good | changes.pop("values", {})
    written = write_fitted_scene(file, {}, Changes(values=values, **changes), tmp_path / "out")
    assert len(written.notes) == 1 and re.search(words, written.notes[0]), written.notes
    # The rest is written, and nothing lies about.
    again = read(written)
    assert again["ball.silhouette_sampling_weight"] == 0.5
    assert sorted((tmp_path / "out").rglob("*.*")) == sorted(written.files)


# ------------------------------------------------------------------------------------------------------------------ textures


def picture(path: Path, mode: str = "RGB") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (6, 8, 3)).astype(np.uint8)).convert(mode).save(path)
    return path


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


# --------------------------------------------------------------------------------------------------------------------- files


def nested(folder: Path) -> Path:
    """A scene of several files, in folders with blanks."""
    picture(folder / "pictures of mine" / "t.png")
    mesh_file(folder / "parts" / "b.ply")
    mesh_file(folder / "ä ö.ply")
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="$pictures/t.png"/></texture>'
    inner = f'<bsdf type="diffuse" id="mat">{texture}</bsdf>'
    scene(folder, inner, "parts/deep er.xml")
    scene(folder, '<include filename="parts/deep er.xml"/><bsdf type="plastic" id="plastic"/>', "one.xml")
    scene(folder, '<shape type="ply" id="two"><string name="filename" value="b.ply"/><ref id="mat"/></shape>', "parts/two.xml")
    body = """<default name="pictures" value="pictures of mine"/><default name="red" value="0.5, 0.1, 0.1"/>
    <default name="mesh" value="ä ö.ply"/><path value="parts"/>
    <include filename="one.xml"/>
    <include filename="$which.xml"/>
    <shape type="ply" id="ball"><string name="filename" value="$mesh"/><bsdf type="diffuse">
    <rgb name="reflectance" value="$red"/></bsdf></shape>
    <shape type="cube" id="box"><ref id="plastic"/><transform name="to_world"><scale value="$size"/></transform></shape>
    <emitter type="point" id="bulb"><rgb name="intensity" value="$red"/></emitter>"""
    return scene(folder, body, "main of all.xml")


GIVEN = {"which": "two", "size": "3"}


@pytest.mark.parametrize("copy_files", [False, True])
def test_included_files_and_constants(tmp_path: Path, variant: str, copy_files: bool) -> None:
    file = nested(tmp_path / "source ö")
    values = {
        "plastic.diffuse_reflectance.value": np.array([0.3, 0.2, 0.1]),
        "ball.bsdf.reflectance.value": np.array([0.1, 0.2, 0.3]),
    }
    changes = Changes(values=values, transforms={"two": turned(), "box": turned(1)})
    out = tmp_path / "out put"
    written = write_fitted_scene(file, GIVEN, changes, out, copy_files=copy_files)
    assert not written.notes
    if copy_files:
        shutil.rmtree(tmp_path / "source ö")
        out = out.rename(tmp_path / "moved")
    again = mi.traverse(mi.load_file(str(out / "scene.xml"), optimize=False))
    for key, value in values.items():
        np.testing.assert_allclose(np.array(again[key]).ravel(), value, rtol=1e-5)
    np.testing.assert_allclose(np.array(again["bulb.intensity.value"]).ravel(), [0.5, 0.1, 0.1], rtol=1e-5)
    text = (out / "scene.xml").read_text(encoding="utf-8")
    assert '<rgb name="intensity" value="$red"/>' in text and '<default name="red" value="0.5, 0.1, 0.1"/>' in text
    assert '<string name="filename" value="$mesh"/>' in text and '<default name="size" value="3"/>' in text
    assert {path.name for path in written.files[1:]} >= {"one.xml", "two.xml", "deep er.xml"}
    # The parameters can be given again.
    mi.load_file(str(out / "scene.xml"), optimize=False, size="2", red="0.1, 0.1, 0.1")


def test_all_parameters_of_several_files(tmp_path: Path, variant: str) -> None:
    assert not check_all(nested(tmp_path / "source"), tmp_path, GIVEN).notes


def test_given_parameters_become_defaults(tmp_path: Path, variant: str) -> None:
    written = write(
        SCENES / "pose.xml", tmp_path, {"object": "meshes/bunny.ply", "resolution": "32"}, transforms={"object": turned()}
    )
    assert not written.notes
    loaded = mi.load_file(str(written.files[0]), optimize=False)
    assert list(loaded.sensors()[0].film().size()) == [32, 32]
    bunny = mi.load_dict({"type": "ply", "filename": str(SCENES / "meshes/bunny.ply")})
    assert mi.traverse(loaded)["object.vertex_positions"].shape == mi.traverse(bunny)["vertex_positions"].shape
    assert '<string name="filename" value="$object"/>' in written.files[0].read_text()


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "latin-1", "utf-16"])
@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_encodings(tmp_path: Path, variant: str, encoding: str, ends: str) -> None:
    declared = "" if encoding in ("utf-8-sig", "utf-16") else f' encoding="{encoding.replace("latin-1", "iso-8859-1")}"'
    text = f'<?xml version="1.0"{declared}?>\n<!-- Größe -->\n<scene version="3.0.0">\n'
    text += '  <!-- für ä -->\n  <shape type="cube" id="ä"/>\n'
    text += '  <shape type="sphere" id="b"><bsdf type="diffuse"><rgb name="reflectance" value="0.2"/></bsdf></shape>\n</scene>\n'
    (tmp_path / "a.xml").write_bytes(text.replace("\n", ends).encode(encoding))
    written = write(
        tmp_path / "a.xml", tmp_path, values={"b.bsdf.reflectance.value": np.array([0.3, 0.4, 0.5])}, transforms={"ä": turned()}
    )
    assert not written.notes
    np.testing.assert_allclose(np.array(read(written)["b.bsdf.reflectance.value"]).ravel(), [0.3, 0.4, 0.5])
    result = written.files[0].read_bytes().decode("utf-8")
    assert "<!-- Größe -->" in result and "<!-- für ä -->" in result and 'id="ä"' in result


def test_old_scenes(tmp_path: Path, variant: str) -> None:
    """Names with capitals, as before version 2."""
    body = """<shape type="sphere" id="a"><transform name="toWorld"><scale value="2"/></transform>
    <bsdf type="plastic"><rgb name="diffuseReflectance" value="0.2, 0.3, 0.4"/></bsdf></shape>
    <emitter type="spot" id="spot"><transform name="toWorld"><translate x="2"/></transform>
    <float name="cutoffAngle" value="20"/></emitter>"""
    written = check_all(scene(tmp_path, body, version="0.6.0"), tmp_path)
    assert [note.partition(" ")[0] for note in written.notes] == ["spot.texture.value"]
    text = written.files[0].read_text()
    assert 'name="diffuseReflectance"' in text and 'name="toWorld"' in text


def test_imported_models(tmp_path: Path, variant: str) -> None:
    mesh = trimesh.creation.box()
    mesh.visual = trimesh.visual.TextureVisuals(
        np.random.default_rng(0).random((8, 2)),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (200, 100, 50)), name="paint"),
    )
    (tmp_path / "a.glb").write_bytes(trimesh.Scene([mesh]).export(file_type="glb"))
    found = import_model(tmp_path / "a.glb", tmp_path / "imported" / "a.xml", ImportOptions(size=32, floor=True))
    assert all(".spec_trans.value " in note for note in check_all(found.scene, tmp_path).notes)


def test_objects_without_names(tmp_path: Path, variant: str) -> None:
    """Mitsuba names them by their place in memory: the order of all names tells which they are."""
    body = f'<sensor type="perspective">{FILM}</sensor><shape type="cube"/><shape type="sphere"/><shape type="cube" id="b"/>'
    file = scene(tmp_path, body)
    table = mi.traverse(mi.load_file(str(file), optimize=False))
    names = list(table.keys())
    key = next(name for name in names if name.endswith("x_fov"))
    changes = Changes(values={key: np.array([20.0])}, transforms={"shape_0": turned(), "shape_1": turned(1)})
    assert any("no such parameter" in note for note in write_fitted_scene(file, {}, changes, tmp_path / "first").notes)
    written = write_fitted_scene(file, {}, changes, tmp_path / "second", names=names)
    assert not written.notes
    again = read(written)
    assert float(np.ravel(np.array(again[next(name for name in again.keys() if name.endswith("x_fov"))]))[0]) == pytest.approx(20)


# --------------------------------------------------------------------------------------------------------------- dictionaries


def test_dictionaries(tmp_path: Path, variant: str) -> None:
    description = mi.cornell_box() | {"ball": {"type": "ply", "filename": str(SCENES / "meshes/spot.ply")}}
    table = mi.traverse(mi.load_dict(description, optimize=False))
    values = {"red.reflectance.value": np.array([0.1, 0.2, 0.3]), "light.emitter.radiance.value": np.array([5.0, 6.0, 7.0])}
    values["sensor.to_world"] = turned() * np.array([1 / 1.3] * 3 + [1.0])
    written = write_fitted_scene(description, {}, Changes(values=values, transforms={"ball": turned()}), tmp_path / "out")
    assert not written.notes
    again = read(written)
    assert set(again.keys()) == set(table.keys())
    for key, value in values.items():
        np.testing.assert_allclose(numbers(again[key]).ravel(), value.ravel(), atol=1e-5, err_msg=key)
    assert list((tmp_path / "out").iterdir()) == [tmp_path / "out" / "scene.xml"]  # no folder without files


def test_dictionaries_with_objects_are_refused(tmp_path: Path, variant: str) -> None:
    description = {"type": "scene", "ball": mi.load_dict({"type": "sphere"})}
    with pytest.raises(
        ShadowmapError, match="the scene's dictionary cannot be written as a file: .*Describe its parts by dictionaries"
    ):
        write_fitted_scene(description, {}, Changes(), tmp_path)


# ------------------------------------------------------------------------------------------------------------------ bad input


def test_bad_input(tmp_path: Path, variant: str) -> None:
    (tmp_path / "broken.xml").write_text("<scene version='3.0.0'><shape")
    (tmp_path / "shape.xml").write_text('<shape type="sphere" version="3.0.0"/>')
    for path, given, words in (
        (tmp_path / "none.xml", {}, "no scene .*: the file does not exist"),
        (tmp_path / "broken.xml", {}, "cannot load .*broken.xml"),
        (tmp_path / "shape.xml", {}, "its root is no scene"),
        (SCENES / "pose.xml", {"object": "none.ply"}, "cannot load .*pose.xml"),
    ):
        with pytest.raises(ShadowmapError, match=words) as caught:
            write_fitted_scene(path, given, Changes(), tmp_path / "out")
        assert "\n" not in str(caught.value)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        write_fitted_scene(SCENES / "pose.xml", {}, Changes(), tmp_path / "file" / "out")
    with pytest.raises(ShadowmapError, match=r"The map of 'wall' has the shape \(3, 3\), but must be a matrix \(4, 4\)"):
        write_fitted_scene(SCENES / "pose.xml", {}, Changes(transforms={"wall": np.eye(3)}), tmp_path / "out")
