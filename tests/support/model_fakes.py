"""A stand-in for a sculptor: a handful of vertices that move towards a target at once, and fail when told to."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np

from shadowmap_dr.interactive import Modeller, Session
from shadowmap_dr.interactive.library import MeshLibrary
from shadowmap_dr.interactive.start_mesh import StartMesh
from shadowmap_dr.inverse import shadow_view

SIZE = 32


class FakeSculptor:
    """Its shadow is the target, step by step; its vertices' first coordinates are the target's mean and the number of steps."""

    def __init__(self, start: float = 0.75, size: int = SIZE) -> None:
        self.views = (shadow_view(size=size),)
        self.faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
        self._first = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
        self._now = self._first.copy()
        self._target = np.full((size, size), start, np.float32)
        self.steps = self.calmed = 0
        self.failure: Exception | None = None
        self.hold: threading.Event | None = None
        self.seconds = 0.0  # that a step takes

    def begin_with(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        """Take another mesh, whose shadow is half as bright."""
        self.faces, self._first, self._now = faces, vertices, vertices.copy()
        self._target = 0.5 * self._target

    def set_target(self, view: int, image: Any) -> None:
        assert view == 0 and image.shape == self._target.shape
        self._target = np.array(image, np.float32)

    def step(self) -> np.ndarray:
        if self.hold is not None:
            self.hold.wait(10)
        time.sleep(self.seconds)
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise failure
        self.steps += 1
        self._now[0, :2] = self._target.mean(), self.steps
        return np.array([0.1])

    def vertices(self) -> np.ndarray:
        return self._now.copy()

    def visibility(self) -> list[np.ndarray]:
        return [self._target.copy()]

    def reset(self, vertices: Any = None) -> None:
        self._now = self._first.copy() if vertices is None else np.array(vertices, np.float32)

    def calm(self) -> None:
        self.calmed += 1

    def state(self) -> dict[str, np.ndarray]:
        return {"u": self._now.copy(), "steps": np.array([self.steps])}

    def load_state(self, state: Any) -> None:
        self._now, self.steps = state["u"].copy(), int(state["steps"][0])


class FakeSession:
    """A session, and the sculptors it has built so far. The mesh is a square with the name ``ball``."""

    def __init__(self, size: int = SIZE) -> None:
        self.size = size
        self.sculptors: list[FakeSculptor] = []
        square = FakeSculptor(size=size)
        self.library = MeshLibrary(StartMesh("ball", square.vertices(), square.faces), self._build)
        self.session = Session(lambda: self._build(self.library.first))

    @property
    def sculptor(self) -> FakeSculptor:
        return self.sculptors[-1]

    def _build(self, start: StartMesh) -> Modeller:
        sculptor = FakeSculptor(size=self.size)
        if start.name != "ball":
            sculptor.begin_with(start.vertices, start.faces)
        self.sculptors.append(sculptor)
        return Modeller(self.sculptor, start)


def eventually(condition: Any, seconds: float = 10.0) -> None:
    """Wait until a condition holds, or fail."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it has not come to pass"
        time.sleep(0.005)
