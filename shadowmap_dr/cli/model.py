"""The command `shadowmap-dr model`: a mesh is deformed by painting on its shadow."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
import typer

from ..errors import ShadowmapError
from ..experiments.common.ranges import check_range
from ..interactive import exports
from ..interactive.file_session import follow, kept
from ..interactive.modeller import Modeller
from ..inverse import Sculptor, ShadowView, even_sphere, shadow_view
from ..io import assets, files
from ..io.meshes import read_placed_mesh
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Variant

#: Light direction, and direction that is up in the shadow image.
VIEWS = {"front": ((0, 0, -1), (0, 1, 0)), "side": ((-1, 0, 0), (0, 1, 0)), "top": ((0, -1, 0), (0, 0, -1))}
_SPHERE = "sphere"
#: Weight of normal consistency: weak, so that parts without changes keep their details.
CONSISTENCY = 0.001


def model(
    mesh: Annotated[str, typer.Argument(metavar="NAME|FILE", help=f"Mesh to deform: a file, a name, or '{_SPHERE}'.")],
    serve: Annotated[bool, typer.Option("--serve", help="Paint in the browser instead of in an image file.")] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page on 127.0.0.1; 0 for any free one.")] = 8711,
    image: Annotated[Path, typer.Option(help="Image of the shadow (.png), to edit in a paint program.")] = Path("shadow.png"),
    output: Annotated[Path, typer.Option("-o", "--output", help=f"Mesh to write: .{', .'.join(exports.FORMATS)}.")] = Path(
        "model.ply"
    ),
    view: Annotated[str, typer.Option(metavar="|".join(VIEWS), help="Side that the light comes from.")] = "front",
    resolution: Annotated[int, typer.Option(min=32, max=512, help="Pixels along each side of the shadow.")] = 256,
    smoothness: Annotated[float, typer.Option(help="Stiffness of the mesh; finer meshes need more.")] = 20.0,
    step_size: Annotated[float, typer.Option(help="Length of a step.")] = 0.2,
    variant: Variant = DEFAULT_VARIANT,
) -> None:
    """Deform a mesh by painting on its shadow.

    Writes the shadow into an image file, and deforms the mesh whenever a paint program saves that file. With --serve, serves a
    web page for painting instead. Ctrl-C ends it. The mesh is saved when it comes to rest, and at the end.
    """
    if view not in VIEWS:
        raise ShadowmapError(f"no view {view!r}: choose from {', '.join(VIEWS)}.")
    check_range("--smoothness", smoothness, (0.0, 1e6))
    check_range("--step-size", step_size, (1e-6, 100.0))
    files.check_output(output, tuple(f".{kind}" for kind in exports.FORMATS))
    if not serve:
        files.check_output(image, (".png",))
    path = None if mesh == _SPHERE else assets.mesh(mesh)
    set_variant(variant)
    vertices, faces, (middle, scale) = (*even_sphere(), ((0, 0, 0), 1.0)) if path is None else read_placed_mesh(path)
    shadow = shadow_view(*VIEWS[view], size=resolution)

    def build() -> Modeller:
        options: dict[str, Any] = {
            "step_size": step_size, "smoothness": smoothness, "consistency": CONSISTENCY, "map_resolution": resolution
        }  # fmt: skip
        return Modeller(Sculptor(vertices, faces, [shadow], **options))

    def save(moved: np.ndarray) -> None:
        placed: npt.NDArray[Any] = moved * scale + middle
        exports.write_mesh(output, placed, faces)

    if serve:
        _serve(build, shadow, _SPHERE if path is None else path.stem, port, save)
    else:
        typer.echo("Preparing ...", err=True)
        with _interrupts() as stopped:
            follow(build(), image, save, lambda: bool(stopped), lambda text: typer.echo(text, err=True))
    typer.echo(f"Mesh: {output}")


def _serve(build: Callable[[], Modeller], shadow: ShadowView, name: str, port: int, save: Callable[[np.ndarray], None]) -> None:
    try:
        from ..interactive.connections import Connections
        from ..interactive.server import listen, serve
    except ModuleNotFoundError as error:
        raise ShadowmapError(f"--serve needs the package {error.name}: pip install 'shadowmap-dr[interactive]'.") from error
    from ..interactive.session import Session

    with listen(port) as listener, _interrupts() as stopped:
        session = Session(build)
        session.start()
        try:
            with kept(session, save):
                connections = Connections(session, shadow, name)
                serve(connections, listener, lambda: bool(stopped), lambda url: typer.echo(f"Open {url} (Ctrl-C ends)"))
        finally:
            session.close()
            save(session.snapshot.vertices)


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
