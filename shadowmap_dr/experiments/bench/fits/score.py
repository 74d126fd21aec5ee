"""Score of a fit's result: errors against the truth, and intervals against the errors.

A problem is solved if all rotations and directions are within 0.5 degrees, positions within 0.5 % of the scene's diameter,
colours, intensities and roughnesses within 3 %, textures within an RMSE of 0.02, and vertices within a Chamfer distance of 1 % of
the shape's diameter. Angles of view count as rotations, scales by how far they move the shape's surface. Values that exposures
scale as well are compared after multiplication with the exposures. Of spots and area lamps the direction counts, not their turn
about it, which pictures do not show.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import numpy.typing as npt

from ....io.images import to_linear
from ....scene.mitsuba_meshes import mesh_buffers
from . import space
from .meshes import mesh
from .problem import FitProblem
from .scenes import Scene, load_scene, write_scene
from .variations import Variation, is_round, parse, texture, value

Array = npt.NDArray[np.float64]
Record = Mapping[str, Any]  # fit.json

#: Bars: degrees, shares of the scene's diameter, shares of values, RMSE, shares of the shape's diameter.
ANGLE_DEG, POSITION, VALUE, TEXTURE, CHAMFER = 0.5, 0.005, 0.03, 0.02, 0.01
_POINTS = 4000
#: Least share of the usual brightness of a texel in the picture for it to count.
_SEEN = 0.1
#: Kinds of estimates that move a part.
_MOTIONS = ("pose", "rotation", "translation", "scale")


@dataclass(frozen=True)
class Deviation:
    """An error of a fitted quantity, and the most with which it counts as found; both in ``unit``."""

    name: str
    what: str
    error: float
    bar: float
    unit: str

    @property
    def is_met(self) -> bool:
        return bool(self.error <= self.bar)


@dataclass(frozen=True)
class Interval:
    """A fitted number, its true value, and half of the interval that the fit states; infinite if it says that it cannot know."""

    name: str
    value: float
    truth: float
    half_width: float

    @property
    def error(self) -> float:
        return abs(self.value - self.truth)

    @property
    def holds(self) -> bool:
        return self.error <= self.half_width


def score(problem: FitProblem, start: Scene, record: Record, folder: Path) -> dict[str, Any]:
    """The score of a result.

    Args:
        problem: the problem.
        start: the scene that the command got.
        record: content of its fit.json.
        folder: of its output, for textures and vertices.

    Returns:
        JSON values: ``solved``, ``found``, ``deviations`` and ``intervals``.
    """
    found = [deviation for one in problem.scored for deviation in deviations(problem, one, start, record, folder)]
    stated = intervals(problem, start, record)
    return {
        "solved": all(one.is_met for one in found),
        "found": bool(record["found"]),
        "unexplained": record["unexplained"],
        "deviations": [asdict(one) for one in found],
        "intervals": [asdict(one) for one in stated],
        "words": list(record.get("words", ())),
    }


def deviations(problem: FitProblem, variation: Variation, start: Scene, record: Record, folder: Path) -> list[Deviation]:
    """Errors of one quantity. An estimate that is missing has an infinite error."""
    truth, part, kind = problem.truth, variation.part, variation.kind
    diameter = truth.diameter()
    estimate = _estimate(record, variation)
    if estimate is None:
        return [Deviation(variation.name, "missing", float("inf"), 0.0, "")]

    def one(what: str, error: float, bar: float, unit: str) -> Deviation:
        return Deviation(variation.name, what, float(error), bar, unit)

    if kind == "value":
        return [one("value", _value_error(problem, variation, estimate, record), VALUE, "relative")]
    if kind == "fov":
        error = abs(float(_numbers(estimate, "value", "values")[0]) - truth.camera(part).fov)
        return [one("angle of view", error, ANGLE_DEG, "deg")]
    if kind == "texture":
        return [one("RMSE", _texture_error(problem, variation, folder), TEXTURE, "")]
    if kind == "vertices":
        return [one("Chamfer", _vertex_error(problem, part, folder), CHAMFER, "of the shape's diameter")]
    holder = truth.holds(part)
    own = getattr(truth, holder)(part).place
    if holder == "lamp":
        found = []
        if kind in ("direction", "pose"):
            error = space.angle_deg(_direction(start, part, estimate), own[:3, 2])
            found.append(one("direction", error, ANGLE_DEG, "deg"))
        if kind in ("position", "pose", "translation"):
            distance = float(np.linalg.norm(_position(start, part, estimate) - own[:3, 3]))
            found.append(one("position", distance / diameter, POSITION, "of the diameter"))
        return found
    old = getattr(start, holder)(part).place
    place = _map(record, part) @ old
    middle = truth.body(part).middle() if holder == "body" else np.zeros(3)
    found = []
    if kind in ("pose", "rotation"):
        if is_round(truth, part):
            found.append(one("direction", space.angle_deg(place[:3, 2], own[:3, 2]), ANGLE_DEG, "deg"))
        else:
            turn = space.nearest_rotation(place[:3, :3]) @ space.nearest_rotation(own[:3, :3]).T
            found.append(one("rotation", np.degrees(np.linalg.norm(space.rotation_vector(turn))), ANGLE_DEG, "deg"))
    if kind in ("pose", "translation", "position"):
        distance = float(np.linalg.norm(space.applied(place, middle) - space.applied(own, middle)))
        found.append(one("position", distance / diameter, POSITION, "of the diameter"))
    if kind == "scale":
        ratio = np.cbrt(abs(np.linalg.det(place[:3, :3]) / np.linalg.det(own[:3, :3])))
        radius = float(np.linalg.norm(truth.body(part).world() - truth.body(part).centre(), axis=1).max())
        found.append(one("scale", abs(ratio - 1) * radius / diameter, POSITION, "of the diameter"))
    return found


def intervals(problem: FitProblem, start: Scene, record: Record) -> list[Interval]:
    """All numbers with intervals whose true values are known: of quantities that are scored, and exposures."""
    found = []
    for variation in problem.scored:
        estimate = _estimate(record, variation)
        if estimate is None or estimate["half_width"] is None or variation.name in problem.common_factor:
            continue
        for number, truth in enumerate(true_numbers(problem.truth, start, variation, estimate)):
            if truth is not None:
                label = f"{variation.name} {estimate['labels'][number]}"
                found.append(_interval(label, estimate, number, truth))
    if not problem.common_factor and problem.integrator == "direct":
        exposures = [one for one in record["estimates"] if one["kind"] == "exposure"]
        for photo, estimate in zip(problem.photographs, exposures, strict=False):  # none with white balance
            if estimate["half_width"] is not None:
                found.append(_interval(estimate["name"], estimate, 0, float(np.log2(photo.exposure))))
    return found


def true_numbers(truth: Scene, start: Scene, variation: Variation, estimate: Record) -> list[float | None]:
    """True values of an estimate's numbers, in its units; None for those that pictures do not show.

    The command counts motions from the place in the scene file, and tells the point and the axes of rotations. Directions turn
    about two axes that are perpendicular to them.
    """
    if variation.kind == "value":
        return [float(number) for number in value(truth, variation)]
    if variation.kind == "fov":
        return [truth.camera(variation.part).fov]
    if not estimate["labels"] or variation.kind in ("texture", "vertices"):
        return []
    numbers = _motion(truth, start, variation.part, estimate)
    return [numbers.get(label) for label in estimate["labels"]]


def _motion(truth: Scene, start: Scene, part: str, estimate: Record) -> dict[str, float]:
    """True numbers of all motions of a part, by label."""
    holder = truth.holds(part)
    old, new = (getattr(scene, holder)(part).place for scene in (start, truth))
    matrix = new @ np.linalg.inv(old)
    pivot = np.array(estimate["pivot"], float) if estimate.get("pivot") is not None else old[:3, 3]
    axes = np.array(estimate["axes"], float) if estimate.get("axes") is not None else np.eye(3)
    shift = space.applied(matrix, pivot) - pivot
    size = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    turn = np.degrees(space.rotation_vector(axes.T @ space.nearest_rotation(matrix[:3, :3]) @ axes))
    numbers = {f"translation {axis}": float(shift[k]) for k, axis in enumerate("xyz")}
    if holder == "lamp":
        about_axis = _shortest_turn(old[:3, 2], new[:3, 2])
        first, second = tangents(old[:3, 2])
        return numbers | {"turn 1": float(about_axis @ first), "turn 2": float(about_axis @ second)}
    if is_round(truth, part):
        return numbers
    names = ("tilt", "pan", "roll") if holder == "camera" else ("rotation x", "rotation y", "rotation z")
    return numbers | {name: float(turn[k]) for k, name in enumerate(names)} | {"scale": size}


def tangents(direction: Array) -> tuple[Array, Array]:
    """The two axes about which the command turns a direction."""
    ahead = space.unit(direction)
    first = space.unit(np.cross(ahead, np.eye(3)[np.abs(ahead).argmin()]))
    return first, np.cross(ahead, first)


def _shortest_turn(old: Array, new: Array) -> Array:
    """Rotation vector (3,) in degrees that takes one direction to another."""
    axis = np.cross(old, new)
    length = float(np.linalg.norm(axis))
    return axis / length * space.angle_deg(old, new) if length else np.zeros(3)


def _interval(name: str, estimate: Record, number: int, truth: float) -> Interval:
    half = estimate["half_width"][number]
    return Interval(name, float(estimate["values"][number]), truth, float("inf") if half is None else float(half))


def _estimate(record: Record, variation: Variation) -> Record | None:
    """The estimate of a name; names of values may end in ``.value``."""
    names = (variation.name, f"{variation.name}.value")
    return next((one for one in record["estimates"] if one["name"] in names), None)


def _numbers(estimate: Record, *names: str) -> Array:
    return np.array(next(estimate[name] for name in names if estimate.get(name) is not None), float)


def _map(record: Record, part: str) -> Array:
    """The map (4, 4) of a part from its place in the scene file to the fitted one. Each of its estimates has all of it."""
    for one in record["estimates"]:
        variation = parse(one["name"])
        if variation.part == part and variation.kind in (*_MOTIONS, "position") and one.get("matrix") is not None:
            return np.array(one["matrix"], float)
    return np.full((4, 4), np.nan)


def _direction(start: Scene, part: str, estimate: Record) -> Array:
    """The direction of a light: as stated, or its old one as turned."""
    if estimate.get("direction") is not None:
        return np.array(estimate["direction"], float)
    return np.array(estimate["matrix"], float)[:3, :3] @ start.lamp(part).direction


def _position(start: Scene, part: str, estimate: Record) -> Array:
    if estimate.get("position") is not None:
        return np.array(estimate["position"], float)
    return space.applied(np.array(estimate["matrix"], float), start.lamp(part).position)


def _value_error(problem: FitProblem, variation: Variation, estimate: Record, record: Record) -> float:
    """The largest relative error of a colour's channels, or that of a number."""
    new, true = _numbers(estimate, "value", "values"), value(problem.truth, variation)
    if variation.name not in problem.common_factor:
        return float(np.max(np.abs(new / true - 1)))
    pairs = zip(problem.photographs, record["pictures"], strict=True)
    errors = [np.max(np.abs(new * found["exposure"] / (true * photo.exposure) - 1)) for photo, found in pairs]
    return float(np.max(errors))


