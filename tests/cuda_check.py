"""The checks that matter most on a GPU: tests in ``cuda_ad_rgb``, and times of steps beside the paper's.

    python -m tests.cuda_check [--out FOLDER] [--processes N]

Writes ``cuda.json`` and the records of tests (``junit.xml``) and steps (``steps.json``) into FOLDER, and prints a table. Where
there is no NVIDIA GPU it says so in one line. Exit status 1 if a test fails.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import shadowmap_dr  # noqa: F401  chooses the LLVM library

# isort: split
import drjit as dr

VARIANT = "cuda_ad_rgb"
TESTS = ("raster", "shadow", "scene", "rendering", "integrator", "torch", "jit")
#: Milliseconds of a step with shadows that Worchel and Alexa (2023) give, by pixels a side.
PAPER = {128: 14.0, 512: 23.0, 1024: 46.0}
_STEPS = "import sys; from shadowmap_dr.cli.main import main; main()"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("cuda-check"), help="folder for the records [cuda-check]")
    parser.add_argument("--processes", type=int, default=min(14, os.cpu_count() or 1), help="of tests, at once")
    options = parser.parse_args()
    if not dr.has_backend(dr.JitBackend.CUDA):
        print("No NVIDIA GPU that Dr.Jit can use: nothing was checked.")
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    tests = run_tests(options.out / "junit.xml", options.processes)
    steps = run_steps(options.out / "steps.json")
    record = {"variant": VARIANT, "cuda": list(dr.detail.cuda_version()), "tests": tests, "steps": steps}
    (options.out / "cuda.json").write_text(json.dumps(record, indent=2) + "\n")
    print(table(tests, steps))
    return 1 if tests["failed"] else 0


def run_tests(report: Path, processes: int) -> dict[str, Any]:
    """Counts of tests, and the names of those that failed."""
    root = Path(__file__).resolve().parent
    command = [sys.executable, "-m", "pytest", "-q", "-n", str(processes), "-k", VARIANT, f"--junitxml={report.resolve()}"]
    subprocess.run([*command, *(str(root / name) for name in TESTS)], cwd=root.parent, check=False)
    if not report.is_file():
        return {"run": 0, "failed": ["pytest itself: see above"]}
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    failed = [
        f"{case.get('classname')}::{case.get('name')}" for case in cases if {part.tag for part in case} & {"failure", "error"}
    ]
    skipped = sum(any(part.tag == "skipped" for part in case) for case in cases)
    return {"run": len(cases) - skipped, "skipped": skipped, "failed": failed}


def run_steps(record: Path) -> dict[str, Any]:
    """Milliseconds of steps by pixels a side: with shadows, without, and Mitsuba's projective integrator."""
    arguments = ["bench", "--only", "steps", "--variant", VARIANT, "--mitsuba-seconds", "20", "--out", str(record)]
    subprocess.run([sys.executable, "-c", _STEPS, *arguments], check=False)
    if not record.is_file():
        return {}
    units = json.loads(record.read_text())["sections"]["steps"]["units"]
    return {
        str(unit["resolution"]): {name: 1e3 * times["median"] for name, times in unit["seconds"].items()}
        for name, unit in units.items()
        if name.startswith("step-")
    }


def table(tests: dict[str, Any], steps: dict[str, Any]) -> str:
    """Markdown."""
    lines = [f"{tests['run']} tests in {VARIANT}, {len(tests['failed'])} failed", *tests["failed"], ""]
    lines += ["| pixels | ours | without shadows | Mitsuba | the paper |", "|---|---|---|---|---|"]
    for size, paper in PAPER.items():
        times = steps.get(str(size), {})
        cells = [f"{times[name]:.2f} ms" if name in times else "-" for name in ("shadows", "rasterizer", "mitsuba")]
        lines.append(f"| {size} | {' | '.join(cells)} | {paper:.0f} ms |")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
