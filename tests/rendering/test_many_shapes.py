"""Scenes of many shapes: the same images and derivatives as one by one, by kernels that do not know how many there are."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import shadowmap_dr  # noqa: F401  registers the plug-in
from shadowmap_dr import ShadowmapError
from shadowmap_dr.raster import build_topology, topology, welding
from shadowmap_dr.rendering.gbuffer import surface as shading_module
from shadowmap_dr.scene import load as scene_module
from shadowmap_dr.scene.load import load, refresh

KINDS = ("cube", "rectangle", "disk", "sphere")
SIZE = 24


def placed(random: np.random.Generator, mirrored: bool = False) -> Any:
    x, y, angle = (float(v) for v in random.uniform((-2, -2, 0), (2, 2, 360)))
    side = -0.3 if mirrored else 0.3
    return mi.ScalarTransform4f().translate([x, y, 0.4]).rotate([1, 0.5, 0.2], angle).scale([0.3, 0.3, side])


def scene(count: int, kinds: tuple[str, ...] = KINDS, groups: int = 0) -> Any:
    """A floor, a sun, and so many small shapes; or else instances of groups of such shapes."""
    random, transform = np.random.default_rng(0), mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": SIZE, "height": SIZE, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    look = transform().look_at([0, -5, 4], [0, 0, 0], [0, 0, 1])
    parts: dict[str, Any] = {
        "type": "scene", "floor": {"type": "rectangle", "to_world": transform().scale(3)},
        "sun": {"type": "directional", "direction": [0.3, 0.2, -1]},
        "sensor": {"type": "perspective", "fov": 45, "to_world": look, "film": film},
    }  # fmt: skip
    for g in range(groups):
        parts[f"group{g}"] = {"type": "shapegroup", "part": {"type": kinds[g % len(kinds)]}}
    for k in range(count):
        colour = {"type": "rgb", "value": [float(v) for v in random.uniform(0.2, 0.9, 3)]}
        shape = {"type": kinds[k % len(kinds)], "bsdf": {"type": "diffuse", "reflectance": colour}}
        to_world = placed(random, k % 5 == 4)
        if groups:
            shape = {"type": "instance", "group": {"type": "ref", "id": f"group{k % groups}"}}
        parts[f"shape{k}"] = {**shape, "to_world": to_world}
    return mi.load_dict(parts, optimize=False)


def integrator(**options: Any) -> Any:
    return mi.load_dict({"type": "shadowmap", "tessellation": 8, "shadow_map_resolution": 32, **options})


@pytest.fixture(autouse=True)
def calls_through_pointers(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of more shapes than make quick tests."""
    monkeypatch.setattr(shading_module, "_MANY_SHAPES", 16)


def one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (scene_module, shading_module):
        monkeypatch.setattr(module, "_MANY_SHAPES", 1000)


def kernels(made: Any) -> tuple[int, int]:
    """Number of programs of a first image, and of their operations in all."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        np.array(mi.render(made, integrator=integrator(), spp=1))
        found = [entry["operation_count"] for entry in dr.kernel_history() if "operation_count" in entry]
        return len(found), sum(found)


@pytest.mark.parametrize("groups", [0, 4])
def test_kernels_do_not_depend_on_the_number_of_shapes(variant: str, groups: int) -> None:
    """But for constants, and for what kinds of materials there still are from elsewhere: calls know all of them."""
    (few, short), (many, long) = kernels(scene(20, groups=groups)), kernels(scene(44, groups=groups))
    assert few == many and 0 < long < 1.02 * short


@pytest.mark.parametrize("groups", [0, 4])
def test_many_shapes_look_like_single_ones(variant: str, monkeypatch: pytest.MonkeyPatch, groups: int) -> None:
    """Also when some of them have been changed in between."""

    def images() -> list[np.ndarray]:
        made, renders, found = scene(20, groups=groups), integrator(), []
        params = mi.traverse(made)
        for step in range(3):
            if step:
                moved = mi.Transform4f().translate([0, 0.4 * step, 1]).rotate([1, 0, 0], 30).scale(0.5)
                params["shape5.to_world" if groups == 0 else "shape3.to_world"] = moved
                params["floor.to_world"] = mi.Transform4f().scale(3 + step)
                if not groups:
                    params["shape8.vertex_positions"] = 1.1 * params["shape8.vertex_positions"]
                    params["shape3.bsdf.reflectance.value"] = mi.Color3f(0.1, 0.5, 0.3 * step)
                params.update()
            found.append(np.array(mi.render(made, integrator=renders, spp=1)))
        return found

    together = images()
    one_by_one(monkeypatch)
    single = images()
    assert np.abs(single[0] - single[1]).max() > 0.1 and np.abs(single[1] - single[2]).max() > 0.1
    for one, other in zip(together, single, strict=True):
        assert np.allclose(one, other, atol=1e-5)


def test_derivatives_are_those_of_single_shapes(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a sphere's and a rectangle's place, vertices, materials and light, in both modes, and again when others are attached."""
    meshes = ("shape0.vertex_positions", "shape4.vertex_positions")
    values = ("shape7.bsdf.reflectance.value", "shape16.bsdf.reflectance.value", "sun.irradiance.value")

    def derivatives() -> list[np.ndarray]:
        made, renders, found = scene(20), integrator(), []
        params = mi.traverse(made)
        for mode, names in (("backward", (meshes[0], *values)), ("backward", meshes), ("forward", ())):
            for name in (*meshes, *values):
                params[name] = dr.detach(params[name])
            x = mi.Float(0.2)
            dr.enable_grad(x, [params[name] for name in names])
            params["shape2.to_world"] = mi.Transform4f().translate([x, -1, 1]).scale(0.5)
            params["shape5.to_world"] = mi.Transform4f().translate([1, x, 1]).rotate([1, 0, 0], 100 * x).scale(0.5)
            params.update()
            image = mi.render(made, params=params, integrator=renders, spp=1)
            if mode == "forward":
                dr.set_grad(x, 1.0)
                found.append(np.array(dr.forward_to(image)))
                continue
            dr.backward(dr.sum(dr.square(image), axis=None))
            found += [np.array(dr.grad(array)) for array in (x, *(params[name] for name in names))]
        return found

    together = derivatives()
    one_by_one(monkeypatch)
    for one, other in zip(together, derivatives(), strict=True):
        assert np.abs(other).max() > 1e-3
        assert np.allclose(one, other, rtol=1e-3, atol=1e-4 * np.abs(other).max())


