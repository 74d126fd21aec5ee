"""Parameters of a scene at one moment: which were given other values since, and which carry gradients."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import pytest

from shadowmap_dr.integrator.parameter_state import ParameterState
from shadowmap_dr.io import assets

#: Parameters of all kinds that `scenes/pose.xml` has: arrays of numbers, transformations, colours.
NAMES = ("object.vertex_positions", "camera.to_world", "wall.to_world", "light.irradiance.value")


@pytest.fixture
def scene(variant: str) -> mi.Scene:
    return mi.load_file(str(assets.scene("pose")), resolution=16, optimize=False)


def again(value: Any) -> Any:
    """The same numbers in new variables."""
    if isinstance(value, mi.Transform4f):
        return mi.Transform4f(mi.Matrix4f(value.matrix) + dr.opaque(mi.Float, 0))
    return type(value)(value) + dr.opaque(mi.Float, 0)


def test_nothing_is_new_where_nothing_was_given(scene: mi.Scene) -> None:
    states = [ParameterState.of(scene) for _ in range(2)]
    assert states[0].same(states[1]) and states[0].attached == ()


@pytest.mark.parametrize("name", NAMES)
def test_a_new_value_counts_even_if_it_is_equal(scene: mi.Scene, name: str) -> None:
    before, params = ParameterState.of(scene), mi.traverse(scene)
    params[name] = again(params[name])
    after = ParameterState.of(scene)
    assert not after.same(before) and not after.same(before, [name])
    assert after.same(before, [other for other in before.numbers if other != name])


@pytest.mark.parametrize("number", range(3))
def test_each_number_of_a_colour_counts(scene: mi.Scene, number: int) -> None:
    """Whichever is given another value, and whichever carries gradients."""
    name, params = "light.irradiance.value", mi.traverse(scene)
    numbers = [dr.opaque(mi.Float, 0.5 + k) for k in range(3)]
    params[name] = mi.Color3f(*numbers)
    states = [ParameterState.of(scene)]
    for is_attached in (False, True):
        numbers[number] = dr.opaque(mi.Float, 0.25)
        if is_attached:
            dr.enable_grad(numbers[number])
        params[name] = mi.Color3f(*numbers)
        states.append(ParameterState.of(scene))
        assert not states[-1].same(states[-2], [name])
        assert states[-1].attached == ((name,) if is_attached else ())


@pytest.mark.parametrize("name", NAMES)
def test_attached_parameters(scene: mi.Scene, name: str) -> None:
    """They are told from the same numbers without gradients. What the state holds carries none."""
    before, params = ParameterState.of(scene), mi.traverse(scene)
    x = mi.Float(0)
    dr.enable_grad(x)
    value = params[name]
    if isinstance(value, mi.Transform4f):
        params[name] = mi.Transform4f().translate(mi.Vector3f(x, 0, 0)) @ value
    else:
        params[name] = value + x
    after = ParameterState.of(scene)
    assert after.attached == (name,)
    assert not after.same(before, [name])
    assert not any(dr.grad_enabled(array) for array in after.held)
    assert not any(getattr(array, "index_ad", 0) for array in after.held)
    # Another variable of AD with the same numbers is the same state.
    assert ParameterState.of(scene).same(after)


@pytest.mark.parametrize("name", NAMES)
def test_other_values_of_some_parameters(scene: mi.Scene, name: str) -> None:
    """The state with these values is that of a scene that has been given them."""
    before, params = ParameterState.of(scene), mi.traverse(scene)
    x = mi.Float(0)
    dr.enable_grad(x)
    value = again(params[name])
    params[name] = mi.Transform4f().translate(mi.Vector3f(x, 0, 0)) @ value if isinstance(value, mi.Transform4f) else value + x
    after = ParameterState.of(scene)
    found = before.with_values({name: params[name]})
    assert found.same(after) and found.attached == after.attached == (name,)
    assert after.with_values({name: value}).attached == ()
    assert not any(getattr(array, "index_ad", 0) for array in found.held)
