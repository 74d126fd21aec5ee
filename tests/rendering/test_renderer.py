"""The functional path: a renderer that is built once and called with new vertices, lights and cameras."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from renderer_scenes import OPTIONS, SIZE, ball, build, camera, renderer_of, rest

from shadowmap_dr import Renderer, RenderSettings


@pytest.fixture
def renderer(variant: str) -> Renderer:
    return renderer_of()


# --------------------------------------------------------------------------------------------- independence from Mitsuba


@pytest.fixture
def no_ray_tracing(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Call the result to make everything raise that traces rays, reads Mitsuba's meshes or rebuilds their hierarchy."""

    def forbid() -> None:
        def forbidden(name: str) -> Any:
            def method(*_: Any, **__: Any) -> None:
                raise AssertionError(f"{name} was called")

            return method

        for kind, names in (
            (mi.Scene, ("ray_intersect", "ray_test", "sample_", "eval_", "pdf_", "parameters_changed", "invert_silhouette")),
            (mi.Shape, ("ray_intersect", "ray_test", "compute_surface", "eval_", "parameters_changed", "sample_")),
            (mi.Mesh, ("vertex_", "face_", "faces_", "ray_intersect", "parameters_changed", "recompute", "eval_", "write_")),
            (mi.PreliminaryIntersection3f, ("compute_surface",)),
            (mi.SceneParameters, ("update",)),
            (mi.Sensor, ("sample_",)),
            (mi.Emitter, ("sample_", "eval_direction")),
        ):
            for name in dir(kind):
                if name.startswith(names):
                    monkeypatch.setattr(kind, name, forbidden(f"{kind.__name__}.{name}"))

    return forbid


def test_step_traces_no_rays(renderer: Renderer, no_ray_tracing: Callable[[], None]) -> None:
    scene = renderer.data.scene
    no_ray_tracing()
    with pytest.raises(AssertionError, match="ray_intersect was called"):
        scene.ray_intersect(mi.Ray3f(mi.Point3f(0), mi.Vector3f(0, 0, 1)))
    before = renderer.render()
    shift = mi.Float(0.3)
    direction = mi.Vector3f(0.1, 0.5, -1)
    dr.enable_grad(shift, direction)
    view = renderer.data.sensors[0][0]
    image = renderer.render(
        vertex_positions={"ball": rest(renderer) + mi.Vector3f(shift, 0, 0)},
        lights={"sun": replace(renderer.light("sun"), direction=direction)},
        sensor=replace(view, to_world=mi.Transform4f().rotate(mi.Vector3f(0, 0, 1), 5 * shift) @ view.to_world),
    )
    assert image.shape == before.shape == (SIZE, SIZE, 3)
    dr.backward(dr.mean(dr.square(image - before)))
    assert dr.grad(shift)[0] != 0 and dr.all(dr.grad(direction) != 0)


def test_scene_itself_stays_as_it_is(renderer: Renderer) -> None:
    params = mi.traverse(renderer.data.scene)
    before = params["ball.vertex_positions"].numpy().copy()
    at_rest = renderer.render().numpy()
    # As far as the maps' fit stays what it is.
    moved = renderer.render(vertex_positions={"ball": rest(renderer) + mi.Vector3f(0.03, 0, 0)}).numpy()
    assert not np.allclose(at_rest, moved, atol=0.02)
    assert np.array_equal(renderer.render().numpy(), at_rest)
    assert np.array_equal(params["ball.vertex_positions"].numpy(), before)


# ----------------------------------------------------------------------------------------------------------- frozen steps


