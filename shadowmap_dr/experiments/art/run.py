"""The optimisation loop of shadow art: steps, accuracy of the shadows, frames of an animation, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import drjit as dr
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...inverse.runs.loop import WARM_UP_STEPS
from ...io.checkpoints import read_checkpoint, unreadable, write_checkpoint
from ...jit.types import Float
from ...rendering.receivers.shadow_views import ShadowView

#: Steps between two measurements of the shadows, and between two checkpoints.
LOOK_INTERVAL, CHECKPOINT_INTERVAL = 10, 50
#: Largest number of frames of the animation.
FRAMES = 48

Array = npt.NDArray[np.float32]


class Maker(Protocol):
    """An optimiser of shadow art, such as `Sculptor`."""

    views: tuple[ShadowView, ...]

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """Faces (F, 3); a step may change them."""

    def step(self) -> Float:
        """Take one step. Returns the loss before the step, ``Float`` (1,)."""

    def vertices(self) -> Array:
        """Vertices (V, 3), world space."""

    def visibility(self) -> list[Array]:
        """Visibility image (H, W) of each view."""

    def target(self, view: int) -> Array:
        """Target image (H, W) of a view."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """State from which `load_state` continues exactly."""

    def load_state(self, state: Mapping[str, npt.NDArray[Any]]) -> None:
        """Continue from a result of `state`."""

    def describe(self) -> dict[str, Any]:
        """Settings for the record, as JSON values."""


@dataclass(frozen=True)
class Frame:
    """The mesh after ``step`` steps: vertices (V, 3) and faces (F, 3)."""

    step: int
    vertices: Array
    faces: npt.NDArray[np.uint32]


@dataclass
class Trace:
    """Course of a run.

    Attributes:
        loss: before each step.
        seconds: wall-clock time of each step.
        warm: False for steps that compile or record.
        looks: pairs of a step and the intersection over union of each view after it.
        frames: some meshes of the run, including the first and the last.
    """

    loss: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    warm: list[bool] = field(default_factory=list)
    looks: list[tuple[int, list[float]]] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)

    @property
    def iterations(self) -> int:
        return len(self.loss)

    @property
    def seconds_per_iteration(self) -> float:
        """Median time of the warm steps, or of all steps if none is warm."""
        warm = [s for s, w in zip(self.seconds, self.warm, strict=True) if w]
        return float(np.median(warm or self.seconds))


def intersection_over_union(image: npt.ArrayLike, target: npt.ArrayLike, seen: npt.NDArray[np.bool_] | None = None) -> float:
    """Intersection over union of the dark pixels (visibility below one half) of two (H, W) images, within ``seen``.

    It is 1 if neither image has dark pixels.
    """
    dark, wanted = np.asarray(image) < 0.5, np.asarray(target) < 0.5
    if seen is not None:
        dark, wanted = dark & seen, wanted & seen
    union = np.count_nonzero(dark | wanted)
    return np.count_nonzero(dark & wanted) / union if union else 1.0


def frame_steps(iterations: int) -> frozenset[int]:
    """Steps after which a frame is kept: denser in the beginning, when the mesh changes most."""
    share = np.linspace(0, 1, min(FRAMES, iterations + 1))
    return frozenset(int(s) for s in np.round(iterations * share**2))


def make(
    maker: Maker,
    iterations: int,
    *,
    checkpoint: Path | None = None,
    fingerprint: str = "",
    on_step: Callable[[int, str], None] = lambda done, note: None,
) -> Trace:
    """Run a number of steps.

    Args:
        maker: at its start.
        checkpoint: file that is written every 50 steps, and from which the run resumes if it exists.
        fingerprint: identifies the run; a checkpoint with another fingerprint is an error.
        on_step: called with the number of finished steps and a text about the accuracy of the shadows.

    Raises ShadowmapError if the checkpoint belongs to another run, cannot be read, or cannot be written.
    """
    if iterations < 1:
        raise ShadowmapError(f"{iterations} iterations: at least one is needed.")
    trace, wanted = Trace(), frame_steps(iterations)
    if checkpoint is not None and checkpoint.exists():
        trace, state = _load(checkpoint, fingerprint)
        try:
            maker.load_state(state)
        except KeyError as error:
            raise unreadable(checkpoint) from error
    if not trace.frames:
        trace.frames.append(Frame(0, maker.vertices(), maker.faces))
    last_change = first = trace.iterations
    faces = len(maker.faces)
    note = ""
    for i in range(first, iterations):
        began = time.perf_counter()
        loss = maker.step()
        dr.sync_thread()
        trace.seconds.append(time.perf_counter() - began)
        trace.warm.append(i - last_change >= WARM_UP_STEPS)
        trace.loss.append(float(np.asarray(loss).reshape(-1)[0]))
        done = i + 1
        if len(maker.faces) != faces:
            faces, last_change = len(maker.faces), done
        if done % LOOK_INTERVAL == 0 or done == iterations:
            images = maker.visibility()
            trace.looks.append((done, [
                intersection_over_union(image, maker.target(k), maker.views[k].seen) for k, image in enumerate(images)
            ]))  # fmt: skip
            note = "IoU " + ", ".join(f"{value:.3f}" for value in trace.looks[-1][1])
        if done in wanted:
            trace.frames.append(Frame(done, maker.vertices(), maker.faces))
        if checkpoint is not None and (done % CHECKPOINT_INTERVAL == 0 or done == iterations):
            _save(checkpoint, fingerprint, trace, maker.state())
        on_step(done, note)
    return trace


def _save(path: Path, fingerprint: str, trace: Trace, state: Mapping[str, npt.NDArray[Any]]) -> None:
    arrays: dict[str, Any] = {f"state/{name}": np.asarray(array) for name, array in state.items()}
    arrays |= {f"trace/{name}": np.array(getattr(trace, name)) for name in ("loss", "seconds", "warm")}
    arrays["looks/step"] = np.array([step for step, _ in trace.looks])
    arrays["looks/iou"] = np.array([values for _, values in trace.looks])
    previous: npt.NDArray[np.uint32] | None = None
    for k, frame in enumerate(trace.frames):
        arrays[f"frame/{k}/step"], arrays[f"frame/{k}/vertices"] = np.array(frame.step), frame.vertices
        if previous is None or not np.array_equal(frame.faces, previous):
            arrays[f"frame/{k}/faces"] = previous = frame.faces
    write_checkpoint(path, fingerprint, arrays)


def _load(path: Path, fingerprint: str) -> tuple[Trace, dict[str, npt.NDArray[Any]]]:
    arrays = read_checkpoint(path, fingerprint)
    try:
        trace = Trace(*(arrays[f"trace/{name}"].tolist() for name in ("loss", "seconds", "warm")))
        trace.looks = list(zip(arrays["looks/step"].tolist(), arrays["looks/iou"].tolist(), strict=True))
        faces: npt.NDArray[np.uint32] | None = None
        for k in range(sum(name.endswith("/vertices") and name.startswith("frame/") for name in arrays)):
            faces = arrays.get(f"frame/{k}/faces", faces)
            if faces is None:
                raise KeyError("faces")
            trace.frames.append(Frame(int(arrays[f"frame/{k}/step"]), arrays[f"frame/{k}/vertices"], faces))
    except (ValueError, KeyError) as error:
        raise unreadable(path) from error
    return trace, {name.removeprefix("state/"): array for name, array in arrays.items() if name.startswith("state/")}
