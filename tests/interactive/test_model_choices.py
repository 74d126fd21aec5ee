"""Choice of mesh and target by name: all pages get them, and nobody paints on a mesh that goes."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import numpy as np
import pytest
from model_fakes import SIZE, FakeSession, eventually

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.interactive import Canvas, Modeller, messages
from shadowmap_dr.interactive.library import BLANK, MeshLibrary, read_named_target, read_start, target_names
from shadowmap_dr.interactive.start_mesh import StartMesh
from shadowmap_dr.io import assets

SEEN = np.ones((SIZE, SIZE), np.bool_)


class Board:
    """Connections of a session, and a page without a socket."""

    def __init__(self, fake: FakeSession) -> None:
        pytest.importorskip("starlette", reason="Starlette is not installed: pip install '.[interactive]'")
        from shadowmap_dr.interactive.client import Client
        from shadowmap_dr.interactive.connections import Connections

        self.connections = Connections(fake.session, fake.sculptor.views[0], "ball", fake.library)
        self.client = Client(0, None)

    def do(self, message: Any) -> None:
        asyncio.run(self.connections._handle(self.client, message))

    def stroke(self, number: int, mesh: int | None = None) -> None:
        self.do(messages.Stroke(number, number, "add", 5.0, np.array([[16.0, 16.0]]), mesh))

    @property
    def canvas(self) -> Canvas:
        self.connections._take_mesh()
        return self.connections.canvas


@pytest.fixture
def board(fake: FakeSession) -> Board:
    return Board(fake)


def test_meshes_are_those_of_the_package_and_the_first_one(fake):
    library = fake.library
    assert library.names == ("ball", "sphere", *assets.mesh_names())
    spot = library.load("spot")
    assert spot.name == "spot" and len(spot.vertices) > 1000 and spot.faces.max() == len(spot.vertices) - 1
    assert library.load("ball").vertices is library.first.vertices and library.load("ball") is not library.first
    assert len(library.load("sphere").faces) == 12_800
    for name in ("/etc/passwd", "../spot", "spot.ply", "scenes/meshes/spot.ply", ""):
        with pytest.raises(ShadowmapError, match="no mesh"):
            library.load(name)


def test_a_file_stands_for_its_name(fake, tmp_path):
    (tmp_path / "spot.obj").write_text("v 0 0 0\nv 4 0 0\nv 0 4 0\nv 0 0 4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    first = read_start(tmp_path / "spot.obj")
    library = MeshLibrary(first, fake.library.build)
    assert library.names.count("spot") == 1 and len(library.load("spot").faces) == 4
    np.testing.assert_allclose(sorted(map(tuple, library.load("spot").placed(first.vertices).round(5) + 0.0)),
                               [(0, 0, 0), (0, 0, 4), (0, 4, 0), (4, 0, 0)], atol=1e-5)  # fmt: skip


def test_targets_are_figures_of_the_package_and_blank():
    assert target_names()[0] == BLANK and "heart" in target_names()
    assert (read_named_target(BLANK, SEEN) == 1).all()
    heart = read_named_target("heart", SEEN)
    assert heart.shape == (SIZE, SIZE) and 0.15 < (heart < 0.5).mean() < 0.6
    for name in ("/etc/passwd", "../targets/heart", "heart.png", ""):
        with pytest.raises(ShadowmapError, match="no target"):
            read_named_target(name, SEEN)


def test_sessions_begin_with_another_mesh(fake):
    session = fake.session
    session.keep("first")
    session.set_target(np.full((SIZE, SIZE), 0.6, np.float32), 1)
    eventually(lambda: session.snapshot.target == 1 and session.status.phase == "resting")
    spot = fake.library.load("spot")
    session.begin(lambda: fake.library.build(spot), 7)
    eventually(lambda: session.snapshot.start is spot)
    snapshot = session.snapshot
    assert snapshot.target == 7 and session.status.phase == "resting" and len(fake.sculptors) == 2
    np.testing.assert_array_equal(snapshot.vertices, spot.vertices)
    np.testing.assert_array_equal(snapshot.faces, spot.faces)
    np.testing.assert_array_equal(session.faces, spot.faces)
    assert (snapshot.shadow == 96).all()  # its own, not the target of the last mesh
    # A kept mesh of the last one is not loaded.
    session.set_target(np.full((SIZE, SIZE), 0.3, np.float32), 8, go_back="first", exact=True)
    eventually(lambda: session.snapshot.target == 8 and session.status.phase == "resting")
    assert len(session.snapshot.vertices) == len(spot.vertices)


def test_the_newest_choice_counts_and_failures_can_be_left(fake):
    session = fake.session

    def fails() -> Modeller:
        raise RuntimeError("no memory")

    session.begin(fails, 1)
    eventually(lambda: session.status.phase == "failed")
    assert session.snapshot.start is fake.library.first
    spot = fake.library.load("spot")
    session.begin(lambda: fake.library.build(fake.library.load("vase")), 1)
    session.begin(lambda: fake.library.build(spot), 1)
    eventually(lambda: session.snapshot.start is spot and session.status.phase == "resting")
    # After a failure of its own it begins with its own mesh.
    fake.sculptor.failure = RuntimeError("out of luck")
    session.set_target(np.full((SIZE, SIZE), 0.5, np.float32), 2)
    eventually(lambda: session.status.phase == "failed")
    session.restart()
    eventually(lambda: session.snapshot.target == 2 and session.status.phase == "resting")
    assert session.snapshot.start is spot and len(session.snapshot.vertices) == len(spot.vertices)


def test_meshes_without_any_wanted_shadow_rest(fake):
    session = fake.session
    session.set_target(np.full((SIZE, SIZE), 0.5, np.float32), 1)
    eventually(lambda: session.snapshot.target == 1 and session.status.phase == "resting")
    steps = fake.sculptor.steps
    session.set_target(np.ones((SIZE, SIZE), np.float32), 2)
    eventually(lambda: session.snapshot.target == 2 and session.status.phase == "resting")
    session.reset()  # neither does a mesh that was moved otherwise
    eventually(lambda: not session._commands)
    assert fake.sculptor.steps == steps
    painted = np.ones((SIZE, SIZE), np.float32)
    painted[4, 4] = 0
    session.set_target(painted, 3)
    eventually(lambda: session.snapshot.target == 3 and session.status.phase == "resting")
    assert fake.sculptor.steps > steps


def test_a_chosen_mesh_has_a_canvas_of_its_own(board, fake):
    board.stroke(1)
    version = board.canvas.version
    assert board.canvas.can_undo
    board.do(messages.Choice("mesh", "spot"))
    eventually(lambda: board.canvas.version == version + 1)
    assert not board.canvas.can_undo and (board.canvas.pixels() == 96).all()
    board.stroke(2, mesh=1)
    board.do("undo")
    assert (board.canvas.pixels() == 96).all() and board.canvas.can_redo
    eventually(lambda: fake.session.snapshot.target == board.canvas.version)
    assert fake.session.snapshot.start.name == "spot"


def test_nobody_paints_on_a_mesh_that_goes(board, fake):
    build, ready = fake.library.build, threading.Event()

    def slowly(start: StartMesh) -> Modeller:
        ready.wait(10)
        return build(start)

    fake.library.build = slowly
    board.do(messages.Choice("mesh", "spot"))
    before = board.canvas.version
    board.client.wake.clear()
    board.stroke(5)
    for command in ("undo", "clear", "reset", messages.Choice("target", "heart")):
        board.do(command)
    with pytest.raises(ShadowmapError, match="being prepared"):
        board.connections.replace(np.zeros((SIZE, SIZE)))
    # The page that has drawn the stroke takes it back.
    assert board.canvas.version == before and board.client.seq == 5
    ready.set()
    eventually(lambda: board.canvas.version == before + 1)
    board.stroke(6, mesh=0)  # sent before the page knew of the new mesh
    assert board.canvas.version == before + 1 and board.client.seq == 6
    board.stroke(7, mesh=1)
    assert board.canvas.version == before + 2


def test_targets_are_put_on_top_and_can_be_undone(board, fake):
    before = board.canvas.pixels().copy()
    for name in ("heart", BLANK):
        board.do(messages.Choice("target", name))
        np.testing.assert_allclose(board.canvas.target(), read_named_target(name, SEEN), atol=0.5 / 255)
    eventually(lambda: fake.session.snapshot.target == 2)
    for _ in range(2):
        board.do("undo")
    np.testing.assert_array_equal(board.canvas.pixels(), before)


@pytest.mark.parametrize("choice", [
    ("mesh", "/etc/passwd"), ("mesh", "../spot"), ("mesh", "nothing"), ("target", "/etc/passwd"), ("target", "nothing"),
    ("target", "spot"),
])  # fmt: skip
def test_unknown_names_are_refused(board, choice):
    with pytest.raises(messages.MessageError, match="does not exist"):
        board.do(messages.Choice(*choice))
    assert board.canvas.version == 0


def test_pages_are_told_of_another_mesh_before_its_frames(board, fake):
    from shadowmap_dr.interactive.client import FrameCache

    connections, client = board.connections, board.client

    async def news() -> list[Any]:
        connections._take_mesh()
        return client.news(fake.session, connections.canvas, connections._mesh, FrameCache())

    async def early() -> list[Any]:
        return client.news(fake.session, connections.canvas, connections._mesh, FrameCache())

    asyncio.run(news())
    fake.session.set_target(np.full((SIZE, SIZE), 0.5, np.float32), 1)
    eventually(lambda: fake.session.snapshot.target == 1 and fake.session.status.phase == "resting")
    asyncio.run(news())  # the page has two frames, and shows none of them
    board.do(messages.Choice("mesh", "spot"))
    eventually(lambda: fake.session.snapshot.start is not fake.library.first and fake.session.status.phase == "resting")
    assert asyncio.run(early()) == []  # the canvas is that of the last mesh still
    told = asyncio.run(news())
    assert '"mesh": 1' in told[0] and '"name": "spot"' in told[0]
    assert [message[0] for message in told[1:4]] == [1, 3, 2] and len(told[1]) == 8 + 12 * len(fake.session.faces)
