"""Quantities that a fit varies: their names on the command line, their start values, and their true ones."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from . import space
from .meshes import mesh
from .scenes import Body, Camera, Lamp, Material, Scene, Values

Array = npt.NDArray[np.float64]
Range = tuple[float, float]

#: Ranges from which the errors of start values are drawn.
ROTATION_DEG: Range = (10, 30)
#: Share of the scene's diameter.
TRANSLATION: Range = (0.05, 0.10)
DIRECTION_DEG: Range = (15, 30)
#: Factors, or one over them.
INTENSITY: Range = (1.25, 2.0)
SCALE: Range = (1.1, 1.25)
ROUGHNESS: Range = (1.4, 2.0)
COLOUR: Range = (1.2, 1.6)
FOV: Range = (1.06, 1.15)
CAMERA_DEG: Range = (3, 8)
CAMERA_TRANSLATION: Range = (0.01, 0.03)
#: Grey of textures.
GREY: Range = (0.3, 0.5)
#: Share of the scene's diameter by which start vertices differ from the mesh that was deformed.
VERTICES = 0.004

#: Endings of the names of radiometric values, and of roughnesses.
_RADIOMETRIC = ("irradiance", "intensity", "radiance")
_ROUGH = ("alpha", "roughness")
_AXES = {"x": np.array([1.0, 0, 0]), "y": np.array([0, 1.0, 0]), "z": np.array([0, 0, 1.0])}
#: Most by which a start's spot may miss the middle of the things that it lights.
_AIMED_DEG = 26.0
_ATTEMPTS = 500


@dataclass(frozen=True)
class Variation:
    """A name of ``--vary``.

    Attributes:
        name: as on the command line.
        part: id of a shape, light or sensor.
        kind: pose, rotation, translation, scale, vertices, direction, position, fov, texture or value.
        detail: axis of a rotation, axes of a translation, name of a value or a texture within the part.
    """

    name: str
    part: str
    kind: str
    detail: str = ""

    @property
    def is_radiometric(self) -> bool:
        """True for values that scale a light."""
        return self.kind == "value" and self.detail.endswith(_RADIOMETRIC)

    @property
    def is_colour(self) -> bool:
        """True for colours of materials."""
        return self.kind == "value" and not self.detail.endswith((*_RADIOMETRIC, *_ROUGH))


def parse(name: str) -> Variation:
    """Take a name of ``--vary`` apart."""
    path, _, kind = name.partition(":")
    part, _, inside = path.partition(".")
    if not kind:
        return Variation(name, part, "value", inside.removesuffix(".value"))
    kind, _, detail = kind.partition(":")
    return Variation(name, part, kind, (inside.partition(".")[2] or "reflectance") if kind == "texture" else detail)


def value(scene: Scene, variation: Variation) -> Array:
    """A colour or number (n,) of a scene."""
    return np.array(_values_of(scene, variation)[variation.detail.rpartition(".")[2]], float)


def _values_of(scene: Scene, variation: Variation) -> Values:
    if scene.holds(variation.part) == "lamp":
        return scene.lamp(variation.part).values
    body = scene.body(variation.part)
    return {"radiance": body.radiance or ()} if variation.detail.startswith("emitter") else body.material.values


def with_value(scene: Scene, variation: Variation, new: npt.ArrayLike) -> Scene:
    """A scene with another colour or number (n,)."""
    entry, numbers = variation.detail.rpartition(".")[2], tuple(np.ravel(new).tolist())
    if scene.holds(variation.part) == "lamp":
        lamp = scene.lamp(variation.part)
        return scene.replaced(dataclasses.replace(lamp, values={**lamp.values, entry: numbers}))
    body = scene.body(variation.part)
    if variation.detail.startswith("emitter"):
        return scene.replaced(dataclasses.replace(body, radiance=numbers))
    material = dataclasses.replace(body.material, values={**body.material.values, entry: numbers})
    return scene.replaced(dataclasses.replace(body, material=material))


def moved_part(scene: Scene, part: str, matrix: Array) -> Scene:
    """A scene with a part under a map (4, 4) of the world."""
    kind = scene.holds(part)
    found: Body | Lamp | Camera = getattr(scene, kind)(part)
    return scene.replaced(dataclasses.replace(found, place=matrix @ found.place))


def pivot(scene: Scene, part: str) -> Array:
    """The point (3,) of a part whose position counts: the middle of a mesh's own box, the place of a light or camera."""
    kind = scene.holds(part)
    found: Body | Lamp | Camera = getattr(scene, kind)(part)
    return space.applied(found.place, found.middle() if isinstance(found, Body) else np.zeros(3))


