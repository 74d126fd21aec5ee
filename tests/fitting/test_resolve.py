"""Names of things that vary, against the scenes of this package."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import shadowmap_dr
from shadowmap_dr import ShadowmapError
from shadowmap_dr.fitting import Vary
from shadowmap_dr.fitting.arrays import TextureValues
from shadowmap_dr.fitting.resolve import Resolver
from shadowmap_dr.fitting.scene_loading import load_scene
from shadowmap_dr.io import assets


@pytest.fixture
def resolver(variant: str) -> Resolver:
    path: Path = assets.scenes_dir() / "pose.xml"
    return Resolver(shadowmap_dr.Renderer.from_file(path, {"resolution": "16"}))


@pytest.mark.parametrize("entry", ["object:pose,spread=30", "object,max=1", "camera:pose,prior=2", "camera,min=-1"])
def test_a_pose_has_no_number_for_degrees_and_units(resolver: Resolver, entry: str) -> None:
    name = entry.partition(":")[0].partition(",")[0]
    with pytest.raises(ShadowmapError, match=re.escape(f"give {name}:rotation and {name}:translation")):
        resolver.parameter(Vary.parse(entry))


@pytest.mark.parametrize("entry", ["object:rotation,spread=30", "object:translation:xz,max=1", "object", "light,spread=60"])
def test_rotations_translations_and_directions_have_one(resolver: Resolver, entry: str) -> None:
    assert len(resolver.parameter(Vary.parse(entry)).labels) in (2, 3, 6)


def test_values_are_varied_once(resolver: Resolver) -> None:
    for entries in (["wall.bsdf.reflectance", "wall.bsdf.reflectance:brightness"], ["light.irradiance", "light:brightness"]):
        with pytest.raises(ShadowmapError, match="both vary .*value; leave one out"):
            resolver.parameters([Vary.parse(entry) for entry in entries])


SHAPES = """<scene version="3.0.0">
    <sensor type="perspective" id="camera"><film type="hdrfilm"><integer name="width" value="8"/></film></sensor>
    <emitter type="point" id="lamp"/>
    <shape type="sphere" id="ball"/>
    <shape type="cube" id="box"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">
        <string name="filename" value="tiny.png"/></texture></bsdf></shape>
    <shape type="shapegroup" id="group"><shape type="cube" id="part"/></shape>
    <shape type="instance" id="copy"><ref id="group"/></shape>
</scene>"""


@pytest.fixture
def shapes(variant: str, tmp_path: Path) -> Resolver:
    Image.fromarray(np.full((2, 2, 3), 128, np.uint8)).save(tmp_path / "tiny.png")
    (tmp_path / "scene.xml").write_text(SHAPES)
    return Resolver(shadowmap_dr.Renderer.from_scene(load_scene(tmp_path / "scene.xml")))


def test_small_pictures_are_textures(shapes: Resolver) -> None:
    """Of at most 16 numbers, as many as a value may have."""
    key = "box.bsdf.reflectance.data"
    assert {one.name: one.kinds for one in shapes.candidates()}[key] == ("texture",)
    assert isinstance(shapes.parameter(Vary.parse("box:texture")), TextureValues)
    with pytest.raises(ShadowmapError, match="has 12 values; give the kind texture"):
        shapes.parameter(Vary.parse(key))


@pytest.mark.parametrize("name", ["ball", "copy.part"])
def test_vertices_are_those_of_meshes(shapes: Resolver, name: str) -> None:
    """A scene file has no other ones to write them to."""
    kinds = {one.name: one.kinds for one in shapes.candidates()}
    assert "vertices" in kinds["box"] and "vertices" not in kinds[name]
    with pytest.raises(ShadowmapError, match=f"{name} is no mesh of its own"):
        shapes.parameter(Vary.parse(f"{name}:vertices"))


def test_instances_are_named_by_their_parts(shapes: Resolver) -> None:
    with pytest.raises(ShadowmapError, match=re.escape("Did you mean its parts, 'copy.*'?")):
        shapes.parameter(Vary.parse("copy:translation"))
    assert not isinstance(found := shapes.parameter(Vary.parse("copy.*:translation")), TextureValues) and found.labels
