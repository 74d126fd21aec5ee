"""Helpers for the tests of the PyTorch functions: casters, receivers, and central differences."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

import shadowmap_dr.torch as sdr
from shadowmap_dr import ShadowmapError, ShadowSettings

BOX = trimesh.creation.box((0.8, 0.5, 0.6), transform=trimesh.transformations.euler_matrix(0.3, 0.5, 0.2))
FACES = torch.tensor(np.asarray(BOX.faces))
VERTICES = torch.tensor(np.asarray(BOX.vertices), dtype=torch.float32)
SETTINGS = ShadowSettings(resolution=64, filter_size=5)
DIRECTION = torch.tensor([0.2, -0.15, -1.0])
POSITION = torch.tensor([0.4, 0.3, 2.5])
# A weak perspective: w = 2 - z / 2.
TO_CLIP = torch.tensor([[1.6, 0, 0, 0.03], [0, 1.6, 0, 0.02], [0, 0, -0.8, 0], [0, 0, -0.5, 2.0]])


def clip(vertices: torch.Tensor) -> torch.Tensor:
    """World-space vertices (..., V, 3) in clip space (..., V, 4)."""
    return torch.nn.functional.pad(vertices, (0, 1), value=1.0) @ TO_CLIP.T


def receivers(n: int, z: float = -1.5, half: float = 2.0) -> torch.Tensor:
    """Points (n, n, 3) of a wall."""
    line = half * ((2 * torch.arange(n) + 1) / n - 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([x, y, torch.full_like(x, z)], -1)


def smooth_weights(*shape: int) -> torch.Tensor:
    """Weights (..., H, W, C) that change slowly over an image and differ between its channels."""
    y, x = ((torch.arange(n) + 0.5) / n for n in shape[-3:-1])
    plane = 0.5 + 0.3 * torch.sin(5 * x + 1) * torch.cos(4 * y)[:, None] + 0.4 * x
    return (plane[..., None] * (1 + 0.2 * torch.arange(shape[-1]))).expand(shape)


def assert_agrees_with_differences(
    function: Callable[[torch.Tensor], torch.Tensor],
    at: torch.Tensor,
    direction: torch.Tensor,
    step: float,
    tolerance: float,
) -> None:
    """The derivative of sum(weights * function) along a direction against a central difference."""
    point = at.clone().requires_grad_()
    value = function(point)
    weights = smooth_weights(*value.shape)
    (gradient,) = torch.autograd.grad((weights * value).sum(), point)
    with torch.no_grad():
        ends = [(weights * function(at + sign * step * direction)).double().sum() for sign in (1, -1)]
    expected = float(ends[0] - ends[1]) / (2 * step)
    found = float((gradient.double() * direction).sum())
    assert abs(expected) > 1e-3 and abs(found - expected) <= tolerance * abs(expected), (found, expected)


def refused(message: str, function: Callable[[], Any]) -> None:
    with pytest.raises(ShadowmapError, match=re.escape(message)) as caught:
        function()
    assert "\n" not in str(caught.value) and str(caught.value).endswith((".", "4096"))


def made(
    vertices: torch.Tensor, light: sdr.Light, settings: ShadowSettings = SETTINGS, previous: sdr.ShadowMaps | None = None
) -> sdr.ShadowMaps:
    """Filtered maps of the box."""
    maps = sdr.render_maps(vertices, sdr.build_topology(FACES, VERTICES), light, settings, previous=previous)
    return sdr.filter_maps(maps)


def lit(vertices: torch.Tensor, light: sdr.Light, points: torch.Tensor) -> torch.Tensor:
    """Visibility of a light from points."""
    return sdr.visibility(made(vertices, light), points)


def light_of(kind: str, position: torch.Tensor = POSITION, direction: torch.Tensor = DIRECTION) -> sdr.Light:
    return {
        "directional": sdr.DirectionalLight(direction),
        "spot": sdr.SpotLight(position, direction, 40.0),
        "wide spot": sdr.SpotLight(position, direction, 75.0),
        "point": sdr.PointLight(position),
    }[kind]