def test_frozen_step_records_and_compiles_nothing_after_the_third(renderer: Renderer) -> None:
    """Rendering, loss, gradients and the optimiser's update in one frozen function."""
    target = renderer.render()
    start = {"shift": mi.Point3f(0.15, -0.1, 0.05), "direction": mi.Vector3f(0.3, 0.4, -1.0)}

    def step(renderer: Renderer, adam: Any, base: Any, target: Any) -> Any:
        image = renderer.render(
            vertex_positions={"ball": base + adam["shift"]},
            lights={"sun": replace(renderer.light("sun"), direction=adam["direction"])},
        )
        loss = dr.mean(dr.square(image - target))
        dr.backward(loss)
        adam.step()
        return dr.detach(loss)

    def run(function: Any, steps: int) -> tuple[list[float], list[int], list[int], Any]:
        adam = mi.ad.Adam(lr=0.01, params=start)
        own = replace(renderer)
        losses, recordings, misses = [], [], []
        for _ in range(steps):
            with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
                dr.kernel_history_clear()
                losses.append(float(function(own, adam, rest(renderer), target).array[0]))
                kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
            # Replayed kernels are not looked up in the cache at all: their entries have no such key.
            misses.append(sum(not entry.get("cache_hit", True) for entry in kernels))
            recordings.append(getattr(function, "n_recordings", 0))
        return losses, recordings, misses, adam

    frozen = dr.freeze(step)
    losses, recordings, misses, adam = run(frozen, 12)
    assert recordings[2:] == [recordings[2]] * 10
    assert misses[3:] == [0] * 9
    assert losses[-1] < 0.3 * losses[0]
    # Replays compute what the function itself does.
    plain_losses, _, _, plain_adam = run(step, 12)
    assert np.allclose(losses, plain_losses, rtol=1e-3)
    assert dr.allclose(adam["shift"], plain_adam["shift"], atol=1e-4)
    assert dr.allclose(adam["direction"], plain_adam["direction"], atol=1e-4)


def test_frozen_step_follows_what_it_is_given(renderer: Renderer) -> None:
    """Nothing of the first call is baked into the recording."""

    @dr.freeze
    def image(renderer: Renderer, positions: Any, sun: Any, view: Any) -> Any:
        return renderer.render(vertex_positions={"ball": positions}, lights={"sun": sun}, sensor=view)

    frozen, plain = replace(renderer), replace(renderer)
    for k in range(5):
        positions = rest(renderer) + mi.Vector3f(0.1 * k, -0.2 * k, 0.05 * k)
        sun = replace(renderer.light("sun"), direction=mi.Vector3f(0.4 - 0.2 * k, 0.3, -1))
        view = renderer.data.sensors[0][0]
        turn = mi.Transform4f().rotate(mi.Vector3f(0, 0, 1), dr.opaque(mi.Float, 8.0 * k))
        view = replace(view, to_world=turn @ view.to_world)
        expected = plain.render(vertex_positions={"ball": positions}, lights={"sun": sun}, sensor=view)
        assert np.allclose(image(frozen, positions, sun, view).numpy(), expected.numpy(), atol=1e-4), k
    assert image.n_recordings <= 3


# ----------------------------------------------------------------------------------------------------------- replacements


@pytest.mark.parametrize("smooth", [False, True])
def test_vertices_may_have_several_forms(variant: str, smooth: bool) -> None:
    renderer = renderer_of(ball=ball("ball", [0, 0, 0.9], smooth=smooth))
    points = rest(renderer) + mi.Vector3f(0.2, 0.1, 0)
    flat = dr.ravel(points)
    count = dr.width(points)
    expected = renderer.render(vertex_positions={"ball": points}).numpy()
    for same in (flat, mi.TensorXf(flat, shape=(count, 3)), flat.numpy().reshape(-1, 3)):
        image = renderer.render(vertex_positions={"ball": same}).numpy()
        # Vertex normals of moved vertices are sums in any order.
        np.testing.assert_allclose(image, expected, rtol=0, atol=1e-6 if smooth else 0)


def test_replacements_agree_with_scenes_built_so(variant: str) -> None:
    sun = {"type": "directional", "direction": [-0.3, 0.2, -1], "irradiance": {"type": "rgb", "value": [1.0, 2.0, 3.0]}}
    lamp = {"type": "point", "position": [-1.0, -1.0, 3.0], "intensity": {"type": "rgb", "value": 5.0}}
    to_world = mi.ScalarTransform4f().look_at([-2, -3, 3], [0, 0, 0], [0, 0, 1])
    moved = ball("ball", [0.3, -0.2, 1.0])
    params = mi.traverse(moved)
    # Let Mitsuba compute the normals, as must be done for the vertices below.
    params["vertex_positions"] = np.array(params["vertex_positions"])
    params.update()
    expected = renderer_of(ball=moved, sun=sun, lamp=lamp, camera=camera(to_world=to_world))
    renderer = renderer_of()
    view = renderer.data.sensors[0][0]
    # Frusta that fit the old scene may hold the new one too: let this renderer start from the same.
    renderer.frusta = None
    image = renderer.render(
        vertex_positions={"ball": rest(renderer) + mi.Vector3f(0.3, -0.2, 0.1)},
        lights={
            "sun": replace(renderer.light("sun"), direction=mi.Vector3f(-0.3, 0.2, -1), irradiance=mi.Color3f(1, 2, 3)),
            "lamp": replace(renderer.light("lamp"), position=mi.Point3f(-1, -1, 3), intensity=mi.Color3f(5)),
        },
        sensor=replace(view, to_world=mi.Transform4f(to_world)),
    ).numpy()
    difference = np.abs(image - expected.render().numpy())
    assert difference.mean() < 1e-4 and np.quantile(difference, 0.99) < 1e-3