def axes(scene: Scene, part: str) -> Array:
    """Unit vectors (3, 3) of a part's own axes in the world, as columns."""
    linear: Array = getattr(scene, scene.holds(part))(part).place[:3, :3]
    return linear / np.linalg.norm(linear, axis=0)


def freedoms(scene: Scene, variation: Variation) -> int:
    """Number of numbers that vary; textures and vertices have none."""
    fixed = {"pose": 6, "rotation": 1, "scale": 1, "direction": 2, "position": 3, "fov": 1, "texture": 0, "vertices": 0}
    if variation.kind == "translation":
        return len(variation.detail)
    if variation.kind == "pose" and is_round(scene, variation.part):
        return 5
    return fixed[variation.kind] if variation.kind in fixed else len(value(scene, variation))


def is_round(scene: Scene, part: str) -> bool:
    """True for parts whose turns about their own z axis cannot be seen: spots, and area lamps.

    Half a degree of an area lamp about its normal changes a picture by 0.06 % of its brightness, eight degrees by 0.3 %.
    """
    kind = scene.holds(part)
    if kind == "body":
        return scene.body(part).radiance is not None
    return kind == "lamp" and scene.lamp(part).kind == "spot"


def nudged(scene: Scene, variation: Variation, step: npt.ArrayLike) -> Scene:
    """A scene with a quantity changed by a step: degrees, units of the scene, or shares of values.

    Six numbers of a pose are rotations about the axes of the world through `pivot`, and translations.
    """
    numbers, part = np.ravel(np.asarray(step, float)), variation.part
    about = pivot(scene, part)
    if variation.kind == "value":
        return with_value(scene, variation, value(scene, variation) * (1 + numbers))
    if variation.kind == "pose":
        turn, shift = numbers[:-3], numbers[-3:]
        if len(turn) == 2:
            turn = axes(scene, part)[:, :2] @ turn
        return moved_part(scene, part, space.moved(space.rotation(np.radians(turn)), shift, about))
    if variation.kind == "rotation":
        return moved_part(scene, part, space.moved(space.rotation(np.radians(numbers[0]) * _AXES[variation.detail]), about=about))
    if variation.kind == "translation":
        shift = sum(number * _AXES[axis] for number, axis in zip(numbers, variation.detail, strict=True))
        return moved_part(scene, part, space.moved(np.eye(3), shift))
    if variation.kind == "position":
        return moved_part(scene, part, space.moved(np.eye(3), numbers))
    if variation.kind == "scale":
        return moved_part(scene, part, space.moved((1 + numbers[0]) * np.eye(3), about=about))
    if variation.kind == "direction":
        turn = axes(scene, part)[:, :2] @ np.radians(numbers)
        return moved_part(scene, part, space.moved(space.rotation(turn), about=about))
    if variation.kind == "fov":
        camera = scene.camera(part)
        return scene.replaced(dataclasses.replace(camera, fov=camera.fov + numbers[0]))
    raise KeyError(variation.kind)


def start_scene(truth: Scene, variations: tuple[Variation, ...], seed: int) -> Scene:
    """The scene with wrong start values for all that varies, drawn from the ranges of this module.

    Starts that no user would choose are drawn again: a body below the floor or out of the picture, a light from below.
    """
    random = np.random.default_rng(seed)
    diameter = truth.diameter()
    scene = truth
    for variation in variations:
        for attempt in range(_ATTEMPTS):
            drawn = _wrong(truth, scene, variation, diameter, random)
            if variation.kind == "vertices" or is_plausible(drawn, variation.part):
                break
            if attempt == _ATTEMPTS - 1:
                raise ValueError(f"no plausible start of {variation.name}")
        scene = drawn
    return scene


def is_plausible(scene: Scene, part: str) -> bool:
    """True if a user might place a part like this."""
    kind = scene.holds(part)
    if kind == "camera":
        return all(_is_seen(scene, body, 0.85) for body in scene.bodies if not body.backdrop and body.radiance is None)
    if kind == "lamp":
        lamp = scene.lamp(part)
        if lamp.kind in ("directional", "sunsky"):
            return lamp.direction[1] < -0.25
        things = np.mean([body.centre() for body in scene.bodies if not body.backdrop], axis=0)
        aimed = lamp.kind != "spot" or space.angle_deg(lamp.direction, things - lamp.position) < _AIMED_DEG
        return lamp.kind in ("constant", "envmap") or (bool(lamp.position[1] > 1.0) and aimed)
    body = scene.body(part)
    return body.radiance is not None or body.backdrop or (_is_seen(scene, body, 0.95) and is_above(scene, body))


def is_above(scene: Scene, body: Body, share: float = 0.85) -> bool:
    """True if a share of a body's vertices is before all floors and walls."""
    world = body.world()
    return all(
        np.mean((world - backdrop.place[:3, 3]) @ backdrop.place[:3, 2] > 0) > share
        for backdrop in scene.bodies
        if backdrop.backdrop and backdrop.mesh == "rectangle"
    )


