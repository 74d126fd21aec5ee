"""Slices through the loss of a pose: the loss between the end of a run and the target.

``python -m shadowmap_dr.experiments.pose.landscape FOLDER --object hand --run 0 --out FILE.png`` draws the loss over the
rotation for a run whose record and reference image lie in a folder of the pose experiment.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ...errors import ShadowmapError
from ...io import images, plot_style
from ...io import records as io_records
from ...variants import DEFAULT_VARIANT
from .methods import METHODS, build_method
from .record import runs_in
from .scene import make_problem

Render = Callable[[npt.NDArray[np.float64]], npt.NDArray[Any]]
#: Step of central differences for the offset, and longest step of the offset, in scene units.
_DIFFERENCE, _LONGEST = 0.01, 0.05


def slices(
    render: Render, reference: npt.ArrayLike, angles: npt.ArrayLike, end: npt.ArrayLike, steps: int = 3
) -> dict[str, npt.NDArray[np.float64]]:
    """Loss over the rotation along three lines of offsets.

    Args:
        render: image (H, W, C) at (rotation in radians, x, y).
        reference: image to be matched.
        angles: (N,) rotations in radians, in order.
        end: (3,) pose at the end of a run.
        steps: Gauss-Newton steps for the best offset at each angle, from the best offset at the previous angle.

    Returns:
        (N,) mean squared differences: `target` with the offset zero, `end` with the offset at the end of the run, `best` with
        the best offset (of these two and of searches from both ends of the range); and `best_offset`, (N, 2).
    """
    reference, angles, end = (np.asarray(value, np.float64) for value in (reference, angles, end))

    def loss(pose: npt.NDArray[np.float64]) -> float:
        return float(np.mean((render(pose) - reference) ** 2))

    lines = {"target": np.zeros((len(angles), 2)), "end": np.tile(end[1:], (len(angles), 1))}
    result = {
        name: np.array([loss(np.array([angle, *offset])) for angle, offset in zip(angles, offsets, strict=True)])
        for name, offsets in lines.items()
    }
    best = np.minimum(result["target"], result["end"])
    where = np.where((result["target"] <= result["end"])[:, None], lines["target"], lines["end"])
    for order in (range(len(angles)), range(len(angles) - 1, -1, -1)):
        offset = where[order[0]]
        for i in order:
            found, value = _best_offset(render, reference, angles[i], offset, steps, loss)
            if value < best[i]:
                best[i], where[i] = value, found
            offset = where[i].copy()
    return {**result, "best": best, "best_offset": where}


def _best_offset(
    render: Render,
    reference: npt.NDArray[np.float64],
    angle: float,
    offset: npt.NDArray[np.float64],
    steps: int,
    loss: Callable[[npt.NDArray[np.float64]], float],
) -> tuple[npt.NDArray[np.float64], float]:
    """Offset and loss after Gauss-Newton steps at a fixed angle."""
    best = offset, loss(np.array([angle, *offset]))
    for _ in range(steps):
        pose = np.array([angle, *offset])
        residual = (render(pose) - reference).ravel()
        columns = [
            (render(pose + move) - render(pose - move)).ravel() / (2 * _DIFFERENCE) for move in _DIFFERENCE * np.eye(3)[1:]
        ]
        change = np.linalg.lstsq(np.stack(columns, axis=1), -residual, rcond=None)[0]
        offset = offset + change * min(1.0, _LONGEST / max(float(np.hypot(*change)), 1e-12))
        value = loss(np.array([angle, *offset]))
        if value >= best[1]:
            break
        best = offset, value
    return best


def plot_slices(
    path: str | os.PathLike[str], title: str, angles: npt.ArrayLike, lines: Mapping[str, npt.ArrayLike], record: Mapping[str, Any]
) -> None:
    """Draw the slices with the path of a run, and the run's errors over its steps."""
    labels = {"target": "offset zero", "end": "offset at the end of the run", "best": "best offset"}
    rotation, losses = np.asarray(record["rotation_error_curve"], np.float64), np.asarray(record["loss_curve"], np.float64)
    side = np.sign(record["start"][0])
    with plot_style.drawn(path, 11, 4.2, dpi=110) as figure:
        left, right = figure.subplots(1, 2)
        for k, (name, label) in enumerate(labels.items()):
            left.plot(np.degrees(angles), lines[name], color=plot_style.colour(k), linestyle=("-", "--", "-.")[k], label=label)
        run, end = side * rotation[: len(losses)], np.degrees(record["final"][0])
        left.plot(run, losses, "k.", markersize=3, label="steps of the run, on the side of its start")
        left.plot(end, losses[-1], "kx", markersize=8, label="end of the run")
        left.set(xlabel="rotation [degrees]", ylabel="loss (mean squared difference)", yscale="log", title=title)
        left.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
        offset = np.asarray(record["translation_error_curve"], np.float64)
        curves = {"rotation error [degrees]": rotation, "offset error [units / 100]": offset}
        ends = []
        for k, (label, curve) in enumerate(curves.items()):
            right.plot(curve, color=plot_style.COLOURS[3 + k])
            ends.append((float(curve[-1]), label.replace(" [", "\n["), plot_style.COLOURS[3 + k]))
        right.set(xlabel="step", ylabel="error", yscale="log", title="errors of the run")
        plot_style.label_ends(right, ends)