def test_refresh_reads_the_scene_again(variant: str) -> None:
    scene = build()
    renderer = Renderer.from_scene(scene, **OPTIONS)
    params = mi.traverse(scene)
    params["ball.vertex_positions"] += 0.2
    params["lamp.position"] = mi.Point3f(0, 1, 3)
    params.update()
    assert np.array_equal(renderer.render().numpy(), Renderer.from_scene(build(), **OPTIONS).render().numpy())
    fresh = renderer.refresh().render().numpy()
    assert np.abs(fresh - Renderer.from_scene(scene, **OPTIONS).render().numpy()).mean() < 1e-3


def test_gradients_agree_between_modes(renderer: Renderer) -> None:
    weight = mi.TensorXf(np.random.default_rng(1).uniform(-1, 1, (SIZE, SIZE, 3)).astype(np.float32))

    def image() -> tuple[Any, list[Any]]:
        values = [mi.Float(0) for _ in range(4)]
        dr.enable_grad(values)
        shift, turn, place, zoom = values
        view = renderer.data.sensors[0][0]
        rendered = renderer.render(
            vertex_positions={"ball": rest(renderer) + mi.Vector3f(shift, 0, 0)},
            lights={
                "sun": replace(renderer.light("sun"), direction=mi.Vector3f(0.4 + turn, 0.3, -1)),
                "lamp": replace(renderer.light("lamp"), position=mi.Point3f(1.5, place, 2.5)),
            },
            sensor=replace(view, x_fov=view.x_fov + 10 * zoom),
        )
        return dr.sum(rendered * weight), values

    total, values = image()
    dr.backward(total)
    backward = [dr.grad(value)[0] for value in values]
    assert all(np.isfinite(backward)) and all(backward)
    tangents = [0.7, -1.2, 0.4, 1.5]
    total, values = image()
    for value, tangent in zip(values, tangents, strict=True):
        dr.set_grad(value, tangent)
    dr.forward_to(total)
    assert dr.grad(total).array[0] == pytest.approx(float(np.dot(backward, tangents)), rel=1e-3)


# ------------------------------------------------------------------------------------------------------- cameras and films