def _fitted(folder: Path) -> mi.Scene:
    """The scene that the command has written."""
    return load_scene(folder / "scene.xml")


def _texture_error(problem: FitProblem, variation: Variation, folder: Path) -> float:
    """RMSE of the texels that are seen, lit, in the pictures."""
    key = f"{variation.part}.bsdf.{variation.detail}.data"
    data = mi.traverse(_fitted(folder))[key]
    new = np.array(data)[..., :3]
    if not dr.is_float_v(data):  # bytes, sRGB
        new = to_linear(new / 255)
    seen = seen_texels(problem, variation, folder)
    difference = (new - texture(problem.truth, variation))[seen]
    return float(np.sqrt(np.mean(difference**2)))


def seen_texels(problem: FitProblem, variation: Variation, folder: Path) -> npt.NDArray[np.bool_]:
    """True (H, W) for texels on which the pictures depend, from Mitsuba's derivatives.

    The true scene is written into a folder ``truth`` beside that of the command's output.
    """
    scene = load_scene(write_scene(problem.truth, folder.parent / "truth", ".exr"))
    key = f"{variation.part}.bsdf.{variation.detail}.data"
    params = mi.traverse(scene)
    data = mi.TensorXf(params[key])
    dr.enable_grad(data)
    params[key] = data
    params.update()
    for sensor in range(len(scene.sensors())):
        image = mi.render(scene, params, sensor=sensor, integrator=mi.load_dict({"type": "direct"}), spp=32)
        dr.backward(dr.sum(image, axis=None))
    sums = np.array(dr.grad(data), float).sum(-1)
    return sums > _SEEN * np.median(sums[sums > 0])


