"""Copies and pickles of renderers, on Dr.Jit's arrays and on PyTorch tensors."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[torch]'")

from torch_scene import refused  # noqa: E402

import shadowmap_dr  # noqa: E402
import shadowmap_dr.torch as sdr  # noqa: E402

OPTIONS = {"shadow_map_resolution": 64, "shadow_filter_size": 5, "shadow_samples": 1, "ambient": 0.25}
KINDS = [shadowmap_dr.Renderer, sdr.Renderer]


@pytest.fixture(autouse=True)
def llvm() -> None:
    mi.set_variant("llvm_ad_rgb")
    torch.set_num_threads(1)


def description(**more: Any) -> dict[str, Any]:
    texture = (0.3 + 0.5 * np.random.default_rng(1).random((4, 4, 3))).astype(np.float32)
    film = {"type": "hdrfilm", "width": 48, "height": 48, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([2, -3, 4], [0, 0, 0], [0, 0, 1])
    floor = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texture), "raw": True}}
    return {
        "type": "scene",
        "ball": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 0.9]).scale(0.4)},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3), "bsdf": floor},
        "camera": {"type": "perspective", "fov": 45, "to_world": view, "film": film},
        "sun": {"type": "directional", "direction": [0.4, 0.3, -1], "irradiance": {"type": "rgb", "value": 2.0}},
        **more,
    }


def image(renderer: Any, **options: Any) -> Any:
    return renderer.render(**options).numpy()


@pytest.mark.parametrize("kind", KINDS)
def test_pickles_of_dictionaries_render_the_same(kind: Any) -> None:
    renderer = kind.from_dict(description(), **OPTIONS)
    again = pickle.loads(pickle.dumps(renderer))
    np.testing.assert_allclose(image(again), image(renderer), atol=1e-6)
    assert image(renderer).std() > 0.1
    assert pickle.loads(pickle.dumps(again)) is not again


@pytest.mark.parametrize("kind", KINDS)
def test_pickles_of_points_and_vectors(kind: Any) -> None:
    """Mitsuba's own, of which Dr.Jit says that they have a matrix."""
    stone = {"type": "sphere", "center": mi.ScalarPoint3f(0.5, -0.5, 0.4), "radius": 0.3}
    more = {"stone": stone, "lamp": {"type": "directional", "direction": mi.ScalarVector3f(-0.5, 0.2, -1)}}
    renderer = kind.from_dict(description(**more), **OPTIONS)
    np.testing.assert_allclose(image(pickle.loads(pickle.dumps(renderer))), image(renderer), atol=1e-6)


@pytest.mark.parametrize("frozen", [False, True])
def test_pickles_keep_the_fit_of_shadow_maps(frozen: bool) -> None:
    renderer = sdr.Renderer.from_dict(description(), frozen=frozen, **OPTIONS)
    vertices = renderer.vertices("ball")
    before = image(renderer)
    renderer.render({"ball": vertices + torch.tensor([2.0, 2.0, 1.0])})
    image_now = image(pickle.loads(pickle.dumps(renderer)))
    np.testing.assert_allclose(image_now, image(renderer), atol=1e-6)
    again = pickle.loads(pickle.dumps(renderer))
    assert (again._frozen is not None) == frozen and before.shape == image_now.shape
    assert float(again._renderer.frusta.half_x[0]) == float(renderer._renderer.frusta.half_x[0])


