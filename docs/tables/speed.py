"""Tables of times and memory."""

from __future__ import annotations

from shadowmap_dr.experiments.bench import report as bench
from shadowmap_dr.io.console import markdown

from . import formats
from .records import Lines, record


def figures() -> Lines:
    """All figures of the benchmark."""
    return markdown(bench.COLUMNS, [row.cells() for row in bench.rows(record("bench"))])


def speed() -> Lines:
    """Steps, and times to a pose."""
    units = record("bench")["sections"]["steps"]["units"]
    rows = []
    for size in (128, 512, 1024):
        step, found = units[f"step-{size}"], units[f"pose-{size}"]
        ours, none, mitsuba = (step["seconds"][name]["median"] for name in ("shadows", "rasterizer", "mitsuba"))
        setting = "fair setting" if step["mitsuba"]["fair"] else "too few samples to converge"
        own, theirs = found["methods"]["shadows"], found["methods"]["mitsuba"]
        never = "not within 300 s" if theirs["median_seconds_to_pose"] is None else formats.time(theirs["median_seconds_to_pose"])
        if size == 128:
            never += f" ({theirs['starts']} starts; ten: above)"
        rows.append(
            [
                f"{size} x {size}",
                formats.time(ours),
                formats.time(none),
                f"{formats.time(mitsuba)}, {setting}",
                f"{step['ratio_of_medians']['mitsuba / shadows']:.0f}x",
                f"{formats.two_digits(own['median_seconds_to_pose'])} s ({own['reached']} of {own['starts']})",
                never,
            ]
        )
    return markdown(
        [
            *("pixels", "step with shadows", "without", "Mitsuba's projective integrator", "ratio"),
            *("pose found (10 starts)", "by Mitsuba"),
        ],
        rows,
    )


def on_a_gpu() -> Lines:
    """Steps on a GPU. Times of the paper are quoted."""
    paper = {128: 14, 512: 23, 1024: 46}
    rows = [
        [str(size), *(f"{record('cuda/h100')['steps'][str(size)][name]:.{digits}f} ms" for name, digits in _GPU), f"{quoted} ms"]
        for size, quoted in paper.items()
    ]
    names = ["pixels a side", "ours", "without shadows", "Mitsuba's `direct_projective`, fair setting", "Worchel and Alexa's"]
    return markdown(names, rows)


_GPU = (("shadows", 2), ("rasterizer", 2), ("mitsuba", 1))


def memory() -> Lines:
    """Memory of steps, and the bytes by which `rendering.light_slices` plans."""
    units = record("bench")["sections"]["scaling"]["units"]

    def peak(kind: str, size: int) -> str:
        (point,) = (point for point in units[kind]["points"] if point["size"] == size)
        return f"{point['peak_memory'] / 2**30:.2f} GiB"

    rows = [
        ["shadow maps with derivatives", "130 bytes for each texel"],
        ["vertices and their triangles, for each light", "222 bytes for each vertex"],
        ["a step of the pose scene at 512 x 512", f"{peak('resolution', 512**2)} (whole process)"],
        ["the same at 2048 x 2048", peak("resolution", 2048**2)],
        ["1.5 million triangles", peak("triangles", 1_499_138)],
    ]
    return markdown(["What", "How much"], rows)
