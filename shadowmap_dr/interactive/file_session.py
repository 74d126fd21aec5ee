"""Modelling with any paint program: the mesh follows an image file."""

from __future__ import annotations

import atexit
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ..errors import ShadowmapError
from . import exports
from .modeller import Modeller
from .session import Session
from .snapshot import Snapshot
from .watch import ImageWatch

#: Seconds between two looks at the file, and between two saves of a mesh that moves.
LOOK_INTERVAL, SAVE_INTERVAL = 0.1, 2.0
log = logging.getLogger(__name__)

# Seconds until the user is told of a file that cannot be used. Most files are complete long before.
_PATIENCE = 2.0


def follow(
    modeller: Modeller,
    image: Path,
    save: Callable[[np.ndarray], None],
    stop: Callable[[], bool],
    say: Callable[[str], None] = lambda text: None,
) -> None:
    """Write the mesh's shadow into an image file, and deform the mesh whenever the file is changed, until `stop` returns True.

    An image that exists already is not overwritten: the mesh follows it from the start.

    Args:
        modeller: at rest.
        image: a .png file.
        save: called with vertices (V, 3) every two seconds while the mesh moves, when it comes to rest, and at the end.
        stop: called between steps.
        say: called with one line for the user at each event.
    """
    watch = ImageWatch(image, modeller.sculptor.views[0].shape)
    if image.exists():
        say(f"{image} exists: the mesh follows it.")
    else:
        exports.write_shadow(image, np.rint(255 * modeller.shadow().clip(0, 1)).astype(np.uint8))
        watch.ignore()
        say(f"{image} is the shadow: edit it.")
    looked = saved = -np.inf
    waiting: float | None = None
    unsaved = True
    while not stop():
        now = time.monotonic()
        if now - looked >= LOOK_INTERVAL:
            looked = now
            target = watch.poll()
            if target is not None:
                modeller.set_target(target)
                say(f"{image} has changed.")
            if watch.problem is None:
                waiting = None
            elif waiting is None:
                waiting = now
            elif now - waiting >= _PATIENCE:
                say(watch.problem)
                waiting = np.inf  # said once
        moved = modeller.step()
        unsaved |= moved
        if unsaved and (not modeller.moving or now - saved >= SAVE_INTERVAL):
            save(modeller.vertices())
            if moved and not modeller.moving:
                say(f"The mesh is at rest after {modeller.sculptor.steps} steps.")
            unsaved, saved = False, now
        if not modeller.moving:
            time.sleep(LOOK_INTERVAL / 2)
    if unsaved:
        save(modeller.vertices())


@contextmanager
def kept(session: Session, save: Callable[[Snapshot], None]) -> Iterator[None]:
    """Save the mesh of a session every two seconds if it has moved, until the context ends.

    Another thread saves. It ends with the interpreter if the context is still open then.
    """
    ending = threading.Event()

    def work() -> None:
        saved = session.snapshot.number
        while not ending.wait(SAVE_INTERVAL):
            snapshot = session.snapshot
            if snapshot.number != saved:
                saved = snapshot.number
                try:
                    save(snapshot)
                except ShadowmapError as error:  # for example, the disk is full: the next save may succeed
                    log.warning("%s", error)

    thread = threading.Thread(target=work, name="keeper", daemon=True)

    def end() -> None:
        ending.set()
        thread.join()

    thread.start()
    atexit.register(end)
    try:
        yield
    finally:
        end()
        atexit.unregister(end)
