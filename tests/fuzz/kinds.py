"""The kinds of cases."""

from __future__ import annotations

import importlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: Function of a kind: makes and tries one case. Returns a few words about the right result.
Run = Callable[[np.random.Generator, Path], str]


@dataclass(frozen=True)
class Kind:
    """A kind of cases.

    Attributes:
        share: relative number of cases.
        seconds: time budget of a case.
        megabytes: memory budget of a case.
        needs: package without which the kind is left out.
        slow: cases take seconds each: the test suite has none of them.
    """

    share: int
    seconds: float = 30.0
    megabytes: float = 2000.0
    needs: str = ""
    slow: bool = False


#: Kinds by the name of their module, which has a function ``run`` (see `Run`).
KINDS = {
    "meshes": Kind(16),
    "tensors": Kind(12, needs="torch"),
    "files": Kind(22),
    "models": Kind(14),
    "pictures": Kind(18),
    "scenes": Kind(8, seconds=60.0),
    "changes": Kind(8, seconds=60.0),
    "sculpting": Kind(4, seconds=60.0, needs="cholespy"),
    "options": Kind(12, seconds=60.0),
    "records": Kind(12),
    "runs": Kind(4, seconds=120.0, slow=True),
    "messages": Kind(10, needs="starlette"),
}


@dataclass(frozen=True)
class Case:
    """A case: its kind, its number, and the seed of the run."""

    kind: str
    number: int
    seed: int

    @property
    def generator(self) -> np.random.Generator:
        """Random numbers of this case alone."""
        return np.random.default_rng([self.seed, zlib.crc32(self.kind.encode()), self.number])

    @property
    def command(self) -> str:
        """Command that runs this case again."""
        return f"python -m tests.fuzz --seed {self.seed} --kind {self.kind} --case {self.number}"

    def load(self) -> Run:
        """Import the function of the kind."""
        run: Run = importlib.import_module(f"{__package__}.{self.kind}").run
        return run


def spread(count: int, seed: int, names: list[str]) -> list[Case]:
    """``count`` cases of the kinds ``names``, in proportion to their shares."""
    total = sum(KINDS[name].share for name in names)
    ends = np.cumsum([0, *(KINDS[name].share for name in names)]) * count // total
    return [Case(name, k, seed) for name, a, b in zip(names, ends[:-1], ends[1:], strict=True) for k in range(int(b - a))]