def test_batch_sensor(variant: str) -> None:
    other = mi.ScalarTransform4f().look_at([-2, -3, 4], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 96, "height": 32, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    views = [camera(32, 32, to_world=to_world) for to_world in (other, camera()["to_world"], other)]
    batch = renderer_of(camera={"type": "batch", "film": film, **{f"view_{k}": view for k, view in enumerate(views)}})
    assert len(batch.data.sensors) == 1 and len(batch.data.sensors[0]) == 3
    image = batch.render().numpy()
    assert image.shape == (32, 96, 3)
    # The shadow maps cover what all three see, those of a single camera only its own view: without shadows nothing may differ.
    plain = replace(batch, settings=replace(batch.settings, shadow=replace(batch.settings.shadow, method="none")))
    unshadowed = plain.render().numpy()
    for k, record in enumerate(batch.data.sensors[0]):
        columns = slice(32 * k, 32 * (k + 1))
        assert np.allclose(unshadowed[:, columns], plain.render(sensor=record).numpy(), atol=1e-5)
        assert np.abs(image[:, columns] - batch.render(sensor=record).numpy()).mean() < 0.01 * image.mean()
    assert not np.allclose(image[:, :32], image[:, 32:64])


def test_second_sensor(variant: str) -> None:
    renderer = renderer_of(second=camera(20, 30))
    assert renderer.render(sensor=1).shape == (30, 20, 3)
    assert np.array_equal(renderer.render(sensor=1).numpy(), renderer.render(sensor=renderer.data.sensors[1][0]).numpy())


@pytest.mark.parametrize("spp, factor", [(4, 2), (7, 3), (16, 4)])
def test_supersampling_is_the_mean_of_a_larger_image(variant: str, spp: int, factor: int) -> None:
    small, large = (
        Renderer.from_scene(build(camera=camera(size, size)), antialias=False, **OPTIONS) for size in (16, 16 * factor)
    )
    mean = large.render().numpy().reshape(16, factor, 16, factor, 3).mean((1, 3))
    small.frusta = large.frusta  # the first fit depends a little on where the pixels look
    assert np.allclose(small.render(spp=spp).numpy(), mean, atol=1e-5)


def test_supersampling_stops_at_16_by_16(variant: str) -> None:
    renderer = renderer_of(camera=camera(4, 3))
    assert np.array_equal(renderer.render(spp=256).numpy(), renderer.render(spp=10_000).numpy())


def test_anti_aliasing_brings_an_image_closer_to_supersampling(renderer: Renderer) -> None:
    reference = replace(renderer, settings=replace(renderer.settings, antialias=False)).render(spp=256).numpy()
    errors = []
    for antialias in (True, False):
        image = replace(renderer, settings=replace(renderer.settings, antialias=antialias)).render().numpy()
        errors.append(np.abs(image - reference).mean())
    assert errors[0] < 0.7 * errors[1]


# ----------------------------------------------------------------------------------------------------------------- shadows


def frusta(renderer: Renderer) -> np.ndarray:
    return np.array(list(renderer.frusta.arrays().values()))


def test_frusta_do_not_see_small_moves(renderer: Renderer) -> None:
    """Not one bit changes when a caster moves by 0.3 texels, in any direction."""
    before = frusta(renderer)
    texel = 2 * before[2].min() / OPTIONS["shadow_map_resolution"]
    for direction in (*np.eye(3), *-np.eye(3), np.ones(3) / np.sqrt(3)):
        moved = rest(renderer) + mi.Vector3f((0.3 * texel * direction).astype(np.float32))
        renderer.render(vertex_positions={"ball": moved})
        assert np.array_equal(frusta(renderer), before)
    renderer.render(vertex_positions={"ball": rest(renderer) + mi.Vector3f(1.5, 0, 0)})
    assert not np.array_equal(frusta(renderer), before)


def test_frusta_do_not_see_the_turning_light(renderer: Renderer) -> None:
    before = frusta(renderer)
    for angle in (0.001, -0.001):
        sun = replace(renderer.light("sun"), direction=mi.Vector3f(0.4 + angle, 0.3 - angle, -1))
        renderer.render(lights={"sun": sun})
        assert np.array_equal(frusta(renderer), before)


def test_renderings_do_not_depend_on_earlier_ones(renderer: Renderer) -> None:
    """But for the frusta, which stay where they are as long as they fit."""
    first = renderer.render().numpy()
    renderer.render(vertex_positions={"ball": rest(renderer) + mi.Vector3f(2, 0, 0)})
    again = renderer.render().numpy()
    assert np.abs(first - again).mean() < 2e-3 * first.mean()


def test_shadows_can_be_left_out(variant: str) -> None:
    with_shadows = renderer_of().render().numpy()
    without = Renderer.from_scene(build(), shadow_method="none").render().numpy()
    assert without.sum() > 1.02 * with_shadows.sum()
    assert (without >= with_shadows - 1e-5).all()


def test_scene_without_lights_is_black(variant: str) -> None:
    image = renderer_of(sun=None, lamp=None).render().numpy()
    assert image.shape == (SIZE, SIZE, 3) and not image.any()
    ambient = Renderer.from_scene(build(sun=None, lamp=None), ambient=1.0).render().numpy()
    assert np.allclose(ambient[SIZE // 2, SIZE // 2], 0.5, atol=2e-3)


def test_further_channels(variant: str) -> None:
    renderer = Renderer.from_scene(build(), aovs=("visibility", "depth"), **OPTIONS)
    image = renderer.render().numpy()
    assert image.shape == (SIZE, SIZE, 3 + 2 + 1)
    assert np.array_equal(image[..., :3], renderer_of().render().numpy())
    assert image[..., 3].min() < 0.05 and image[..., 3].max() == pytest.approx(1)
    # Derivatives of visibility alone, as shadow art needs them.
    shift = mi.Float(0)
    dr.enable_grad(shift)
    image = renderer.render(vertex_positions={"ball": rest(renderer) + mi.Vector3f(shift, 0, 0)})
    dr.set_grad(shift, 1.0)
    dr.forward_to(image)
    derivative = dr.grad(image).numpy()[..., 3]
    assert derivative.min() < -0.5 and derivative.max() > 0.5


def test_settings_are_the_same_for_both_ways_to_build(renderer: Renderer) -> None:
    settings = RenderSettings(renderer.settings.shadow, shadow_samples=1)
    assert np.array_equal(Renderer.from_data(renderer.data, settings).render().numpy(), renderer.render().numpy())


def test_renderings_that_are_dropped_leave_no_graph(variant: str) -> None:
    """A reference from the graph back to what it leads to keeps all of it alive, and ends the process when it exits."""

    def attached() -> int:
        gc.collect()
        return len(dr.whos_ad(as_string=True).splitlines())

    renderer = renderer_of()
    before = attached()
    for _ in range(2):
        moved = rest(renderer) * 1.0
        dr.enable_grad(moved)
        dr.eval(renderer.render(vertex_positions={"ball": moved * 1.0}))
        del moved
    assert attached() == before


@pytest.mark.parametrize("flat", [False, True], ids=["points", "numbers"])
@pytest.mark.parametrize("factor", [0.3, 2.0])
def test_recorded_steps_with_another_number_of_vertices_are_refused(variant: str, factor: float, flat: bool) -> None:
    """They would write behind the end of an array, and end the process."""
    renderer, name = renderer_of(), "ball"
    rest = np.array(renderer.vertices(name))

    @dr.freeze
    def step(rest: Any, offset: Any, renderer: Any) -> Any:
        dr.enable_grad(offset)
        moved = rest + (offset.x if flat else offset)
        image = renderer.render(vertex_positions={name: moved})
        dr.backward(dr.mean(image, axis=None))
        return dr.grad(offset)

    def run(x: float, count: int = rest.shape[1]) -> Any:
        values = np.resize(rest, (3, count)) if count != rest.shape[1] else rest
        # Memory of Dr.Jit's own: it borrows NumPy's.
        points = (mi.Float(values.T.ravel()) if flat else mi.Point3f(values)) * dr.opaque(mi.Float, 1)
        offset = mi.Vector3f(x)
        dr.make_opaque(points, offset)
        return step(points, offset, renderer)

    for x in (0.0, 0.01, 0.02, 0.03):
        run(x)
    assert step.n_recordings <= 2
    with pytest.raises(RuntimeError) as error:
        run(0.04, int(factor * rest.shape[1]))
    assert "vertices" in str(error.value.__cause__)
    assert np.isfinite(run(0.05)).all()


def test_recorded_steps_of_shapes_without_size_guards_stay_within_their_shape(variant: str) -> None:
    """Scenes of very many sizes guard the largest shapes only: more vertices than recorded change no other memory."""
    renderer, name = renderer_of(), "ball"
    renderer.data = replace(renderer.data, geometry=replace(renderer.data.geometry, size_guards=()))
    # Outlines are sums without a fixed order, which differ by rounding.
    shadow = replace(renderer.settings.shadow, antialias=False)
    renderer.settings = replace(renderer.settings, antialias=False, shadow=shadow)
    rest = np.array(renderer.vertices(name))

    @dr.freeze
    def image(points: Any, renderer: Any) -> Any:
        return renderer.render(vertex_positions={name: points + 0.01})

    def run(count: int) -> Any:
        points = mi.Point3f(np.resize(rest, (3, count)) if count != rest.shape[1] else rest) * dr.opaque(mi.Float, 1)
        dr.make_opaque(points)
        return np.array(image(points, renderer))

    count = rest.shape[1]
    expected = [run(count) for _ in range(3)][-1]
    run(100 * count)
    np.testing.assert_array_equal(run(count), expected)
