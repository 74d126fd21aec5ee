"""The optimiser's thread. It takes targets, publishes snapshots, and can be restarted after a failure."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable

import numpy as np
import numpy.typing as npt

from ..errors import ShadowmapError
from .commands import Command, Kind, Target, execute
from .mesh_history import MeshHistory
from .modeller import Modeller
from .snapshot import Phase, Snapshot, Status

#: Shortest time between two snapshots, seconds.
SNAPSHOT_INTERVAL = 0.05
# Time over which the speed is averaged, seconds.
_SPEED_WINDOW = 1.0
# Commands that may wait for the thread, which takes none after a failure. The oldest ones are dropped beyond.
_MOST_COMMANDS = 400

log = logging.getLogger(__name__)


class Session:
    """Owns a thread in which a mesh follows its target. All methods may be called from any thread.

    Methods do not wait for a step, except `start`, and `close`, which waits for one step. A new target replaces a target that the
    thread has not taken yet: only the newest one counts. When a step fails, the thread waits for `restart`, and builds a new
    modeller. It starts from the last good mesh, or from the first mesh if the last start has led to nothing.

    `begin` replaces the mesh by another one: the thread builds another modeller, and forgets targets and kept meshes of the last
    one.

    A session that is still open when the interpreter exits is closed then.

    Args:
        build: makes the modeller. The thread calls it once for each start, and does all of Dr.Jit's work.
        on_change: the thread calls it when there is a new snapshot or status. It must not wait.
    """

    def __init__(self, build: Callable[[], Modeller], on_change: Callable[[], None] = lambda: None) -> None:
        self._build, self.on_change = build, on_change
        self._condition = threading.Condition()
        self._target: Target | None = None
        self._target_is_new = self._restart = self._closing = self._beginning = False
        self._version = 0  # of the first image of the mesh, before there is a target
        self._commands: deque[Command] = deque(maxlen=_MOST_COMMANDS)
        self._history = MeshHistory()
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
        """The newest snapshot. Only after `start`."""
        if self._snapshot is None:
            raise RuntimeError("a session has no snapshot before it is started")
        return self._snapshot

    @property
    def faces(self) -> npt.NDArray[np.uint32]:
        """Faces (F, 3) of the newest snapshot. Only after `start`. They change with `begin` only."""
        return self.snapshot.faces

    def start(self) -> None:
        """Start the thread, and wait for the first snapshot. Raises the errors of building the modeller."""
        # A daemon thread that runs Dr.Jit while the interpreter is taken down would end the process by a signal.
        atexit.register(self.close)
        self._thread.start()
        with self._condition:
            self._condition.wait_for(lambda: self._status.phase != "starting")
        if self._failure is not None:
            failure = self._failure
            self.close()
            raise failure

    def begin(self, build: Callable[[], Modeller], version: int) -> None:
        """Replace the mesh. Targets and kept meshes of the last one are forgotten.

        If building fails, `restart` tries again. Until there is a new snapshot, the last one stays.

        Args:
            build: makes the modeller, from now on.
            version: snapshots have this number until there is a target.
        """
        with self._condition:
            self._build, self._version = build, version
            self._beginning = True
            self._target, self._target_is_new = None, False
            self._commands.clear()
            self._condition.notify_all()

    def set_target(self, image: npt.ArrayLike, version: int, go_back: Hashable = None, exact: bool = False) -> None:
        """Replace the target.

        Args:
            image: visibility (H, W) from 0 (dark) to 1 (lit).
            version: snapshots of meshes that have followed the target have this number.
            go_back: go back to the mesh that `keep` has kept under this name. If the history has dropped it, the mesh follows the
                target from where it is.
            exact: the image is the one of that moment, too. A mesh that was at rest then stays at rest.
        """
        target = Target(np.array(image, np.float32), version, follow=not exact)
        with self._condition:
            if go_back is not None:
                self._commands.append(Command("go back", go_back))
            self._target, self._target_is_new = target, True
            self._condition.notify_all()

    def keep(self, name: Hashable) -> None:
        """Keep vertices and optimiser, as they are between this step and the next one, in a history of bounded size.

        Call it before the target that changes the mesh is set.
        """
        self._order("keep", name)

    def reset(self) -> None:
        """Go back to the first mesh. The target stays."""
        self._order("reset")

    def restart(self) -> None:
        """Go on after a failure. Does nothing otherwise."""
        with self._condition:
            self._restart = self._status.phase == "failed"
            self._condition.notify_all()

    def close(self) -> None:
        """End the thread after its step. The last snapshot remains: the mesh after that step."""
        with self._condition:
            self._closing = True
            self._condition.notify_all()
        if self._thread.ident is not None:
            self._thread.join()
        atexit.unregister(self.close)

    def _order(self, kind: Kind, name: Hashable = None) -> None:
        with self._condition:
            self._commands.append(Command(kind, name, self._target.version if self._target is not None else self._version))
            self._condition.notify_all()

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
                    self._condition.wait_for(lambda: self._closing or self._restart or self._beginning)
                    self._restart = False
            first = False
        self._set_status("closed")

    def _follow(self, first: bool) -> None:
        """Build a modeller, and work until the session is closed or begins with another mesh."""
        if not first:
            self._set_status("starting")
        with self._condition:
            build = self._build
            if self._beginning:
                self._history = MeshHistory()
            self._beginning = False
        modeller = build()
        self._faces = modeller.sculptor.faces
        known = self._take_up(modeller)
        self._publish(modeller, known)
        self._first_number = self.snapshot.number
        last = time.monotonic()
        while True:
            self._set_status("moving" if modeller.moving else "resting")
            with self._condition:
                self._condition.wait_for(self._is_wanted(modeller))
                if self._beginning and not self._closing:
                    return
                closing, commands = self._closing, list(self._commands)
                self._commands.clear()
                target, self._target_is_new = self._target if self._target_is_new else None, False
            if closing:
                self._publish(modeller, known)
                return
            moved = execute(modeller, self._history, commands, target, known)
            known = target.version if target is not None else known
            if not (moved or target is not None or modeller.moving):
                continue  # the mesh has only been kept
            if modeller.moving:
                self._set_status("moving")  # before anybody sees a frame of it
            if modeller.step():
                self._steps += 1
                self._ticks.append(time.monotonic())
            if not modeller.moving or time.monotonic() - last >= SNAPSHOT_INTERVAL:
                last = time.monotonic()
                self._publish(modeller, known)

    def _is_wanted(self, modeller: Modeller) -> Callable[[], bool]:
        """A function that returns True if there is something to do."""
        return lambda: self._closing or self._beginning or self._target_is_new or bool(self._commands) or modeller.moving

    def _take_up(self, modeller: Modeller) -> int:
        """Load the last good mesh and the newest target, after a failure. Returns the version of the target."""
        last = self._snapshot
        if last is not None and last.start is modeller.start and last.number > self._first_number:
            modeller.sculptor.reset(last.vertices)
        with self._condition:
            target, self._target_is_new = self._target, False
        if target is None:
            return self._version
        modeller.set_target(target.image)
        return target.version

    def _publish(self, modeller: Modeller, target: int) -> None:
        vertices, shadow = modeller.vertices(), modeller.shadow()
        if not (np.isfinite(vertices).all() and np.isfinite(shadow).all()):
            raise ShadowmapError("the mesh has been lost: its vertices are not finite any more.")
        number = self._snapshot.number + 1 if self._snapshot is not None else 1
        pixels = np.rint(255 * shadow.clip(0, 1)).astype(np.uint8)
        speed = self._speed() if modeller.moving else 0.0
        self._snapshot = Snapshot(
            number, self._steps, target, modeller.loss, speed, vertices, pixels, self._faces, modeller.start
        )
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
