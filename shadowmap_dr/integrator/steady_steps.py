"""Loops whose steps are worth a recording: the same passes again and again, with other numbers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

# Steps of a kind that are rendered as they are, before the next ones are recorded: until then Mitsuba's arrays and the fits of
# the maps change their kind, and short loops need no recording.
_FIRST = 4
# Recordings beyond which a scene is not recorded any more, unless each has been replayed so often in the mean.
_RECORDINGS, _REPLAYS = 8, 8


class SteadySteps:
    """Counts the steps of each kind, for parameter values that recordings do not see.

    Args:
        values: these values. Other values begin a new count.
    """

    def __init__(self, values: object = None) -> None:
        self.values = values
        self._counts: Counter[Hashable] = Counter()
        self._replays = 0
        self._refused = False

    def note(self, kind: Hashable, recordings: int) -> bool:
        """Count a step of a kind. True if it is to be replayed. ``recordings``: made so far."""
        self._counts[kind] += 1
        self._refused |= recordings > _RECORDINGS + self._replays // _REPLAYS
        replay = self.is_replayed(kind)
        self._replays += replay
        return replay

    def is_replayed(self, kind: Hashable) -> bool:
        """True if the last step of a kind was replayed."""
        return not self._refused and self._counts[kind] > _FIRST

    def refuse(self) -> None:
        """Record no more."""
        self._refused = True
