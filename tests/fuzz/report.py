"""Reports about cases: a line of progress, a table of counts, a record."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from .kinds import KINDS, Case
from .outcome import FAULT, REFUSED, RESULT, Outcome

#: Seconds between two lines of progress.
INTERVAL = 5.0


class Report:
    """Counts of outcomes by kind of case, and all faults."""

    def __init__(self, total: int, quiet: bool = False) -> None:
        self.total, self.quiet = total, quiet
        self.counts: Counter[tuple[str, str]] = Counter()
        self.faults: list[tuple[Case, Outcome]] = []
        self.seconds: Counter[str] = Counter()
        self._began = self._last = time.monotonic()

    def add(self, case: Case, outcome: Outcome) -> None:
        """Count a case."""
        self.counts[case.kind, outcome.kind] += 1
        self.seconds[case.kind] += outcome.seconds  # type: ignore[assignment]
        if outcome.kind == FAULT:
            self.faults.append((case, outcome))
            self._say(f"{fault_line(case, outcome)}")
        self._now = case.kind

    def look(self) -> None:
        """Print a line of progress if the last one was some seconds ago."""
        now = time.monotonic()
        if now - self._last >= INTERVAL:
            self._last = now
            done = self.counts.total()
            self._say(f"{done} of {self.total} cases, {len(self.faults)} faults, {now - self._began:.0f} s")

    def table(self) -> str:
        """Markdown."""
        outcomes = (RESULT, REFUSED, FAULT)
        lines = ["| kind | cases | result | refused | fault | seconds |", "|---|---|---|---|---|---|"]
        for name in [*KINDS, "all"]:
            of = [
                sum(n for (kind, o), n in self.counts.items() if o == outcome and name in (kind, "all")) for outcome in outcomes
            ]
            seconds = sum(s for kind, s in self.seconds.items() if name in (kind, "all"))
            if sum(of):
                lines.append(f"| {name} | {sum(of)} | {' | '.join(map(str, of))} | {seconds:.0f} |")
        return "\n".join(lines)

    def record(self, command: Sequence[str]) -> dict[str, Any]:
        """All counts and faults as JSON values."""
        kinds = {kind for kind, _ in self.counts}
        return {
            "command": " ".join(command),
            "counts": {kind: {o: self.counts[kind, o] for o in (RESULT, REFUSED, FAULT)} for kind in KINDS if kind in kinds},
            "faults": [
                {"kind": case.kind, "case": case.number, "seed": case.seed, "text": outcome.text, "command": case.command}
                for case, outcome in self.faults
            ],
            "seconds": round(time.monotonic() - self._began, 1),
        }

    def _say(self, line: str) -> None:
        if not self.quiet:
            print(line, file=sys.stderr, flush=True)


def fault_line(case: Case, outcome: Outcome) -> str:
    """A fault, and the command that runs it again."""
    return f"fault: {case.kind} {case.number}: {outcome.text}\n    {case.command}"