def _vertex_error(problem: FitProblem, part: str, folder: Path) -> float:
    """Chamfer distance of the fitted and the true surface, as a share of the true one's diameter."""
    shape = next(shape for shape in _fitted(folder).shapes() if shape.id() == part)
    buffers = mesh_buffers(shape)
    new, faces = np.array(buffers.positions, float).reshape(-1, 3), np.array(buffers.faces, int).reshape(-1, 3)
    body = problem.truth.body(part)
    true = body.world()
    size = np.linalg.norm(true.max(0) - true.min(0))
    return chamfer((new, faces), (true, mesh(body.mesh).faces.astype(int))) / float(size)


def chamfer(one: tuple[Array, npt.NDArray[np.int64]], other: tuple[Array, npt.NDArray[np.int64]]) -> float:
    """Mean distance of points of each of two surfaces (vertices, faces) to the nearest point of the other.

    Surfaces with the same faces have points at the same places of the faces, so that equal ones are at distance 0.
    """
    alike = np.array_equal(one[1], other[1])
    choice = _choice(*other)
    a, b = _points(*one, *(choice if alike else _choice(*one))), _points(*other, *choice)
    return 0.5 * (_nearest(a, b) + _nearest(b, a))


def _choice(vertices: Array, faces: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], Array]:
    """(faces, barycentric coordinates) of random points, even over the area."""
    random = np.random.default_rng(0)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    chosen = random.choice(len(faces), _POINTS, p=area / area.sum())
    u, v = random.random((2, _POINTS))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return chosen, np.stack([1 - u - v, u, v], 1)


