"""Numbers in tables."""

from __future__ import annotations

import math

import numpy as np


def number(value: float | None, digits: int) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def time(seconds: float) -> str:
    return f"{two_digits(seconds)} s" if seconds >= 1 else f"{two_digits(1e3 * seconds)} ms"


def two_digits(value: float) -> str:
    """Two digits, as 0.32, 1.1 and 31."""
    return f"{value:.{max(0, 1 - math.floor(math.log10(value)))}f}"
