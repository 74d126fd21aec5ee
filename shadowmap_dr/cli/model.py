"""The command `shadowmap-dr model`: a mesh is deformed by painting on its shadow."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from ..errors import ShadowmapError, install_hint
from ..interactive import exports
from ..interactive.file_session import follow, kept
from ..interactive.library import SPHERE, MeshLibrary, read_start
from ..interactive.modeller import Modeller
from ..interactive.options import VIEWS, ModelOptions
from ..interactive.snapshot import Snapshot
from ..interactive.start_mesh import StartMesh
from ..inverse import Sculptor, ShadowView, shadow_view
from ..io import assets, console, files
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Variant, from_record

#: Weight of normal consistency: weak, so that parts without changes keep their details.
CONSISTENCY = 0.001

Vertices = npt.NDArray[np.float32]


@from_record()
def model(
    mesh: Annotated[str, typer.Argument(metavar="NAME|FILE", help=f"Mesh to deform: a file, a name, or '{SPHERE}'.")],
    options: ModelOptions,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Deform a mesh by painting on its shadow.

    Writes the shadow into an image file, and deforms the mesh whenever a paint program saves that file. With --serve, serves a
    web page for painting instead. Ctrl-C ends it. The mesh is saved when it comes to rest, and at the end.
    """
    files.check_output(options.output, tuple(f".{kind}" for kind in exports.FORMATS))
    if not options.serve:
        files.check_output(options.image, (".png",))
    path = None if mesh == SPHERE else assets.mesh(mesh)
    set_variant(variant)
    first = read_start(path)
    shadow = shadow_view(*VIEWS[options.view], size=options.resolution)

    def build(start: StartMesh) -> Modeller:
        settings: dict[str, Any] = {
            "step_size": options.step_size,
            "smoothness": options.smoothness,
            "consistency": CONSISTENCY,
            "map_resolution": options.resolution,
        }
        return Modeller(Sculptor(start.vertices, start.faces, [shadow], **settings), start)

    def save(start: StartMesh, vertices: Vertices) -> None:
        exports.write_mesh(options.output, start.placed(vertices), start.faces)

    if options.serve:
        _serve(MeshLibrary(first, build), shadow, options.port, save)
    else:
        console.note("Preparing ...")
        with _interrupts() as stopped:
            follow(build(first), options.image, partial(save, first), lambda: bool(stopped), console.note)
    typer.echo(f"Mesh: {options.output}")


def _serve(library: MeshLibrary, shadow: ShadowView, port: int, save: Callable[[StartMesh, Vertices], None]) -> None:
    """Serve the page until a signal comes. The mesh that is saved is the one that pages have chosen last."""
    try:
        from ..interactive.connections import Connections
        from ..interactive.server import listen, serve
    except ModuleNotFoundError as error:
        raise ShadowmapError(f"--serve needs the package {error.name}: {install_hint('interactive')}.") from error
    from ..interactive.session import Session

    def save_snapshot(snapshot: Snapshot) -> None:
        save(snapshot.start or library.first, snapshot.vertices)

    with listen(port) as listener, _interrupts() as stopped:
        session = Session(lambda: library.build(library.first))
        session.start()
        try:
            with kept(session, save_snapshot):
                connections = Connections(session, shadow, library.first.name, library)
                serve(connections, listener, lambda: bool(stopped), lambda url: typer.echo(f"Open {url} (Ctrl-C ends)"))
        finally:
            session.close()
            save_snapshot(session.snapshot)


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Collect signals to end (interrupt, termination, closed terminal) instead of interrupting a step."""
    caught: list[int] = []
    numbers = {getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)}
    before = {number: signal.signal(number, lambda n, _: caught.append(n)) for number in numbers}
    try:
        yield caught
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