def landscape(
    folder: Path, wanted: Mapping[str, Any], out: Path, *, renderer: str | None = None, width_deg: float = 35.0, count: int = 71
) -> dict[str, Any]:
    """Draw the slices for the record in a folder that matches `wanted` (object, resolution, method, run, ...).

    `renderer`: method that renders the images, by default the run's own (Mitsuba's is slow and noisy).
    Returns angles in degrees and the slices. Raises ShadowmapError if there is no such record or no reference image.
    """
    records = runs_in(io_records.read_json(folder / "pose.json"))
    if records is None:
        raise ShadowmapError(f"{folder / 'pose.json'} is no list of records: give a folder of the pose experiment.")
    record = next((entry for entry in records if all(entry.get(key) == value for key, value in wanted.items())), None)
    if record is None:
        raise ShadowmapError(f"{folder / 'pose.json'} has no run with " + ", ".join(f"{k} {v}" for k, v in wanted.items()) + ".")
    copy = folder / "objects" / f"{record['object']}.ply"  # scaled copy of a user's mesh file
    problem = make_problem(
        record["object"],
        record["resolution"],
        shadow_only=record["shadow_only"],
        normals=record.get("normals", "face"),
        work=folder / "objects",
        scaled=copy if copy.exists() else None,
    )
    if problem.digest != record["settings"].get("object_digest", problem.digest):
        raise ShadowmapError(f"the object {record['object']} is not the one of the run any more: run it again.")
    name = "reference.exr" if record["reference"] == "mitsuba" else "reference-own.exr"
    reference = images.read_image(folder / problem.folder / name)
    renderer = renderer or record["method"]
    method = build_method(renderer, problem, reference, record["settings"].get("samples_per_pixel", 1))
    angles = np.radians(np.linspace(-width_deg, width_deg, count))
    lines = slices(method.render, reference, angles, record["final"])
    title = f"{problem.folder}, {record['method']}, run {record['run']}"
    plot_slices(out, title + (f" (lines: {renderer})" if renderer != record["method"] else ""), angles, lines, record)
    return {"angles_deg": np.degrees(angles), **lines}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m shadowmap_dr.experiments.pose.landscape", description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="results of the pose experiment")
    parser.add_argument("--object", default="spot")
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--method", choices=METHODS, default="shadows")
    parser.add_argument("--renderer", choices=METHODS, help="whose images make the loss, if not the method's own")
    parser.add_argument("--run", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("landscape.png"), help="picture to write")
    options = parser.parse_args()
    mi.set_variant(DEFAULT_VARIANT)
    wanted = {key: getattr(options, key) for key in ("object", "resolution", "method", "run")}
    try:
        landscape(options.folder, wanted, options.out, renderer=options.renderer)
    except ShadowmapError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
