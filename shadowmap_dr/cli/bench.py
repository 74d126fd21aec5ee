"""The command `shadowmap-dr bench`: times and memory, beside Mitsuba and Embree."""

from __future__ import annotations

from dataclasses import replace

from ..errors import ShadowmapError
from ..experiments.bench import common as bench_common
from ..experiments.bench import experiment as bench_experiment
from ..experiments.bench import report as bench_report
from ..io import console
from ..variants import COLOURED, DEFAULT_VARIANT, set_variant
from .options import Variant, from_record


@from_record()
def bench(options: bench_common.BenchOptions, variant: Variant = DEFAULT_VARIANT) -> None:
    """Measure times of steps and rasterization, growth of costs, and profiles, beside Mitsuba and Embree.

    Writes a JSON file, a plot, and a folder of meshes and reference images. The file keeps sections that are not measured.
    """
    options = replace(options, only=tuple(dict.fromkeys(options.only)))
    set_variant(variant, COLOURED)
    record = bench_experiment.run_bench(options)
    console.show(bench_report.table(record))
    console.result(options.out.with_suffix(".png"), options.out)
    failed = bench_experiment.failures(record, options.only)
    if failed:
        raise ShadowmapError(f"{len(failed)} part(s) could not be measured; the first: {failed[0]}")
