"""Makes the morphable head of the package from MakeHuman's shapes: ``python scenes/make_head.py``.

Reads ``heads/makehuman.npz`` (see ``heads/SOURCES.md``), writes ``heads/head.npz``. Heads of adults are drawn at random - convex
weights of MakeHuman's shapes for origin, sex and age, and small random positions of its artists' sliders -, moved on top of each
other, and a principal component analysis of them gives the identity basis. All follows from the constants below.
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import numpy as np

from shadowmap_dr.inverse.faces.morphable import MorphableModel, save_model

HERE = Path(__file__).parent / "heads"
HEADS = 1000
COMPONENTS = 80
SEED = 0
#: Standard deviation of the sliders, which go from -1 to 1, and that of the difference between left and right.
SLIDER, ASYMMETRY = 0.25, 0.04
#: Share of MakeHuman's full expression that a weight of 1 stands for: weights of -2 to 2 are the rule, 2 is the whole of it.
EXPRESSION = 0.5
#: Height in MakeHuman's base mesh (decimetres) where the neck begins, and how far the neck is continued downwards.
NECK, STUB = 6.15, 1.5

ORIGINS = ("african", "asian", "caucasian")
OPPOSITE = {
    "incr": 1,
    "decr": -1,
    "up": 1,
    "down": -1,
    "in": 1,
    "out": -1,
    "forward": 1,
    "backward": -1,
    "convex": 1,
    "concave": -1,
    "uncompress": 1,
    "compress": -1,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, default=HERE / "makehuman.npz", help="MakeHuman's shapes")
    parser.add_argument("--output", type=Path, default=HERE / "head.npz", help="model to write")
    arguments = parser.parse_args()
    with np.load(arguments.source) as source:
        model, kept = build({name: source[name] for name in source.files})
    save_model(arguments.output, model, half=True)
    print(f"{arguments.output}: {model.describe()}; {kept:.2%} of the variance of {HEADS} heads")


def build(source: dict[str, np.ndarray]) -> tuple[MorphableModel, float]:
    """The model, and the share of the heads' variance that its identity components hold."""
    base = source["v"].astype(np.float64)
    rng = np.random.default_rng(SEED)
    shapes = Shapes(source)
    heads = np.stack([base + shapes.draw(rng) for _ in range(HEADS)])
    mask = base[:, 1] > NECK
    # Where a head stands in a body is no part of its shape.
    heads -= heads[:, mask].mean(1, keepdims=True)
    mean = heads.mean(0)
    low, high = mean.min(0), mean.max(0)
    center, scale = 0.5 * (low + high), 2 / (high - low).max()
    heads = turned((heads - center) * scale)
    mean = heads.mean(0)
    components, kept = principal((heads - mean).reshape(HEADS, -1), COMPONENTS)
    names = [str(name) for name in source["expr_names"]]
    expressions = turned(source["expr"].astype(np.float64) * scale * EXPRESSION)
    moving = np.abs(expressions).max((1, 2)) > 0  # one of MakeHuman's moves parts that are not in this mesh
    extend = Stub(source["f"])
    return MorphableModel(
        mean=extend.points(mean, STUB * scale),
        faces=extend.faces,
        identity=np.stack([extend.points(c, 0.0) for c in components.reshape(COMPONENTS, -1, 3)]),
        expression=np.stack([extend.points(e, 0.0) for e in expressions[moving]]),
        identity_names=tuple(f"identity {k + 1}" for k in range(COMPONENTS)),
        expression_names=tuple(name for name, moves in zip(names, moving, strict=True) if moves),
        mask=np.concatenate([mask, np.zeros(len(extend.rim), bool)]),
    ), kept


class Shapes:
    """MakeHuman's shapes as random variables."""

    def __init__(self, source: dict[str, np.ndarray]) -> None:
        self.macro, self.slider = source["macro"].astype(np.float64), source["ident"].astype(np.float64)
        self.macro_names = [str(name).split("-") for name in source["macro_names"]]
        # Sliders come as two shapes for the two ways in which they can be moved.
        self.sliders: dict[str, dict[int, int]] = {}
        for i, name in enumerate(map(str, source["ident_names"])):
            stem, _, way = name.rpartition("-")
            self.sliders.setdefault(stem if way in OPPOSITE else name, {})[OPPOSITE.get(way, 1)] = i

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """(V, 3) difference of a random adult head from the base mesh, decimetres."""
        origin, male, old = rng.dirichlet(np.ones(3)), rng.beta(0.5, 0.5), rng.random()
        share = {"male": male, "female": 1 - male, "old": old, "young": 1 - old}
        weights = [origin[ORIGINS.index(o)] * share[sex] * share.get(age, 0.0) for o, sex, age in self.macro_names]
        total = np.tensordot(weights, self.macro, 1)
        common: dict[str, float] = {}
        for name, ways in self.sliders.items():
            both = re.sub(r"/[lr]-", "/", name)  # the same slider of the other ear, eye or cheek
            value = common.setdefault(both, rng.normal(0, SLIDER)) + (rng.normal(0, ASYMMETRY) if both != name else 0)
            value = float(np.clip(value, -1, 1))
            if -1 not in ways:
                value = abs(value)
            total += abs(value) * self.slider[ways[1 if value >= 0 else -1]]
        return total


class Stub:
    """A piece of neck below the rim at which the head was cut off, so that no shadow ends where a body would go on."""

    def __init__(self, faces: np.ndarray) -> None:
        edges = np.concatenate([faces[:, [k, (k + 1) % 3]] for k in range(3)])
        present = set(map(tuple, edges.tolist()))
        border = np.array([edge for edge in edges.tolist() if (edge[1], edge[0]) not in present])
        self.rim = np.unique(border)
        count = int(faces.max()) + 1
        a, b = border.T
        c, d = (count + np.searchsorted(self.rim, side) for side in (a, b))
        self.faces = np.concatenate([faces, np.stack([b, a, c], 1), np.stack([b, c, d], 1)]).astype(np.int32)

    def points(self, values: np.ndarray, length: float) -> np.ndarray:
        """Positions or changes (V, 3) with those of the stub's lower rim behind them."""
        return np.concatenate([values, values[self.rim] - [0, length, 0]])


def turned(points: np.ndarray) -> np.ndarray:
    """MakeHuman's heads look along +z; here they look along +x, so that light along -z shows a profile."""
    return np.stack([points[..., 2], points[..., 1], -points[..., 0]], -1)


def principal(samples: np.ndarray, count: int) -> tuple[np.ndarray, float]:
    """Directions (count, N) of the largest variance of centred samples, scaled by their standard deviation, and their share."""
    _, s, directions = np.linalg.svd(samples, full_matrices=False)
    largest = np.abs(directions[:count]).argmax(1)
    signs = np.sign(directions[np.arange(count), largest])  # a component has no sign of its own
    variance = s**2 / (len(samples) - 1)
    scaled = directions[:count] * (signs * np.sqrt(variance[:count]))[:, None]
    return scaled, float(variance[:count].sum() / variance.sum())


if __name__ == "__main__":
    main()
