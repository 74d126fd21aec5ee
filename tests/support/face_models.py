"""A small morphable model for tests: an egg with a nose, and four ways in which it changes."""

from __future__ import annotations

import numpy as np
import trimesh

from shadowmap_dr.inverse.faces.morphable import MorphableModel


def egg(level: int = 3) -> MorphableModel:
    """Faces +x. Identity: depth, height, width, nose. Expressions: a mouth that opens, cheeks on the left and on the right."""
    sphere = trimesh.creation.icosphere(level)
    x, y, z = sphere.vertices.T

    def bump(cx: float, cy: float, cz: float, width: float) -> np.ndarray:
        return np.exp(-((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) / width**2)

    nose = bump(1, 0, 0, 0.3)
    mean = np.stack([0.8 * x + 0.15 * nose, y, 0.65 * z], 1)
    zero = np.zeros_like(x)
    identity = [(0.06 * x, zero, zero), (zero, 0.05 * y, zero), (zero, zero, 0.06 * z), (0.06 * nose, zero, zero)]
    mouth, left, right = bump(0.8, -0.6, 0, 0.3), bump(0.5, 0, 0.8, 0.4), bump(0.5, 0, -0.8, 0.4)
    expression = [(0.08 * mouth, -0.08 * mouth, zero), (zero, zero, 0.1 * left), (zero, zero, -0.1 * right)]
    return MorphableModel(
        mean=mean,
        faces=sphere.faces,
        identity=np.moveaxis(np.array(identity), 1, 2),
        expression=np.moveaxis(np.array(expression), 1, 2),
        identity_names=("depth", "height", "width", "nose"),
        expression_names=("mouthOpen", "cheekLeft", "cheekRight"),
        mask=mean[:, 1] > -0.8,
    )
