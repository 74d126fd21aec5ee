"""Numbers that kernels read from memory: divisions by them, and kernels that serve images of all sizes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from renderer_scenes import build

from shadowmap_dr import Renderer
from shadowmap_dr.jit import kernel_inputs
from shadowmap_dr.jit.arrays import backend
from shadowmap_dr.jit.kernel_inputs import float_input, quotient, shared_inputs, split, uint_input

DIVISORS = (1, 2, 3, 5, 7, 255, 256, 257, 641, 4095, 4096, 65537, 2**24 - 1, 2**24 + 1, 2**30, 2**30 + 1, 2**31 - 1)


@pytest.mark.parametrize("divisor", DIVISORS)
def test_quotients_are_those_of_numpy(variant: str, divisor: int) -> None:
    near = np.arange(1, 100) * divisor
    numbers = np.concatenate([np.arange(100), near - 1, near, near + 1, 2**31 - 1 - np.arange(100)]) % 2**31
    numbers = np.concatenate([numbers, np.random.default_rng(divisor).integers(0, 2**31, 2000)])
    whole, rest = split(mi.UInt32(numbers.astype(np.uint32)), "size", divisor, 2**31 // divisor + 1)
    np.testing.assert_array_equal(whole.numpy(), numbers // divisor)
    np.testing.assert_array_equal(rest.numpy(), numbers % divisor)


def test_numbers_of_one_group_need_no_division(variant: str) -> None:
    index = dr.arange(mi.UInt32, 5)
    group, rest = split(index, "size", 5, 1)
    assert group.state == dr.VarState.Literal and rest.index == index.index


@pytest.mark.parametrize("divisor", [0, -1, 2**31])
def test_divisors_out_of_range(variant: str, divisor: int) -> None:
    with pytest.raises(ValueError, match="divisor"):
        quotient(mi.UInt32(1), "size", divisor)


def test_inputs_in_recordings(variant: str) -> None:
    """Inputs of the same name and value, made before a recording, in symbolic loops, and in recordings one after the other."""
    module = backend(mi.Float())

    def sums(x: mi.Float, size: int) -> mi.Float:
        def step(k: mi.UInt32, total: mi.Float) -> tuple[mi.UInt32, mi.Float]:
            return k + 1, total + float_input(module, "size", size)

        def condition(k: mi.UInt32, total: mi.Float) -> mi.Bool:
            return k < uint_input(module, "size", size)

        for _ in range(2):
            _, x = dr.while_loop((mi.UInt32(0), x), condition, step, mode="symbolic")
        return x + float_input(module, "size", size)

    start = dr.arange(mi.Float, 3)
    for shared in (sums, shared_inputs()(sums)):
        recorded = dr.freeze(shared)
        for size in (2, 3, 2, 3):
            expected = np.arange(3) + 2 * size**2 + size
            np.testing.assert_array_equal(sums(start, size).numpy(), expected)
            for _ in range(3):
                np.testing.assert_array_equal(recorded(start, size).numpy(), expected)


def test_derivatives_share_inputs_with_images(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording of an image and its derivatives makes each input once."""
    made: list[tuple[Any, str, float]] = []
    number, opaque = kernel_inputs._number, dr.opaque

    def counting(kind: Any, name: str, value: float) -> Any:
        def make(*args: Any) -> Any:
            made.append((kind, name, value))
            return opaque(*args)

        with monkeypatch.context() as patch:
            patch.setattr(dr, "opaque", make)
            return number(kind, name, value)

    renderer = Renderer.from_scene(build())
    name = renderer.data.geometry.shapes[-1].name
    rest = dr.ravel(renderer.vertices(name))

    @dr.freeze
    def step(renderer: Renderer, rest: mi.Float, shift: mi.Float) -> mi.Float:
        dr.enable_grad(shift)
        places = dr.unravel(mi.Point3f, rest) + mi.Vector3f(shift, 0, 0)
        dr.backward(dr.mean(renderer.render({name: dr.ravel(places)}), axis=None))
        return dr.grad(shift)

    monkeypatch.setattr(kernel_inputs, "_number", counting)
    dr.eval(step(renderer, rest, mi.Float(0.01)))
    assert step.n_recordings == 1 and len(made) > 10
    assert len(made) == len(set(made)), "the same input was made twice"


@pytest.mark.parametrize("spp", [1, 4])
def test_kernels_serve_other_sizes(variant: str, spp: int) -> None:
    """Images and maps of another size need few kernels more, in both directions: sizes are not part of kernels."""

    def kernels(width: int, height: int, resolution: int) -> set[str]:
        scene = build()
        params = mi.traverse(scene)
        params["camera.film.size"] = params["camera.film.crop_size"] = [width, height]
        params.update()
        renderer = Renderer.from_scene(scene, shadow_map_resolution=resolution)
        name = renderer.data.geometry.shapes[-1].name
        found: set[str] = set()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            for mode in (dr.ADMode.Backward, dr.ADMode.Forward):
                shift = mi.Float(0)
                dr.enable_grad(shift)
                image = renderer.render({name: dr.ravel(renderer.vertices(name) + mi.Vector3f(shift, 0, 0))}, spp=spp)
                source, target = (image, shift) if mode == dr.ADMode.Backward else (shift, image)
                dr.set_grad(source, 1)
                dr.enqueue(mode, source)
                dr.traverse(mode)
                dr.eval(dr.grad(target))
            found.update(entry["hash"] for entry in dr.kernel_history() if "hash" in entry)
        return found

    first = kernels(48, 36, 32)
    assert len(kernels(96, 72, 64) - first) <= 0.1 * len(first)
