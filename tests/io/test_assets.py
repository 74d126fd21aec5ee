"""Scenes and meshes that come with the package."""

from __future__ import annotations

from pathlib import Path

import pytest

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io import assets


def test_assets_are_found_by_name_and_path(tmp_path: Path) -> None:
    assert {"pose"} <= set(assets.scene_names())
    assert {"spot", "bunny"} <= set(assets.mesh_names())
    assert {"heart", "horse"} <= set(assets.target_names())
    assert assets.scene("pose").is_file() and assets.mesh("spot").is_file() and assets.target("heart").is_file()
    mine = tmp_path / "mine.ply"
    mine.touch()
    assert assets.mesh(str(mine)) == mine
    for find in (assets.mesh, assets.scene, assets.target):
        with pytest.raises(ShadowmapError, match="unknown.*one of"):
            find("unknown")
