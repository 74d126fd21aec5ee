"""Names of things that vary, against the scenes of this package."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import shadowmap_dr
from shadowmap_dr import ShadowmapError
from shadowmap_dr.fitting import Vary
from shadowmap_dr.fitting.resolve import Resolver
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
