"""The slow tests, which ``pytest -m "not slow"`` leaves out, from a measurement.

    python -m pytest -n 3 --dist loadfile --junitxml=times.xml tests
    python -m tests.slow times.xml [--above 0.15]

writes ``slow.txt``: each test function whose cases take longer than so many seconds on average, and all tests of modules in which
the first case makes the results of the others.
"""

from __future__ import annotations

import argparse
import functools
import xml.etree.ElementTree as ET
from collections import defaultdict
from pathlib import Path

LIST = Path(__file__).with_name("slow.txt")
_ABOVE = 0.15
# Modules whose cases share results.
_SHARED = ("integrator/test_broken_scenes.py", "integrator/test_gradients.py")


@functools.cache
def slow_tests() -> dict[str, float]:
    """Seconds of a case of each slow test, by its name ``folder/test_file.py::test_function``, relative to this folder."""
    lines = [line.split() for line in LIST.read_text().splitlines() if not line.startswith("#")]
    return {name: float(seconds) for name, seconds in lines}


def mean_seconds(report: Path) -> dict[str, float]:
    """Mean time of the cases of each test function in a JUnit report of pytest."""
    times = defaultdict(list)
    for case in ET.parse(report).getroot().iter("testcase"):
        if case.find("skipped") is None:
            module = case.attrib["classname"].removeprefix("tests.").replace(".", "/")
            times[f"{module}.py::{case.attrib['name'].split('[')[0]}"].append(float(case.attrib["time"]))
    return {name: sum(each) / len(each) for name, each in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.slow", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("report", type=Path, help="JUnit report of the whole suite")
    parser.add_argument("--above", type=float, default=_ABOVE, help="seconds of a case from which on its test is slow")
    options = parser.parse_args()
    times = mean_seconds(options.report)
    found = {name: seconds for name, seconds in times.items() if seconds > options.above or name.startswith(_SHARED)}
    lines = ["# Seconds of a case. Written by python -m tests.slow."]
    LIST.write_text("\n".join([*lines, *(f"{name} {seconds:.1f}" for name, seconds in sorted(found.items()))]) + "\n")
    print(f"{len(found)} slow tests are listed in {LIST}")


if __name__ == "__main__":
    main()
