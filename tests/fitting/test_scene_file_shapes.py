"""Fitted scenes as files: shapes that are moved, and their vertices."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scene_files import FILM, mesh_file, numbers, read, scene, turned, write

from shadowmap_dr.fitting.changes import Changes
from shadowmap_dr.fitting.scene_file import write_fitted_scene

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
        ({"transforms": {"i.part": np.eye(4)}}, "i.part:pose .*: other parts of 'i' do not move along"),
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
    group = '<shape type="shapegroup" id="g"><shape type="cube" id="part"/><shape type="cube" id="other"/></shape>'
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


def test_instances_move_with_their_parts(tmp_path: Path, variant: str) -> None:
    group = '<shape type="shapegroup" id="g"><shape type="cube" id="part"/><shape type="cube" id="other"/></shape>'
    body = SHAPES["ply"] + group + "".join(f'<shape type="instance" id="{name}"><ref id="g"/></shape>' for name in "ij")
    file, matrix = shape_scene(tmp_path, body), turned()
    written = write(file, tmp_path, transforms={"i.part": matrix, "i.other": matrix})
    assert not written.notes
    again = read(written)
    np.testing.assert_allclose(np.array(again["i.to_world"].matrix).reshape(4, 4), matrix, atol=1e-6)
    np.testing.assert_allclose(np.array(again["j.to_world"].matrix).reshape(4, 4), np.eye(4), atol=1e-6)
