"""Fair settings: the cheapest sample counts with which Mitsuba's projective pose estimation converges.

`find_fair_setting` searches for them. Results are stored in `fair_settings.json`, read by `fair_setting` and extended by
``python -m mitsuba_baselines.fair_settings --search RESOLUTION``.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from shadowmap_dr import __version__
from shadowmap_dr.errors import ShadowmapError
from shadowmap_dr.io import assets
from shadowmap_dr.io.files import atomic
from shadowmap_dr.io.machine import machine

from .pose import MitsubaPose, ProjectiveSetting, load_scene, pose_start
from .proxy import calibrate
from .reference import path_traced

STORE = Path(__file__).with_name("fair_settings.json")
MAX_RESOLUTION = 4096

# Counts that the stratified sampler takes without rounding. The noise of the shadow boundaries' derivative (sppi) limits
# convergence, since hardly any sample hits the small light: the other counts are not searched alone.
CANDIDATES = tuple(
    ProjectiveSetting(*counts)
    for counts in (
        (1, 1, 1),
        (1, 1, 4),
        (1, 1, 16),
        (1, 1, 64),
        (2, 2, 2),
        (2, 2, 8),
        (2, 2, 36),
        (4, 4, 4),
        (4, 4, 16),
        (4, 4, 64),
        (4, 4, 144),
        (4, 4, 256),
        (8, 8, 36),
        (8, 8, 64),
        (16, 16, 16),
        (16, 16, 64),
        (16, 16, 144),
        (64, 64, 64),
        (16, 16, 256),
        (4, 4, 4, "grid"),
        (4, 4, 4, "octree"),
        (16, 16, 16, "octree"),
    )
)


def fair_setting(resolution: int, normals: str = "face") -> ProjectiveSetting:
    """The stored fair setting at a resolution, with normals "face" or "vertex".

    Without a stored setting at this resolution, returns the setting at the nearest resolution, with the same number of samples in
    the whole image. Such a substitute (see `is_fair`) is rather too cheap: the proxy light has a fixed size in pixels, and the
    smaller it is, the more samples miss it.

    Raises:
        ShadowmapError: No stored search has found a setting.
    """
    found, setting = _nearest(resolution, normals)
    if found == resolution:
        return setting
    scale = (found / resolution) ** 2
    counts = {name: max(1, round(getattr(setting, name) * scale)) for name in ("sppc", "sppp", "sppi", "spp")}
    return replace(setting, **counts)


def is_fair(setting: ProjectiveSetting, resolution: int, normals: str = "face", mesh: str = "spot") -> bool:
    """True if a stored search with exactly this mesh and resolution found the setting to be the cheapest that converges."""
    return any(
        entry["setting"] == asdict(setting)
        and entry["resolution"] == resolution
        and entry.get("mesh", "spot") == mesh
        and entry.get("normals", "face") == normals
        for entry in _stored().values()
    )


def is_searched(normals: str = "face") -> bool:
    """True if a stored search has found a setting with normals "face" or "vertex", at any resolution."""
    return any(entry["setting"] and entry.get("normals", "face") == normals for entry in _stored().values())


def seconds_of_step(setting: ProjectiveSetting, resolution: int, normals: str = "face") -> tuple[float, int] | None:
    """Median seconds of a step in the runs of a stored search with a setting, and their number of threads; None without runs."""
    for entry in _stored().values():
        if entry["resolution"] == resolution and entry.get("normals", "face") == normals:
            for measured in entry.get("measurements", []):
                if measured["setting"] == asdict(setting) and measured["runs"]:
                    return float(np.median([run["seconds_per_iteration"] for run in measured["runs"]])), int(entry["threads"])
    return None


def find_fair_setting(
    resolution: int,
    *,
    mesh: str = "spot",
    normals: str = "face",
    candidates: tuple[ProjectiveSetting, ...] = CANDIDATES,
    starts: int = 3,
    iterations: int = 150,
    threshold_deg: float = 0.1,
    earlier: Mapping[str, Any] | None = None,
    report: Callable[[str], None] = lambda line: None,
    save: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Search for the cheapest setting that converges.

    All candidates are timed; then, cheapest first, each runs from the protocol's starts until one start fails. The fair setting
    is the first candidate whose mean rotation error over the last 20 iterations is at most the threshold for all starts. If an
    earlier search has found a setting, it is timed beside the candidates, and more expensive candidates are not tried.

    Args:
        resolution, mesh, normals: Of the pose scene; mesh is a name or a file, normals "face" or "vertex".
        candidates: Settings to try.
        starts, iterations: Number of starts, and of steps from each.
        threshold_deg: Largest rotation error, degrees.
        earlier: Record of an interrupted search; its measurements are not repeated.
        report: Called with a line about each measurement.
        save: Called with the current record after each run and each candidate.

    Raises ShadowmapError if the earlier search had another protocol.

    Returns:
        A record of JSON values: `setting` (None if no candidate converged), `measurements` with the mean errors in
        degrees, the final offsets and the median seconds per iteration of each candidate, the seconds per iteration of
        untried candidates, the proxy and the machine.
    """
    protocol: dict[str, Any] = {
        "resolution": resolution,
        "mesh": mesh,
        "normals": normals,
        "starts": starts,
        "iterations": iterations,
        "threshold_deg": threshold_deg,
    }
    earlier = earlier or protocol
    for name, value in protocol.items():
        # Old records without the entry `normals` are of flat shading.
        found = earlier.get(name, "face" if name == "normals" else value)
        if found != value:
            raise ShadowmapError(f"the earlier search had {name} {found}, not {value}: choose another file for this one.")
    scene_path, mesh_path = assets.scene("pose"), assets.mesh(mesh)
    scene = load_scene(scene_path, mesh_path, resolution, normals)
    reference, proxy = path_traced(scene, spp=512).image, calibrate(scene)
    record: dict[str, Any] = {
        **protocol,
        "measurements": list(earlier.get("measurements", [])),
        "untried": dict(earlier.get("untried", {})),
        "proxy": proxy.record(),
        "shadowmap_dr": __version__,
        "machine": machine(),
        "mitsuba": mi.__version__,
        "variant": mi.variant(),
        "threads": dr.thread_count(),
    }
    record["setting"] = _cheapest(record["measurements"], starts, threshold_deg)
    begun = [entry for entry in record["measurements"] if not _complete(entry, starts, threshold_deg)]
    measured = [entry["setting"] for entry in record["measurements"] if entry not in begun]
    candidates = tuple(setting for setting in candidates if asdict(setting) not in measured)

    def method(setting: ProjectiveSetting) -> MitsubaPose:
        return MitsubaPose(scene_path, mesh_path, resolution, setting, reference, proxy=proxy, normals=normals)

    def step_cost(setting: ProjectiveSetting) -> float:
        pose = method(setting)
        pose.reset(pose_start(0))
        pose.step()
        seconds = float(np.median([_timed(pose.step) for _ in range(3)]))
        report(f"{setting}: {seconds:.2f} s per step")
        return seconds

    cost = {}
    for setting in candidates:
        cost[setting] = record["untried"][str(setting)] = step_cost(setting)
        save(record)
    limit = step_cost(ProjectiveSetting(**record["setting"])) if record["setting"] and candidates else float("inf")

    for setting in sorted(candidates, key=cost.__getitem__):
        if cost[setting] >= limit:
            break
        pose = method(setting)
        entry = next((entry for entry in begun if entry["setting"] == asdict(setting)), None)
        if entry is None:
            entry = {
                "setting": asdict(setting),
                "timed_seconds_per_iteration": cost[setting],
                "load_average": os.getloadavg()[0],
                "runs": [],
            }
            record["measurements"].append(entry)
        runs = entry["runs"]
        while not _complete(entry, starts, threshold_deg):
            runs.append(_measure(pose, len(runs), iterations))
            report(
                "{} run {run}: {mean_error_deg_last_20:.3f} degrees, {offset_x100:.2f}, "
                "{seconds_per_iteration:.2f} s per step".format(setting, **runs[-1])
            )
            save(record)
        del record["untried"][str(setting)]
        record["setting"] = _cheapest(record["measurements"], starts, threshold_deg)
        save(record)
        if _cheapest([entry], starts, threshold_deg):
            break
    return record