def test_pickles_of_files_render_the_same_in_another_process(tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(
        """<scene version="3.0.0"><default name="size" value="16"/>
        <shape type="sphere" id="ball"><float name="radius" value="0.5"/></shape>
        <emitter type="point"><point name="position" x="1" y="1" z="3"/></emitter>
        <sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">
        <lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
        <film type="hdrfilm"><integer name="width" value="$size"/><integer name="height" value="24"/></film></sensor></scene>"""
    )
    renderer = sdr.Renderer.from_file(scene, {"size": "40"}, tessellation=16, **OPTIONS)
    (tmp_path / "renderer.pickle").write_bytes(pickle.dumps(renderer))
    code = (
        "import pickle, numpy, mitsuba; mitsuba.set_variant('llvm_ad_rgb')\n"
        "numpy.save('image', pickle.load(open('renderer.pickle', 'rb')).render().numpy())"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    found = np.load(tmp_path / "image.npy")
    assert found.shape[:2] == (24, 40) and found.max() > 0.1
    np.testing.assert_allclose(found, image(renderer), atol=1e-5)
    assert len(pickle.loads(pickle.dumps(renderer)).faces("ball")) == len(renderer.faces("ball"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("known", [False, True])
def test_deep_copies_have_a_fit_of_their_own(kind: Any, known: bool) -> None:
    renderer = (
        kind.from_dict(description(), **OPTIONS)
        if known
        else kind.from_scene(mi.load_dict(description(), optimize=False), **OPTIONS)
    )
    first = image(renderer)
    copied = copy.deepcopy({"renderer": renderer})["renderer"]
    core, own = (getattr(r, "_renderer", r) for r in (renderer, copied))
    assert copied is not renderer and np.allclose(image(copied), first, atol=1e-6)
    width = float(core.frusta.half_x[0])
    vertices = torch.tensor(core.data.geometry.shape_positions("ball").numpy().T) * 2 + torch.tensor([1.0, 1, 1])
    given = vertices if kind is sdr.Renderer else mi.TensorXf(vertices)
    copied.render({"ball": given})
    assert float(core.frusta.half_x[0]) == width != float(own.frusta.half_x[0]) and np.allclose(image(renderer), first, atol=1e-6)


def test_copies_have_gradients() -> None:
    renderer = copy.deepcopy(sdr.Renderer.from_dict(description(), frozen=True, **OPTIONS))
    vertices = renderer.vertices("ball").requires_grad_()
    renderer.render({"ball": vertices}).sum().backward()
    assert vertices.grad.abs().max() > 0.1


@pytest.mark.parametrize("kind", KINDS)
def test_what_cannot_be_pickled_is_said_in_a_line(kind: Any) -> None:
    renderer = kind.from_scene(mi.load_dict(description(), optimize=False), **OPTIONS)
    refused("Mitsuba's scenes cannot be pickled; make the renderer by Renderer.from_file", lambda: pickle.dumps(renderer))
    sphere = mi.load_dict({"type": "sphere"})
    holder = kind.from_dict(description(other=sphere), **OPTIONS)
    refused("'other' of the scene's dictionary is a", lambda: pickle.dumps(holder))
    data = pickle.dumps(kind.from_dict(description(), **OPTIONS))
    mi.set_variant("llvm_ad_mono")
    refused("The variant is llvm_ad_mono, but this renderer was made for llvm_ad_rgb: set that one.", lambda: pickle.loads(data))


@pytest.mark.parametrize("kind", KINDS)
def test_scenes_that_cannot_be_loaded_are_named(kind: Any, tmp_path: Path) -> None:
    for call in (
        lambda: kind.from_file(tmp_path / "none.xml"),
        lambda: kind.from_dict({"type": "scene", "shape": {"type": "no such shape"}}),
        lambda: kind.from_dict({"type": "sphere"}),
    ):
        with pytest.raises(shadowmap_dr.ShadowmapError, match="cannot load ") as caught:
            call()
        assert "\n" not in str(caught.value)
    refused("description: list, but must be a dictionary for mi.load_dict.", lambda: kind.from_dict([]))


@pytest.mark.parametrize("kind", KINDS)
def test_shallow_copies_need_no_origin(kind: Any) -> None:
    renderer = kind.from_scene(mi.load_dict(description()), **OPTIONS)
    copied = copy.copy(renderer)
    assert copied is not renderer
    np.testing.assert_array_equal(image(copied), image(renderer))
