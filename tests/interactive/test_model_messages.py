"""Messages between pages and server."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from shadowmap_dr.interactive import Canvas, Snapshot, messages

STROKE = {"type": "stroke", "id": 3, "seq": 7, "mode": "add", "radius": 4.5, "points": [1, 2, 3.5, 4]}


def test_strokes_are_understood():
    stroke = messages.parse(json.dumps(STROKE), (20, 30))
    assert (stroke.id, stroke.seq, stroke.mode, stroke.radius) == (3, 7, "add", 4.5)
    np.testing.assert_array_equal(stroke.points, [[1, 2], [3.5, 4]])
    assert messages.parse('{"type": "seen", "frame": 5}', (20, 30)).frame == 5
    for command in ("undo", "redo", "clear", "reset", "restart"):
        assert messages.parse(json.dumps({"type": command}), (20, 30)) == command


def test_choices_are_understood():
    for kind in ("mesh", "target"):
        choice = messages.parse(json.dumps({"type": kind, "name": "spot"}), (20, 30))
        assert (choice.kind, choice.name) == (kind, "spot")
        for name in (None, 3, ["spot"], "x" * 201):
            with pytest.raises(messages.MessageError, match="without a name"):
                messages.parse(json.dumps({"type": kind, "name": name}), (20, 30))
    assert messages.parse(json.dumps(STROKE), (20, 30)).mesh is None
    assert messages.parse(json.dumps({**STROKE, "mesh": 2}), (20, 30)).mesh == 2


@pytest.mark.parametrize("change", [
    {"type": "open"}, {"type": None}, {"type": ["undo"]}, {"mode": "smear"}, {"mode": ["add"]}, {"radius": 0}, {"radius": 31},
    {"radius": "4"}, {"radius": True}, {"radius": None}, {"radius": float("nan")}, {"points": []}, {"points": [1, 2, 3]},
    {"points": {"0": 1}}, {"points": [1, "2"]}, {"points": [1, None]}, {"points": [1, float("inf")]}, {"points": [1, 1e9]},
    {"points": [1, 10**400]}, {"points": [0] * 1026}, {"points": [[1, 2]]}, {"id": -1}, {"id": 1.5}, {"id": "x"}, {"id": 2**31},
    {"seq": None}, {"seq": True}, {"mesh": -1}, {"mesh": "spot"}, {"mesh": None},
])  # fmt: skip
def test_other_strokes_are_refused(change):
    with pytest.raises(messages.MessageError):
        messages.parse(json.dumps({**STROKE, **change}), (20, 30))


@pytest.mark.parametrize("text", ["", "undo", "[]", "3", "null", '"undo"', "{", "[" * 16_000, "{}" + " " * 20_000,
                                  '{"type": "seen"}', '{"type": "seen", "frame": "1"}'])  # fmt: skip
def test_texts_that_say_nothing_are_refused(text):
    with pytest.raises(messages.MessageError):
        messages.parse(text, (20, 30))


def test_records_hold_what_pages_read():
    vertices = np.arange(12, dtype=np.float32).reshape(4, 3)
    shadow = np.arange(6, dtype=np.uint8).reshape(2, 3)
    record = messages.frame(Snapshot(5, 77, 3, 0.5, 20.0, vertices, shadow))
    assert struct.unpack_from("<4I2fI", record) == (2, 5, 77, 3, 0.5, 20.0, 4)
    np.testing.assert_array_equal(np.frombuffer(record, "<f4", 12, 28), vertices.ravel())
    assert record[28 + 48 :] == shadow.tobytes()
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    record = messages.faces(faces)
    assert struct.unpack("<8I", record) == (1, 2, *faces.ravel())
    canvas = Canvas(np.ones((2, 3)))
    canvas.stroke("a", "add", 1, [(0.5, 0.5)])
    record = messages.target(canvas, 9)
    assert struct.unpack_from("<5I", record) == (3, 1, 9, 1, 0)
    assert record[20:] == canvas.pixels().tobytes()