def _complete(entry: Mapping[str, Any], starts: int, threshold_deg: float) -> bool:
    """True if a candidate has run from all starts, or has failed from one."""
    runs = entry["runs"]
    return len(runs) >= starts or any(not run["mean_error_deg_last_20"] <= threshold_deg for run in runs)


def _cheapest(measurements: list[dict[str, Any]], starts: int, threshold_deg: float) -> dict[str, Any] | None:
    """The setting with the fastest steps among the settings that converged from all starts; None without such a setting."""
    passed = [
        entry
        for entry in measurements
        if len(entry["runs"]) == starts and all(run["mean_error_deg_last_20"] <= threshold_deg for run in entry["runs"])
    ]
    cost = lambda entry: float(np.median([run["seconds_per_iteration"] for run in entry["runs"]]))  # noqa: E731
    return min(passed, key=cost)["setting"] if passed else None


def _measure(pose: MitsubaPose, run: int, iterations: int) -> dict[str, Any]:
    """One run from a start of the protocol."""
    pose.reset(pose_start(run))
    trace: list[np.ndarray] = []
    seconds: list[float] = []
    for _ in range(iterations):
        seconds.append(_timed(pose.step))
        trace.append(pose.parameters())
    return {
        "run": run,
        "start": pose_start(run).tolist(),
        "final": trace[-1].tolist(),
        "mean_error_deg_last_20": float(np.degrees(np.abs(np.array(trace)[-20:, 0])).mean()),
        "offset_x100": float(100 * np.hypot(*trace[-1][1:])),
        "seconds_per_iteration": float(np.median(seconds[5:] or seconds)),
    }