def test_recorded_images_of_many_shapes_follow_them(variant: str) -> None:
    made, plain, recorded = scene(20), integrator(), integrator(recorded=True)
    params = mi.traverse(made)
    for step in range(3):
        params["shape5.to_world"] = mi.Transform4f().translate([0, 0.4 * step, 1]).scale(0.5)
        params["shape8.vertex_positions"] = 1.1 * params["shape8.vertex_positions"]
        params.update()
        images = [np.array(mi.render(made, integrator=one, spp=1)) for one in (plain, recorded)]
        assert np.allclose(*images, atol=1e-5)


def test_other_numbers_of_vertices_are_refused(variant: str) -> None:
    made = scene(20)
    data, params = load(made), mi.traverse(made)
    params["shape8.vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0])
    params["shape8.vertex_normals"] = mi.Float([0] * 9)
    params["shape8.vertex_texcoords"] = mi.Float([0] * 6)
    params["shape8.faces"] = mi.UInt32([0, 1, 2])
    params.update()
    with pytest.raises(ShadowmapError, match="'shape8' now has 3 vertices instead of 24"):
        refresh(data)


def test_copies_have_the_edges_of_single_shapes(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of shapes apart, side by side, in the same place, squashed, and of one that is no copy."""
    roof = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 1], [0, 1, 0], [1, 0, 1], [2, 0, 0], [2, 1, 0], [1, 1, 1]])
    corners = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    shifts = ([0, 0, 0], [2, 0, 0], [4, 0, 0], [4, 0, 0], [0, 9, 0], [0, 12, 0])
    parts = [roof * (1, 0 if k == 4 else 1, 1) + shift for k, shift in enumerate(shifts)]
    faces = [corners[: 3 if k == 2 else None] for k in range(6)]
    points = np.concatenate(parts).astype(np.float32)
    merged = np.concatenate([own + len(roof) * k for k, own in enumerate(faces)])
    shapes = np.repeat(np.arange(6), len(roof))
    sizes = [len(group.faces) for group in welding.copies_of(merged, welding.weld(points, shapes).own, shapes)]
    assert sorted(sizes) == [1, 4]  # what has no copy is one group
    see_through = np.arange(len(merged)) % 2 == 0
    copied = build_topology(merged, points, mi.UInt32, shapes, see_through)
    whole = [welding.Copies(np.zeros(1, int), np.zeros(1, int), np.arange(len(merged)))]
    monkeypatch.setattr(topology, "copies_of", lambda *_: whole)
    single = build_topology(merged, points, mi.UInt32, shapes, see_through)
    for name in ("edges", "opposite", "owners"):  # in the same order
        assert (getattr(copied, name).numpy() == getattr(single, name).numpy()).all()
    assert copied.part_count == single.part_count
    assert np.unique(np.stack([copied.parts.numpy(), single.parts.numpy()]), axis=1).shape[1] == single.part_count
    for name in ("faces", "welded", "beyond"):
        assert (getattr(copied, name).numpy() == getattr(single, name).numpy()).all()
    assert copied.seams.count == single.seams.count > 0


def test_vertices_are_welded_where_they_are_equal() -> None:
    """By brute force."""
    random = np.random.default_rng(0)
    points, shapes = random.integers(-1, 2, (60, 3)).astype(np.float32), np.repeat([0, 1, 2], 20)
    equal = (points[:, None] == points).all(-1)
    place = equal.argmax(1)
    own = (equal & (shapes[:, None] == shapes)).argmax(1)
    assert (welding.Places.of(points).rank == np.unique(points, axis=0, return_inverse=True)[1].ravel()).all()
    found = welding.weld(points, shapes)
    assert (found.place == place).all() and (found.own == own).all()
    assert (welding.weld(points, None).own == place).all()
    assert (welding.weld(points[:1], shapes[:1]).place == [0]).all()
