"""The tests notice when the renderer is broken."""

from __future__ import annotations

from mutations import MUTATIONS, check_all


def test_each_mutation_makes_its_named_test_fail() -> None:
    verdicts = check_all()
    assert len(verdicts) == 1 + len(MUTATIONS)
    missed = [f"{verdict.name}: {verdict.detail}" for verdict in verdicts if not verdict.noticed]
    assert not missed, "; ".join(missed)