def _is_seen(scene: Scene, body: Body, share: float) -> bool:
    """True if a share of a body's vertices lies in the picture of the first camera."""
    camera = scene.cameras[0]
    x, y, z = space.applied(np.asarray(np.linalg.inv(camera.place), float), body.world()).T
    wide = np.tan(np.radians(camera.fov / 2))
    seen = (z > 0) & (np.abs(x) < wide * z) & (np.abs(y) < wide * z * camera.height / camera.width)
    return bool(np.mean(seen) > share)


def _wrong(truth: Scene, scene: Scene, variation: Variation, diameter: float, random: np.random.Generator) -> Scene:
    """The scene with a start value of one quantity."""
    part, kind = variation.part, variation.kind
    about = pivot(scene, part)

    def signed(limits: Range) -> float:
        return float(random.uniform(*limits) * random.choice([-1, 1]))

    def shift(limits: Range = TRANSLATION) -> Array:
        return random.uniform(*limits) * diameter * space.random_direction(random)

    def factor(limits: Range) -> float:
        return float(random.uniform(*limits) ** random.choice([-1, 1]))

    def pose() -> Scene:
        if is_round(scene, part):
            map_ = space.moved(np.eye(3), shift())
            return moved_part(direction(), part, map_)
        small = scene.holds(part) == "camera"
        turn = np.radians(random.uniform(*(CAMERA_DEG if small else ROTATION_DEG))) * space.random_direction(random)
        map_ = space.moved(space.rotation(turn), shift(CAMERA_TRANSLATION if small else TRANSLATION), about)
        return moved_part(scene, part, map_)

    def rotation() -> Scene:
        return nudged(scene, variation, signed(ROTATION_DEG))

    def translation() -> Scene:
        step = random.uniform(*TRANSLATION) * diameter * space.unit(random.normal(size=len(variation.detail)))
        return nudged(scene, variation, step)

    def direction() -> Scene:
        old = axes(scene, part)[:, 2]
        new = space.turned(old, random.uniform(*DIRECTION_DEG), random)
        axis = space.unit(np.cross(old, new)) * np.radians(space.angle_deg(old, new))
        return moved_part(scene, part, space.moved(space.rotation(axis), about=about))

    def fov() -> Scene:
        camera = scene.camera(part)
        return scene.replaced(dataclasses.replace(camera, fov=camera.fov * factor(FOV)))

    def number() -> Scene:
        old = value(truth, variation)
        if variation.is_radiometric:
            new = old * factor(INTENSITY) * random.uniform(0.9, 1.1, len(old))
        elif variation.is_colour:
            new = np.clip(old * np.array([factor(COLOUR) for _ in old]), 0.04, 0.92)
        else:
            new = np.clip(old * factor(ROUGHNESS), 0.06, 0.7)
        return with_value(scene, variation, new)

    draw: dict[str, Callable[[], Scene]] = {
        "pose": pose,
        "rotation": rotation,
        "translation": translation,
        "position": lambda: nudged(scene, variation, shift()),
        "scale": lambda: nudged(scene, variation, factor(SCALE) - 1),
        "direction": direction,
        "fov": fov,
        "value": number,
        "texture": lambda: with_texture(scene, variation, random.uniform(*GREY)),
        "vertices": lambda: _with_undeformed(scene, part, diameter, random),
    }
    return draw[kind]()


def texture(scene: Scene, variation: Variation) -> Array:
    """A texture (H, W, 3) of a scene, linear."""
    return scene.body(variation.part).material.textures[variation.detail]


def with_texture(scene: Scene, variation: Variation, colour: float | Array) -> Scene:
    """A scene with another texture (H, W, 3), or an even one."""
    body = scene.body(variation.part)
    image = np.broadcast_to(colour, texture(scene, variation).shape).astype(float)
    material = Material(body.material.kind, body.material.values, {**body.material.textures, variation.detail: image})
    return scene.replaced(dataclasses.replace(body, material=material))


def _with_undeformed(scene: Scene, part: str, diameter: float, random: np.random.Generator) -> Scene:
    """A scene with the mesh of which the truth is a deformation, a little off in a smooth way."""
    body = scene.body(part)
    vertices = mesh(body.mesh).vertices
    size = VERTICES * diameter / np.linalg.norm(body.place[:3, 0])
    waves = random.normal(0, 1.5, (3, 3)), random.uniform(0, 2 * np.pi, 3)
    offset = size * np.sin(vertices @ waves[0] + waves[1])
    return scene.replaced(dataclasses.replace(body, vertices=vertices + offset))
