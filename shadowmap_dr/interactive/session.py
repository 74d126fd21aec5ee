"""The optimiser's thread: it takes targets, leaves snapshots, and survives its own failures."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .modeller import Modeller

#: Least time between two snapshots, seconds.
SNAPSHOT_INTERVAL = 0.05
# Time over which the speed is averaged, seconds.
_SPEED_WINDOW = 1.0

Phase = Literal["starting", "moving", "resting", "failed", "closed"]
Array = npt.NDArray[np.float32]

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Status:
    """Status of the optimiser; the message says why it has failed."""

    phase: Phase
    message: str = ""


@dataclass(frozen=True)
class Snapshot:
    """The mesh at a moment. Nobody writes into its arrays.

    Attributes:
        number: counts snapshots from 1 on.
        steps: steps so far.
        target: the version of the target that the last step knew.
        loss: before that step.
        speed: steps per second lately, 0 at rest.
        vertices: (V, 3), world space.
        shadow: (H, W), visibility, 0 (dark) to 255 (lit).
    """

    number: int
    steps: int
    target: int
    loss: float
    speed: float
    vertices: Array
    shadow: npt.NDArray[np.uint8]


class Session:
    """Owns a thread in which a mesh follows its target. All methods may be called from any thread, and none waits for a step,
    but `start`, `restart` (not at all) and `close` (for one step).

    A new target replaces one that has not been looked at yet: only the newest counts. When a step fails, the thread waits for
    `restart`, and builds everything anew: from the last good mesh, or from the first one if that has led to nothing.

    Args:
        build: makes the modeller; called in the thread, once for each start. All of Dr.Jit's work stays there.
        on_change: called in the thread when there is a new snapshot or status. Must not wait.
    """

    def __init__(self, build: Callable[[], Modeller], on_change: Callable[[], None] = lambda: None) -> None:
        self._build, self.on_change = build, on_change
        self._condition = threading.Condition()
        self._target: tuple[Array, int] | None = None
        self._target_is_new = self._reset = self._restart = self._closing = False
        self._status = Status("starting")
        self._snapshot: Snapshot | None = None
        self._faces = np.zeros((0, 3), np.uint32)
        self._thread = threading.Thread(target=self._work, name="sculptor", daemon=True)
        self._steps = self._first_number = 0
        self._ticks: deque[float] = deque(maxlen=1000)
        self._failure: Exception | None = None

    @property
    def status(self) -> Status:
        return self._status

    @property
    def snapshot(self) -> Snapshot:
        """The newest one. Only after `start`."""
        if self._snapshot is None:
            raise RuntimeError("a session has no snapshot before it has been started")
        return self._snapshot

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """(F, 3). Only after `start`; they never change."""
        return self._faces

    def start(self) -> None:
        """Start, and wait for the first snapshot. Raises what building the modeller raises."""
        self._thread.start()
        with self._condition:
            self._condition.wait_for(lambda: self._status.phase != "starting")
        if self._failure is not None:
            failure = self._failure
            self.close()
            raise failure

    def set_target(self, image: npt.ArrayLike, version: int) -> None:
        """Visibility (H, W) from 0 to 1; the version comes back in snapshots."""
        pixels = np.array(image, np.float32)
        with self._condition:
            self._target, self._target_is_new = (pixels, version), True
            self._condition.notify_all()

    def reset(self) -> None:
        """Back to the first mesh; the target stays."""
        with self._condition:
            self._reset = True
            self._condition.notify_all()

    def restart(self) -> None:
        """Go on after a failure; does nothing otherwise."""
        with self._condition:
            self._restart = self._status.phase == "failed"
            self._condition.notify_all()

    def close(self) -> None:
        """End the thread. The last snapshot stays, and is what the mesh was at its last step."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        if self._thread.ident is not None:
            self._thread.join()

    def _work(self) -> None:
        first = True
        while not self._closing:
            try:
                self._follow(first)
            except Exception as error:
                log.debug("the optimiser has failed", exc_info=True)
                self._failure = error if first else None
                message = str(error) if isinstance(error, ShadowmapError) else f"{type(error).__name__}: {error}"
                self._set_status("failed", " ".join(message.split())[:500])
                with self._condition:
                    self._condition.wait_for(lambda: self._closing or self._restart)
                    self._restart = False
            first = False
        self._set_status("closed")

    def _follow(self, first: bool) -> None:
        """Builds a modeller and works until the session is closed."""
        if not first:
            self._set_status("starting")
        modeller = self._build()
        self._faces = modeller.sculptor.faces
        known = self._take_up(modeller)
        self._publish(modeller, known)
        self._first_number = self.snapshot.number
        last = time.monotonic()
        while True:
            self._set_status("moving" if modeller.moving else "resting")
            with self._condition:
                # At rest there is nothing to do but to wait.
                self._condition.wait_for(lambda: self._closing or self._target_is_new or self._reset or modeller.moving)
                closing, reset, self._reset = self._closing, self._reset, False
                target, self._target_is_new = self._target if self._target_is_new else None, False
            if closing:
                self._publish(modeller, known)
                return
            if reset:
                modeller.reset()
            if target is not None:
                modeller.set_target(target[0])
                known = target[1]
            if modeller.moving:
                self._set_status("moving")  # before anybody sees a frame of it
            if modeller.step():
                self._steps += 1
                self._ticks.append(time.monotonic())
            if not modeller.moving or time.monotonic() - last >= SNAPSHOT_INTERVAL:
                last = time.monotonic()
                self._publish(modeller, known)

    def _take_up(self, modeller: Modeller) -> int:
        """After a failure: the last good mesh and the newest target. Returns the target's version."""
        if self._snapshot is not None:
            if self._snapshot.number > self._first_number:
                modeller.sculptor.reset(self._snapshot.vertices)
        with self._condition:
            target, self._target_is_new = self._target, False
        if target is None:
            return 0
        modeller.set_target(target[0])
        return target[1]

    def _publish(self, modeller: Modeller, target: int) -> None:
        vertices, shadow = modeller.vertices(), modeller.shadow()
        if not (np.isfinite(vertices).all() and np.isfinite(shadow).all()):
            raise ShadowmapError("the mesh has been lost: its vertices are not finite any more.")
        number = self._snapshot.number + 1 if self._snapshot is not None else 1
        pixels = np.rint(255 * shadow.clip(0, 1)).astype(np.uint8)
        speed = self._speed() if modeller.moving else 0.0
        self._snapshot = Snapshot(number, self._steps, target, modeller.loss, speed, vertices, pixels)
        self.on_change()

    def _speed(self) -> float:
        now = time.monotonic()
        while self._ticks and self._ticks[0] < now - _SPEED_WINDOW:
            self._ticks.popleft()
        return (len(self._ticks) - 1) / (now - self._ticks[0]) if len(self._ticks) > 1 else 0.0

    def _set_status(self, phase: Phase, message: str = "") -> None:
        if self._status == Status(phase, message):
            return
        with self._condition:
            self._status = Status(phase, message)
            self._condition.notify_all()
        self.on_change()
