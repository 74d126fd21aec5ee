"""One thread, as on a machine of one core: scenes whose files Mitsuba reads with Dr.Jit's threads load."""

import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from shadowmap_dr.io import images
from shadowmap_dr.jit.threads import second_thread

SCENE = """<scene version="3.0.0">
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
  </sensor>
  <shape type="sphere"><transform name="to_world"><translate z="3"/></transform></shape>
  <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
</scene>
"""
BEFORE = "import drjit as dr, shadowmap_dr, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); dr.set_thread_count(1); "
WAYS = {
    "Renderer.from_file": "shadowmap_dr.Renderer.from_file('scene.xml')",
    "fit": "from shadowmap_dr.fitting.scene_loading import load_scene; load_scene('scene.xml')",
    "the command": "from pathlib import Path; from shadowmap_dr.cli.scene_argument import load; load(Path('scene.xml'), {})",
}


@pytest.mark.parametrize("way", WAYS)
def test_scenes_with_exr_files_load_with_one_thread(way: str, tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text(SCENE)
    images.write_exr(tmp_path / "sky.exr", {name: np.ones((8, 16), np.float32) for name in "RGB"})
    code = BEFORE + WAYS[way] + "; print('threads', dr.thread_count())"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1:] == ["threads 1"], done.stderr


def test_more_threads_stay() -> None:
    mi.set_variant("llvm_ad_rgb")
    before = dr.thread_count()
    try:
        for threads, within in ((3, 3), (1, 2)):
            dr.set_thread_count(threads)
            with second_thread():
                assert dr.thread_count() == within
            assert dr.thread_count() == threads
    finally:
        dr.set_thread_count(before)
