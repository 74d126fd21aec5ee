"""Candidates for the starts of a fit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from shadowmap_dr.fitting.parameters import Value
from shadowmap_dr.fitting.starts import chosen, draw, groups_of, half_ranges, redraw
from shadowmap_dr.fitting.vary import Vary

RANGES = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 0.5])
LOW, HIGH = np.full(6, -np.inf), np.array([np.inf] * 5 + [0.2])


def entries(*labels: tuple[str, ...]) -> list[Any]:
    return [SimpleNamespace(labels=one) for one in labels]


def test_the_first_candidate_is_the_scene_and_others_lie_in_the_ranges() -> None:
    found = draw(RANGES, LOW, HIGH, 8, 0)
    assert len(found) == 57
    np.testing.assert_array_equal(found[0], 0)
    others = np.array(found[1:])
    assert (np.abs(others) <= RANGES).all() and others[:, 5].max() <= 0.2
    assert (np.abs(others).max(0) > 0.8 * np.minimum(RANGES, HIGH)).all()


def test_groups_are_entries_and_the_rotations_of_poses() -> None:
    pose = ("rotation x", "rotation y", "rotation z", "translation x", "translation y")
    every, turns = groups_of(entries(pose, ("value",), ("rotation y",)))
    assert [group.tolist() for group in every] == [[0, 1, 2, 3, 4], [5], [6]]
    assert [group.tolist() for group in turns] == [[0, 1, 2], [6]]


def test_redrawn_candidates_differ_from_the_best_in_one_group() -> None:
    best = np.array([1.0, -2.0, 3.0, 0.5, 0.25, 0.1])
    groups = [np.arange(5), np.arange(3), np.array([5])]
    found = redraw(best, groups, RANGES, LOW, HIGH, 30, (0, 1))
    assert len(found) == 30
    for k, x in enumerate(found):
        own = groups[k % 3]
        np.testing.assert_array_equal(np.delete(x, own), np.delete(best, own))
        assert (np.abs(x[own]) <= RANGES[own]).all() and (x[own] != best[own]).any()
    assert not np.array_equal(found[0], found[3])
    assert redraw(best, [], RANGES, LOW, HIGH, 30, (0, 1)) == []


def test_redrawn_candidates_keep_their_distance() -> None:
    best, turns = np.zeros(6), [np.arange(3)]
    distances = [
        [np.linalg.norm(x[:3] / RANGES[:3]) for x in redraw(best, turns, RANGES, LOW, HIGH, 60, (0, 1), apart=apart)]
        for apart in (0.0, 0.7)
    ]
    assert min(distances[0]) < 0.6 and min(distances[1]) >= 0.7


def test_the_best_candidates_are_chosen_and_the_scene_if_it_is_kept() -> None:
    objective: Any = SimpleNamespace(count=1, observations=[], at=lambda x: SimpleNamespace(cost=abs(float(x[0]) - 3)))
    candidates = [np.array([float(x)]) for x in (0, 1, 2, 5, 4, 3.5)]
    assert [float(x[0]) for x in chosen(candidates, objective, 3, keep=True)] == [0, 3.5, 2]
    assert [float(x[0]) for x in chosen(candidates, objective, 3, keep=False)] == [3.5, 2, 4]


def test_ranges_of_positive_values_end_at_a_factor() -> None:
    """However many tries widen them: larger factors are no numbers in single precision."""
    value = Value(Vary("a", spread=8.0), "a", np.ones(1), (0.0, np.inf), logarithmic=True)
    place = Value(Vary("a", spread=8.0), "a", np.ones(1), (-np.inf, np.inf), logarithmic=False)
    np.testing.assert_allclose(half_ranges([value, place], 2.0), [2 * np.log(8), 16])
    np.testing.assert_allclose(half_ranges([value, place], 50.0), [np.log(1e6), 400])
