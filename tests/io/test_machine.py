"""First entries of records."""

from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np

from shadowmap_dr import __version__
from shadowmap_dr.io.machine import header


def test_records_begin_with_version_machine_and_settings(variant: str) -> None:
    found = header({"out": Path("here"), "sizes": (1, 2), "share": np.float32(0.5), "rate": float("nan")})
    assert list(found) == ["shadowmap_dr", "machine", "settings"] and found["shadowmap_dr"] == __version__
    assert found["settings"] == {"out": "here", "sizes": [1, 2], "share": 0.5, "rate": None}
    assert found["machine"]["variant"] == variant and found["machine"]["mitsuba"] == mi.__version__
    assert json.loads(json.dumps(found)) == found