def _points(vertices: Array, faces: npt.NDArray[np.int64], chosen: npt.NDArray[np.int64], weights: Array) -> Array:
    return np.einsum("nk,nkd->nd", weights, vertices[faces[chosen]])


def _nearest(points: Array, others: Array) -> float:
    """Mean distance of points to the nearest of others."""
    found = []
    for part in np.array_split(points, 16):
        square = np.sum(part**2, 1)[:, None] - 2 * part @ others.T + np.sum(others**2, 1)
        found.append(np.linalg.norm(part - others[square.argmin(1)], axis=1))
    return float(np.concatenate(found).mean())


def summary(runs: Sequence[Record]) -> dict[str, Any]:
    """Shares over all runs (scores with ``problem`` and ``seconds``; failed ones have ``failed``).

    Returns:
        ``starts``, and how many are ``solved`` and ``failed``; ``seconds`` (median, max); ``false_found``: said to be found, but
        not solved; ``missed``: solved, but said not to be found. Of each solved problem and parameter once: ``intervals``, their
        number, ``coverage``, the share that holds the true value, and ``ratio``, the median of half-width over error.
    """
    seconds = [run["seconds"] for run in runs]
    told = [run for run in runs if "failed" not in run]
    once: dict[tuple[str, str], Interval] = {}
    for run in told:
        if run["solved"]:
            for one in run["intervals"]:
                half = one["half_width"]  # JSON has no infinity
                interval = Interval(one["name"], one["value"], one["truth"], float("inf") if half is None else half)
                once.setdefault((run["problem"], interval.name), interval)
    stated = list(once.values())
    ratios = [one.half_width / max(one.error, 1e-12) for one in stated]
    return {
        "starts": len(runs),
        "solved": sum(bool(run.get("solved")) for run in runs),
        "failed": len(runs) - len(told),
        "seconds": {"median": float(np.median(seconds)), "max": float(np.max(seconds))} if seconds else None,
        "false_found": sum(run["found"] and not run["solved"] for run in told),
        "missed": sum(run["solved"] and not run["found"] for run in told),
        "intervals": len(stated),
        "coverage": float(np.mean([one.holds for one in stated])) if stated else None,
        "ratio": float(np.median(ratios)) if ratios else None,
    }
