"""Limit of the messages that a page may send in a second."""

from __future__ import annotations


class RateLimit:
    """Allows a number of messages a second on average, and some more at once.

    Args:
        rate: messages a second.
        burst: messages that may arrive at once after a pause.
    """

    def __init__(self, rate: float, burst: int) -> None:
        self._interval, self._ahead = 1 / rate, burst / rate
        self._due = float("-inf")

    def delay(self, now: float) -> float:
        """Count a message. Returns the seconds to wait before it is handled, 0 within the limit.

        Args:
            now: seconds on a clock that never goes back.
        """
        self._due = max(self._due, now - self._ahead) + self._interval
        return max(self._due - now, 0.0)
