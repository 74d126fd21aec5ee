"""Benchmark: a recorded step through PyTorch, beside the same step of a `Renderer` in a frozen function.

Both give the vertices of the object in `scenes/pose.xml` new positions, render, and take the gradient of the same loss by one
number. They take turns in a process of their own, since PyTorch's threads must be told to sleep before it is imported.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from ...errors import ShadowmapError
from ..common.timing import Contender, alternate, compare
from .common import BenchOptions, Unit, Update, run_child
from .plugin import Frozen, Step, scene_of

if TYPE_CHECKING:
    import torch

# A process that takes longer than this hangs.
_SECONDS = 900.0


def units(options: BenchOptions) -> list[Unit]:
    """A unit for each size of images."""
    return [
        Unit(f"vertices@{size}", functools.partial(_measure, size, options.what.rounds))
        for size in options.what.torch_resolutions
    ]


def _measure(size: int, rounds: int, done: Mapping[str, Any], update: Update) -> dict[str, Any]:
    update(0, 1, f"{size} x {size}")
    return run_child("bench.torch_steps:measure_torch", {"size": size, "rounds": rounds}, _SECONDS)


def measure_torch(size: int, rounds: int, emit: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    """Seconds of both steps."""
    step = Step("vertices", size)
    steps: dict[str, Callable[[], object]] = {"torch": TorchStep(step), "renderer": Frozen(step)}
    contenders = {name: Contender(call, rounds, warm_up=10) for name, call in steps.items()}
    times = compare(alternate(contenders), [("torch", "renderer")])
    return {"resolution": size, **times}


class TorchStep:
    """The derivative of `bench.plugin.Frozen` through `shadowmap_dr.torch`."""

    def __init__(self, step: Step) -> None:
        try:
            from ...torch import Renderer
        except ImportError as error:
            raise ShadowmapError(str(error)) from error
        self._renderer = Renderer.from_scene(scene_of(step), frozen=True)
        self._spp = step.spp
        self._vertices, self._x = self._renderer.vertices("object"), 0.0

    def __call__(self) -> torch.Tensor | None:
        import torch

        self._x += 1e-4
        x = torch.full((), self._x, device=self._vertices.device, requires_grad=True)
        image = self._renderer.render({"object": self._vertices + x}, spp=self._spp)
        (image - 0.5).square().mean().backward()
        return x.grad
