"""Runs of pose estimation as problems of a sweep, for the workers of a scheduler."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...inverse import Method, Problem
from ...io import images
from .methods import Builder, Image, searching
from .record import identity, make_record
from .scene import NormalKind, PoseProblem, ReferenceKind, make_problem, path_traced_reference
from .search import Search


@dataclass(frozen=True)
class PoseRuns(Problem):
    """Some runs with one object, one resolution and one method.

    Attributes:
        object: name of a mesh of this package, or a mesh file that workers can read.
        folder: name of the problem's folder in ``out``.
        method: one of METHODS.
        numbers: numbers of the runs, which determine their starts.
        out: folder with reference images; workers that do not see it make their own.
        resolution, iterations, seed, reference, shadow_only, normals: as in `PoseOptions`.
        search: samples, blur and tries.
    """

    object: str
    folder: str
    resolution: int
    method: str
    numbers: tuple[int, ...]
    iterations: int
    seed: int
    reference: ReferenceKind
    shadow_only: bool
    normals: NormalKind
    search: Search
    out: str

    @property
    def name(self) -> str:
        return f"{self.folder}-{self.method}"

    @property
    def runs(self) -> int:
        return len(self.numbers)

    @property
    def steps(self) -> int:
        return self.iterations

    def settings(self) -> dict[str, Any]:
        own = dataclasses.asdict(self)
        return {name: value for name, value in own.items() if name not in ("out", "numbers")}

    def run_numbers(self) -> tuple[int, ...]:
        return self.numbers

    def build(self) -> tuple[PoseProblem, Method, Image]:
        out = Path(self.out)
        problem = make_problem(
            self.object, self.resolution, shadow_only=self.shadow_only, normals=self.normals, work=out / "objects"
        )
        image = make_reference(problem, self.reference, out / self.folder, self._build)
        return problem, self._build(self.method, problem, image), image

    def _build(self, name: str, problem: PoseProblem, reference: Image) -> Method:
        return searching(self.search, self.iterations)(name, problem, reference)

    def run_batch(
        self,
        built: tuple[PoseProblem, Method, Image],
        runs: Sequence[int],
        checkpoint: Path | None,
        on_step: Callable[[int], None],
    ) -> list[dict[str, Any]]:
        problem, method, reference = built
        records = []
        for run in runs:
            wanted = identity(
                problem, self.method, run, method, seed=self.seed, iterations=self.iterations, reference=self.reference
            )
            records.append(make_record(method, reference, wanted, checkpoint, lambda _, done: on_step(done)))
        return records


def make_reference(problem: PoseProblem, kind: ReferenceKind, folder: Path, build: Builder) -> Image:
    """The reference image of a problem, also written into a folder. A path-traced image in the folder is reused."""
    if kind == "mitsuba":
        return path_traced_reference(problem, folder / "reference.exr")
    blank = np.zeros((problem.resolution, problem.resolution, 3), np.float32)
    image = build("shadows", problem, blank).render(np.zeros(3))
    images.write_image(folder / "reference-own.exr", image)
    return image
