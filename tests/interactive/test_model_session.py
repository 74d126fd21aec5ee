"""The optimiser's thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from model_fakes import SIZE, FakeSculptor, FakeSession, eventually

from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.interactive import Modeller, Session
from shadowmap_dr.interactive.modeller import MOST_STEPS, PATIENCE
from shadowmap_dr.inverse import Sculptor, even_sphere, shadow_view


@pytest.fixture
def fake() -> Iterator[FakeSession]:
    pytest.importorskip("cholespy")
    session = FakeSession()
    session.session.start()
    yield session
    session.session.close()


def image(value):
    return np.full((SIZE, SIZE), value, np.float32)


def test_sessions_begin_at_rest(fake):
    time.sleep(0.05)
    assert fake.session.status.phase == "resting" and fake.sculptor.steps == 0
    first = fake.session.snapshot
    assert first.number == 1 and first.steps == 0 and (first.shadow == 191).all()
    np.testing.assert_array_equal(fake.session.faces, fake.sculptor.faces)


def test_the_newest_target_wins(fake):
    fake.sculptor.hold = threading.Event()
    fake.session.set_target(image(0.1), 1)
    eventually(lambda: fake.session.status.phase == "moving")
    began = time.monotonic()
    for version in range(2, 40):
        fake.session.set_target(image(version / 40), version)
    assert time.monotonic() - began < 1  # nobody waits for the step that is under way
    fake.sculptor.hold.set()
    eventually(lambda: fake.session.status.phase == "resting")
    last = fake.session.snapshot
    assert last.target == 39 and last.vertices[0, 0] == pytest.approx(39 / 40)
    assert PATIENCE <= fake.sculptor.steps <= PATIENCE + 10  # the loss does not fall: it comes to rest
    assert fake.sculptor.calmed == 1 and last.speed == 0


def test_snapshots_are_announced_and_never_go_back(fake):
    numbers = []
    fake.session.on_change = lambda: numbers.append(fake.session.snapshot.number)
    fake.session.set_target(image(0.5), 1)
    eventually(lambda: fake.session.status.phase == "resting" and fake.session.snapshot.target == 1)
    assert numbers == sorted(numbers) and numbers[-1] == fake.session.snapshot.number > 1


def test_failures_are_told_and_overcome(fake):
    fake.session.set_target(image(0.5), 1)
    eventually(lambda: fake.session.snapshot.target == 1 and fake.session.status.phase == "resting")
    good = fake.session.snapshot
    fake.sculptor.failure = RuntimeError("out of luck\nand memory")
    fake.session.set_target(image(0.6), 2)
    eventually(lambda: fake.session.status.phase == "failed")
    assert fake.session.status.message == "RuntimeError: out of luck and memory"
    assert fake.session.snapshot is good
    fake.session.set_target(image(0.25), 3)  # painted on meanwhile
    time.sleep(0.05)
    assert fake.session.status.phase == "failed" and len(fake.sculptors) == 1
    fake.session.restart()
    eventually(lambda: fake.session.status.phase == "resting" and len(fake.sculptors) == 2)
    last = fake.session.snapshot
    assert last.target == 3 and last.vertices[0, 0] == pytest.approx(0.25) and last.number > good.number
    fake.session.restart()  # nothing has failed
    time.sleep(0.02)
    assert len(fake.sculptors) == 2


def test_a_mesh_that_always_fails_is_given_up_for_the_first_one():
    built = []

    def build():
        sculptor = FakeSculptor()
        sculptor.failure = RuntimeError("again") if len(built) in (1, 2) else None
        sculptor.began = []
        before = sculptor.reset
        sculptor.reset = lambda vertices=None: (sculptor.began.append(vertices), before(vertices))
        built.append(sculptor)
        return Modeller(sculptor)

    session = Session(build)
    session.start()
    session.set_target(image(0.5), 1)
    eventually(lambda: session.status.phase == "resting" and session.snapshot.target == 1)
    built[0].failure = RuntimeError("first")
    session.set_target(image(0.6), 2)
    for count in (1, 2, 3):
        eventually(lambda: session.status.phase == "failed")
        session.restart()
        eventually(lambda: len(built) == count + 1 and session.status.phase in ("failed", "resting"))  # noqa: B023
    session.close()
    assert session.snapshot.target == 2
    # The first restart takes up the last mesh; that fails at once, so the next ones begin at the beginning.
    assert built[1].began[0][0, 0] == 0.5 and built[2].began == [] and built[3].began == []


def test_lost_meshes_are_failures_and_not_shown(fake):
    good = fake.session.snapshot
    fake.sculptor._now[:] = np.nan
    fake.session.set_target(image(0.5), 1)
    eventually(lambda: fake.session.status.phase == "failed")
    assert "not finite" in fake.session.status.message and fake.session.snapshot is good


def test_lost_losses_are_failures(fake):
    modeller = Modeller(fake.sculptor)
    fake.sculptor.step = lambda: np.array([np.nan])
    modeller.wake()
    with pytest.raises(ShadowmapError, match="not finite"):
        for _ in range(10):
            modeller.step()


def test_resetting_goes_back_to_the_first_mesh(fake):
    fake.session.set_target(image(0.5), 1)
    eventually(lambda: fake.session.snapshot.vertices[0, 0] == 0.5)
    resets = []
    fake.sculptor.reset = lambda vertices=None: resets.append(vertices)
    fake.session.reset()
    eventually(lambda: resets == [None])


def test_what_cannot_be_built_is_told_at_once():
    def build():
        raise ShadowmapError("no such mesh.")

    session = Session(build)
    with pytest.raises(ShadowmapError, match="no such mesh"):
        session.start()
    assert session.status.phase == "closed"


def test_sculptors_in_a_session_follow_and_rest(variant):
    vertices, faces = even_sphere(8, 0.9)
    view = shadow_view(size=48)
    session = Session(lambda: Modeller(Sculptor(vertices, faces, [view], map_resolution=48, filter_size=3, consistency=0.02)))
    session.start()
    try:
        wanted = session.snapshot.shadow / 255
        wanted[20:28, 24:42] = 0  # a nose
        session.set_target(wanted, 1)
        eventually(lambda: session.snapshot.target == 1 and session.status.phase == "resting", 60)
        last = session.snapshot
        dark, goal = last.shadow < 128, wanted < 0.5
        assert (dark & goal).sum() / (dark | goal).sum() > 0.93
        assert last.vertices[:, 0].max() > 1.3 and np.abs(last.vertices[:, 1]).max() < 1.05
        assert PATIENCE <= last.steps <= MOST_STEPS and last.loss > 0
    finally:
        session.close()
    assert session.status.phase == "closed"
