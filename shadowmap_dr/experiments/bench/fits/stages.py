"""Truths of the problems: stages with floors and walls, things that stand or hang there, lights and cameras, drawn from a seed.

Lengths are such that a stage is about 4 wide; y is up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ....io.images import to_linear, to_srgb
from . import space
from .scenes import Body, Camera, Lamp, Material, Scene
from .variations import is_above

Array = npt.NDArray[np.float64]

#: Half of a stage's width.
HALF = 2.2
#: Half of a thing's longest side, by how many things there are, and their places (x, z).
_SIZES = {1: 0.68, 2: 0.52, 3: 0.42}
_PLACES: dict[int, tuple[tuple[float, float], ...]] = {
    1: ((0.0, 0.0),),
    2: ((-0.68, -0.1), (0.66, 0.15)),
    3: ((-0.95, -0.25), (0.0, 0.3), (0.95, -0.15)),
}
_PALETTE = ((0.72, 0.32, 0.22), (0.24, 0.46, 0.66), (0.74, 0.6, 0.26), (0.3, 0.56, 0.34), (0.62, 0.6, 0.56), (0.56, 0.34, 0.58))
_WALLS = ((0.62, 0.6, 0.55), (0.5, 0.54, 0.58), (0.58, 0.5, 0.44), (0.44, 0.5, 0.44))
_TURN = np.deg2rad


def scene(
    stage: str,
    things: Sequence[str],
    lights: Sequence[str],
    views: int,
    size: tuple[int, int],
    seed: int,
    files: Mapping[str, Path] | None = None,
) -> Scene:
    """A scene.

    Args:
        stage: `floor`, `corner` (a floor and a wall), `niche` (a floor and two walls) or `wall`.
        things: names of meshes; behind a slash a material, and ``^`` for things in the air: ``bunny/plastic^``.
        lights: `sun`, `point`, `spot`, `panel`, `sky`, `dome` (an environment map) or `sunsky`.
        views: number of cameras.
        size: width and height of pictures in pixels.
        seed: of all that is not named.
        files: meshes by name, beside those of this package.
    """
    random = np.random.default_rng(seed)
    backdrops = _backdrops(stage, random)
    bodies: list[Body] = []
    order = random.permutation(len(_PALETTE))
    for k, thing in enumerate(things):
        bodies.append(_thing(stage, thing, k, len(things), backdrops, _PALETTE[order[k]], random, files or {}))
    azimuth = float(random.uniform(-24, 24))
    lamps, shining = _lights(lights, stage, azimuth, random)
    height = float(np.mean([body.centre()[1] for body in bodies])) - (0.05 if stage == "floor" else 0.0)
    return Scene((*bodies, *shining, *backdrops), lamps, _cameras(stage, azimuth, height, views, size, random))


def _backdrops(stage: str, random: np.random.Generator) -> list[Body]:
    colours = [np.array(_WALLS[k]) * random.uniform(0.85, 1.15) for k in random.permutation(len(_WALLS))]
    flat = space.rotation((-np.pi / 2, 0, 0))
    places = {
        "floor": _plane(flat, (0, 0, 0), HALF, HALF),
        "back": _plane(np.eye(3), (0, 1.2, -1.5), HALF, 1.2),
        "side": _plane(space.rotation((0, np.pi / 2, 0)), (-HALF, 1.2, 0.25), 1.75, 1.2),
        "wall": _plane(np.eye(3), (0, 0.9, -1.1), HALF, 1.6),
    }
    if stage != "floor":
        places["floor"] = _plane(flat, (0, 0, 0.25), HALF, 1.75)
    names = {"floor": ("floor",), "corner": ("floor", "back"), "niche": ("floor", "back", "side"), "wall": ("wall",)}[stage]
    return [
        Body(name, "rectangle", places[name], Material("diffuse", {"reflectance": _numbers(colour)}), backdrop=True)
        for name, colour in zip(names, colours, strict=False)
    ]


def _plane(turn: Array, middle: Sequence[float], width: float, height: float) -> Array:
    return space.moved(np.eye(3), middle) @ space.moved(turn @ np.diag([width, height, 1.0]))


def _numbers(values: npt.ArrayLike) -> tuple[float, ...]:
    return tuple(np.round(np.ravel(np.asarray(values, float)), 4).tolist())


def _thing(
    stage: str,
    words: str,
    number: int,
    count: int,
    backdrops: Sequence[Body],
    colour: Sequence[float],
    random: np.random.Generator,
    files: Mapping[str, Path],
) -> Body:
    """A thing at its place: on the floor, leaning a little, or in the air, turned in any way."""
    name, _, kind = words.rstrip("^").partition("/")
    in_air = words.endswith("^") or stage == "wall"
    x, z = np.array(_PLACES[count][number]) + random.uniform(-0.1, 0.1, 2)
    size = _SIZES[count] * random.uniform(0.93, 1.07)
    lean = space.rotation(_TURN(random.uniform(6, 25) if in_air else random.uniform(0, 7)) * space.random_direction(random))
    turn = lean @ space.rotation((0, _TURN(random.uniform(-55, 55)), 0))
    body = Body(
        name,
        str(files.get(name, name)),
        space.moved(turn * size),
        _material(kind, np.array(colour) * random.uniform(0.85, 1.15), random),
    )
    low = body.world().min(0)[1]
    height = 0.9 + random.uniform(-0.1, 0.1) if stage == "wall" else -low + (random.uniform(0.12, 0.35) if in_air else 0.0)
    z = z - 0.1 if stage == "wall" else z
    body = dataclasses.replace(body, place=space.moved(np.eye(3), (x, height, z)) @ body.place)
    within = Scene((body, *backdrops), (), ())
    while not is_above(within, body, 0.995):
        body = dataclasses.replace(body, place=space.moved(np.eye(3), (0, 0, 0.05)) @ body.place)
        within = within.replaced(body)
    return body


def _material(kind: str, colour: Array, random: np.random.Generator) -> Material:
    roughness = (round(float(random.uniform(0.22, 0.38)), 4),)
    if kind == "plastic":
        return Material("roughplastic", {"diffuse_reflectance": _numbers(colour * 0.6), "alpha": roughness})
    if kind == "metal":
        return Material("roughconductor", {"alpha": roughness, "specular_reflectance": _numbers(np.clip(colour * 1.3, 0, 0.95))})
    if kind == "principled":
        return Material("principled", {"base_color": _numbers(colour), "roughness": roughness})
    return Material("diffuse", {"reflectance": _numbers(colour)})


def _lights(
    names: Sequence[str], stage: str, azimuth: float, random: np.random.Generator
) -> tuple[tuple[Lamp, ...], tuple[Body, ...]]:
    lamps: list[Lamp] = []
    bodies: list[Body] = []
    side = random.choice([-1, 1]) if stage != "niche" else 1
    alone = len(names) == 1
    for name in names:
        tint = random.uniform(0.92, 1.08, 3)
        beside = azimuth + side * random.uniform(30, 60)
        elevation = random.uniform(20, 35) if stage == "wall" else random.uniform(38, 58)
        sun = space.moved(space.look_at((0, 0, 0), space.from_elevation(beside, elevation))[:3, :3])
        where = -3.0 * space.from_elevation(azimuth + side * random.uniform(25, 50), random.uniform(42, 56))
        where = where + np.array([0, 0.9 if stage == "wall" else 0.1, 0])
        aim = np.array([0, 0.9, -0.6]) if stage == "wall" else np.array([0, 0.25, 0]) + random.uniform(-0.15, 0.15, 3)
        strength = random.uniform(0.9, 1.1) * (1.0 if alone else 0.75)
        if name == "sun":
            lamps.append(Lamp(name, "directional", sun, {"irradiance": _numbers(2.5 * strength * tint)}))
        elif name == "point":
            lamps.append(Lamp(name, "point", space.moved(np.eye(3), where), {"intensity": _numbers(22 * strength * tint)}))
        elif name == "spot":
            settings = {"cutoff_angle": (32.0,), "beam_width": (23.0,)}
            place = space.look_at(where, aim)
            lamps.append(Lamp(name, "spot", place, {"intensity": _numbers(24 * strength * tint)}, settings))
        elif name == "panel":
            where = aim - 3.1 * space.from_elevation(azimuth + side * random.uniform(50, 70), random.uniform(52, 62))
            place = space.look_at(where, aim) @ space.moved(np.diag([0.42, 0.27, 1.0]))
            black = Material("diffuse", {"reflectance": (0.05, 0.05, 0.05)})
            bodies.append(Body(name, "rectangle", place, black, radiance=_numbers(44 * strength * tint)))
        elif name == "sky":
            lamps.append(Lamp(name, "constant", np.eye(4), {"radiance": _numbers((0.8 * strength if alone else 0.16) * tint)}))
        elif name == "dome":
            image = _dome(-space.from_elevation(beside, elevation), random) * 0.55 * strength
            lamps.append(Lamp(name, "envmap", np.eye(4), {"scale": (round(float(random.uniform(0.8, 1.2)), 4),)}, image=image))
        elif name == "sunsky":
            settings = {"turbidity": (round(float(random.uniform(2.5, 5)), 3),)}
            lamps.append(Lamp(name, "sunsky", sun, {"sun_scale": (0.6,), "sky_scale": (0.6,)}, settings))
        else:
            raise KeyError(name)
    return tuple(lamps), tuple(bodies)


def _dome(towards_sun: Array, random: np.random.Generator) -> Array:
    """A small environment map (16, 32, 3): a sky, a soft sun, and the ground."""
    height, width = 16, 32
    theta = (np.arange(height) + 0.5)[:, None] * np.pi / height
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    # Mitsuba's map begins behind, and goes around y.
    directions = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta) * np.ones_like(phi), -np.cos(phi) * np.sin(theta)], -1)
    blue, ground = np.array([0.32, 0.4, 0.52]), np.array([0.2, 0.18, 0.16])
    up = np.clip(directions[..., 1:2], 0, 1)
    sky = np.where(directions[..., 1:2] > 0, blue * (1.15 - 0.5 * up), ground)
    sun = np.exp(18 * (directions @ space.unit(towards_sun) - 1))[..., None] * np.array([9.0, 8.4, 7.5])
    return sky + sun * random.uniform(0.9, 1.1)


def _cameras(
    stage: str, azimuth: float, height: float, views: int, size: tuple[int, int], random: np.random.Generator
) -> tuple[Camera, ...]:
    """Cameras that look at a height above the middle of the stage."""
    result = []
    for k in range(views):
        elevation = {"floor": random.uniform(34, 48), "wall": random.uniform(6, 16)}.get(stage, random.uniform(20, 30))
        fov = float(np.round(random.uniform(33, 44), 3))
        target = np.array([0, height, -0.5 if stage == "wall" else 0]) + random.uniform(-0.06, 0.06, 3)
        turn = azimuth - np.sign(azimuth) * (62 * k + (12 if stage == "wall" else 0))
        reach = {"floor": 1.65, "wall": 1.6}.get(stage, 1.8) / np.tan(np.radians(fov / 2))
        origin = target - reach * space.from_elevation(turn, elevation)
        name = "camera" if views == 1 else f"camera{k}"
        result.append(Camera(name, space.look_at(origin, target), fov, *size))
    return tuple(result)


def without_sky(scene: Scene) -> Scene:
    """The scene with a sky that is nearly black, as pictures with light that bounces need none."""
    sky = scene.lamp("sky")
    return scene.replaced(dataclasses.replace(sky, values={"radiance": (0.01, 0.01, 0.01)}))


def with_picture(scene: Scene, name: str, random: np.random.Generator) -> Scene:
    """The scene with a picture of soft discs and stripes, 32 texels wide, on a body."""
    body, size = scene.body(name), 32
    y, x = (np.mgrid[:size, :size] + 0.5) / size
    image = np.broadcast_to(random.uniform(0.3, 0.5, 3), (size, size, 3)).copy()
    image += 0.1 * np.sin(2 * np.pi * (3 * x + 1.5 * y))[..., None] * random.uniform(0.5, 1, 3)
    for _ in range(6):
        a, b, radius = random.uniform(0.15, 0.85), random.uniform(0.2, 0.8), random.uniform(0.08, 0.2)
        inside = 1 / (1 + np.exp((np.hypot(x - a, y - b) - radius) * 60))
        image += inside[..., None] * (random.uniform(0.1, 0.8, 3) - image)
    image = to_linear(np.round(to_srgb(np.clip(image, 0.05, 0.85)) * 255) / 255)  # as the file has it
    material = Material(body.material.kind, {}, {"reflectance": image})
    return scene.replaced(dataclasses.replace(body, material=material))


def deformed(scene: Scene, name: str, random: np.random.Generator) -> Scene:
    """The scene with a landscape of which one part has risen and another has moved sideways."""
    body = scene.body(name)
    body = dataclasses.replace(body, place=body.place @ np.diag([1.7, 1.7, 1.7, 1.0]))
    vertices = body.local().copy()
    for sign in (1, -1):
        middle = np.array([0.4 * sign, 0, 0.3 * sign]) + random.uniform(-0.1, 0.1, 3)
        near = np.exp(-np.sum((vertices - middle)[:, [0, 2]] ** 2, 1) / (2 * 0.3**2))[:, None]
        vertices += near * np.array([0.06 * sign, 0.26 if sign > 0 else -0.1, 0.08]) * random.uniform(0.85, 1.15)
    body = dataclasses.replace(body, vertices=vertices)
    low = min(body.world().min(0)[1], dataclasses.replace(body, vertices=None).world().min(0)[1])
    return scene.replaced(dataclasses.replace(body, place=space.moved(np.eye(3), (0, 0.06 - low, 0)) @ body.place))


def intruder(scene: Scene, random: np.random.Generator) -> Body:
    """A ball on the floor at the side, in the way of no thing."""
    x = 1.15 * random.choice([-1, 1])
    material = Material("diffuse", {"reflectance": (0.2, 0.5, 0.25)})
    return Body("ball", "globe", space.moved(0.24 * np.eye(3), (x, 0.24, 0.75)), material)