def _timed(step: Callable[[], object]) -> float:
    """Seconds of a step, including the device's work."""
    begin = time.perf_counter()
    step()
    dr.sync_thread()
    return time.perf_counter() - begin


def _stored(path: Path | None = None) -> dict[str, dict[str, Any]]:
    """Searches by name, from a file or from this package."""
    path = path or STORE
    table = json.loads(path.read_text()) if path.is_file() else {}
    if not isinstance(table, dict) or not all(isinstance(entry, dict) for entry in table.values()):
        raise ShadowmapError(f"{path} holds no searches: choose another file.")
    return table


def _nearest(resolution: int, normals: str) -> tuple[int, ProjectiveSetting]:
    """The resolution nearest to the given one at which a stored search found a setting, and the setting."""
    found = {
        entry["resolution"]: ProjectiveSetting(**entry["setting"])
        for entry in _stored().values()
        if entry["setting"] and entry.get("normals", "face") == normals
    }
    if not found:
        raise ShadowmapError(
            f"no setting is known to converge with {normals} normals: "
            f"run python -m mitsuba_baselines.fair_settings --search {resolution} --normals {normals}."
        )
    nearest = min(found, key=lambda size: abs(np.log2(size / resolution)))
    return nearest, found[nearest]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m mitsuba_baselines.fair_settings", description="Searches fair settings.")
    parser.add_argument("--search", type=int, required=True, metavar="RESOLUTION")
    parser.add_argument("--mesh", default="spot", help="name or file")
    parser.add_argument("--normals", choices=("face", "vertex"), default="face", help="flat or smooth shading of the object")
    parser.add_argument("--candidates", nargs="+", metavar="C/P/I[/GUIDING[/SPP]]", help="settings to try instead of the usual")
    parser.add_argument("--output", type=Path, default=STORE, help="JSON file to extend; an interrupted search in it is resumed")
    try:
        _search(parser.parse_args())
    except (ShadowmapError, OSError, json.JSONDecodeError) as error:
        sys.exit(f"error: {' '.join(str(error).split())}")


def _search(options: argparse.Namespace) -> None:
    candidates = CANDIDATES
    if options.candidates:
        candidates = tuple(dict.fromkeys(ProjectiveSetting.parse(text) for text in options.candidates))
    if not 1 <= options.search <= MAX_RESOLUTION:
        raise ShadowmapError(f"a resolution of {options.search} pixels: give 1 to {MAX_RESOLUTION}.")
    mi.set_variant("llvm_ad_rgb")
    key = str(options.search) if options.normals == "face" else f"{options.search} {options.normals} normals"

    def save(record: dict[str, Any]) -> None:
        # Read the file again each time: another search may have written its record meanwhile.
        table = {**_stored(options.output), key: record}
        with atomic(options.output) as temporary:
            temporary.write_text(json.dumps(table, indent=1) + "\n")

    record = find_fair_setting(
        options.search,
        mesh=options.mesh,
        normals=options.normals,
        candidates=candidates,
        earlier=_stored(options.output).get(key),
        save=save,
        report=lambda line: print(line, flush=True),
    )
    print(f"fair setting at {key}: {record['setting']}")


if __name__ == "__main__":
    main()
