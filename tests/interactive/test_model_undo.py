"""Undo and redo of strokes: the mesh of that moment comes back."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from model_fakes import SIZE, eventually

from shadowmap_dr.interactive import Modeller, Session
from shadowmap_dr.interactive.mesh_history import KeptMesh, MeshHistory
from shadowmap_dr.interactive.modeller import ModellerState
from shadowmap_dr.inverse import Sculptor, even_sphere, shadow_view


def image(value: float) -> np.ndarray:
    return np.full((SIZE, SIZE), value, np.float32)


def rests(session: Session, target: int) -> np.ndarray:
    eventually(lambda: session.snapshot.target == target and session.status.phase == "resting", 60)
    return session.snapshot.vertices


def test_undo_restores_vertices_and_rest(fake):
    session = fake.session
    first = session.snapshot.vertices
    session.keep("first")
    session.set_target(image(0.5), 1)
    second = rests(session, 1)
    session.keep("second")
    session.set_target(image(0.2), 2)
    assert rests(session, 2)[0, 0] == pytest.approx(0.2)
    for name, value, vertices in (("second", 0.5, second), ("first", 0.75, first), ("second", 0.5, second)):
        version, steps = session.snapshot.target + 1, session.snapshot.steps
        session.set_target(image(value), version, go_back=name, exact=True)
        np.testing.assert_array_equal(rests(session, version), vertices)
        assert session.snapshot.steps == steps
    session.set_target(image(0.3), 9)  # it still follows
    assert rests(session, 9)[0, 0] == pytest.approx(0.3)


def test_undo_goes_on_with_an_older_movement(fake):
    session = fake.session
    fake.sculptor.seconds = 0.002
    session.set_target(image(0.5), 1)
    eventually(lambda: session.snapshot.target == 1 and session.status.phase == "moving")
    session.keep("moving")
    session.set_target(image(0.2), 2)
    rests(session, 2)
    session.set_target(image(0.5), 3, go_back="moving", exact=True)
    eventually(lambda: session.snapshot.target == 3)
    assert session.snapshot.vertices[0, 0] == pytest.approx(0.5)
    steps = rests(session, 3)[0, 1]
    assert 60 <= steps <= 75  # as many as without the second target


def test_undo_follows_when_the_image_is_another_one(fake):
    session = fake.session
    session.keep("first")
    session.set_target(image(0.5), 1)
    rests(session, 1)
    session.set_target(image(0.4), 2, go_back="first", exact=False)
    assert rests(session, 2)[0, 0] == pytest.approx(0.4)


def test_undo_of_a_stroke_that_came_before_the_last_one_was_followed(fake):
    session, sculptor = fake.session, fake.sculptor
    sculptor.hold = threading.Event()
    session.set_target(image(0.6), 1)
    eventually(lambda: session.status.phase == "moving")
    session.set_target(image(0.5), 2)  # not taken during the step that is held
    session.keep("not followed yet")
    session.set_target(image(0.2), 3)
    sculptor.hold.set()
    rests(session, 3)
    session.set_target(image(0.5), 4, go_back="not followed yet", exact=True)
    assert rests(session, 4)[0, 0] == pytest.approx(0.5)


def test_undo_beyond_the_history_follows_the_painting(fake):
    session = fake.session
    session._history = MeshHistory(most_states=2)
    for k in range(1, 5):
        session.keep(k)
        session.set_target(image(0.1 * k), k)
        rests(session, k)
    assert session._history.get(2) is None and session._history.get(3) is not None
    session.set_target(image(0.1), 5, go_back=2, exact=True)
    assert rests(session, 5)[0, 0] == pytest.approx(0.1)


def test_undo_works_after_a_failure(fake):
    session = fake.session
    first = session.snapshot.vertices
    session.keep("first")
    session.set_target(image(0.5), 1)
    rests(session, 1)
    fake.sculptor.failure = RuntimeError("out of luck")
    session.set_target(image(0.4), 2)
    eventually(lambda: session.status.phase == "failed")
    for _ in range(10_000):
        session.keep("never taken")  # in bounded memory
    session.set_target(image(0.75), 3, go_back="first", exact=True)
    session.restart()
    eventually(lambda: len(fake.sculptors) == 2)
    assert rests(session, 3)[0, 0] == pytest.approx(0.75)
    assert (session.snapshot.vertices[1:] == first[1:]).all()


def mesh(numbers: int) -> KeptMesh:
    return KeptMesh(ModellerState({"u": np.zeros(numbers, np.float32)}, False, 0.0, 0, 0, 0.0), True)


def test_histories_are_bounded():
    history = MeshHistory(most_bytes=1000, most_states=5)
    shared = mesh(100)
    for k in range(4):
        history.put(k, shared)
    assert history.bytes == 400 and history.get(0) is shared
    for k in range(4, 7):
        history.put(k, mesh(50))
    assert history.get(1) is None and history.get(2) is shared and history.bytes == 1000
    history.put("large", mesh(200))
    assert history.bytes <= 1000 and history.get("large") is not None and history.get(3) is None
    history.put("too large", mesh(300))
    assert history.get("too large") is None and history.bytes == 0


def test_strokes_leave_no_scars(variant):
    """A horn and an ear are painted and undone, some of it while the mesh still moves."""
    pytest.importorskip("starlette", reason="Starlette is not installed: pip install '.[interactive]'")
    import asyncio

    from shadowmap_dr.interactive.connections import Connections
    from shadowmap_dr.interactive.messages import Stroke

    view = shadow_view(size=48)
    session = Session(
        lambda: Modeller(Sculptor(*even_sphere(8, 0.9), [view], map_resolution=48, filter_size=3, consistency=0.02))
    )
    session.start()
    board = Connections(session, view, "ball")
    client = type("Page", (), {"number": 0, "seq": 0})()

    def stroke(number: int, *points: float) -> None:
        line = np.reshape(np.array(points, float), (-1, 2))
        asyncio.run(board._handle(client, Stroke(number, number, "add", 3.0, line)))

    def command(name: str) -> np.ndarray:
        asyncio.run(board._handle(client, name))
        return rests(session, board.canvas.version)

    try:
        first = session.snapshot.vertices
        stroke(1, 24, 10, 24, 3)
        stroke(1, 24, 3, 24, 1)
        horn = rests(session, board.canvas.version)
        assert horn[:, 1].max() > first[:, 1].max() + 0.2
        stroke(2, 30, 24, 42, 24)
        ear = rests(session, board.canvas.version)
        assert ear[:, 0].max() > first[:, 0].max() + 0.2
        np.testing.assert_array_equal(command("undo"), horn)
        np.testing.assert_array_equal(command("undo"), first)
        np.testing.assert_array_equal(command("redo"), horn)
        np.testing.assert_array_equal(command("redo"), ear)
        assert command("reset")[:, 0].max() < first[:, 0].max() + 0.05
        np.testing.assert_array_equal(command("undo"), ear)
        np.testing.assert_array_equal(command("undo"), horn)
        stroke(3, 18, 24, 6, 24)  # undone at once
        np.testing.assert_array_equal(command("undo"), horn)
    finally:
        session.close()
