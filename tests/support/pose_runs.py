"""Pose estimation with a cheap renderer, for tests of the experiment."""

from __future__ import annotations

from typing import Any

from fakes import BlobRenderer

from shadowmap_dr.experiments.pose import scene as pose_scene
from shadowmap_dr.inverse import Method, PoseFit


def build(name: str, problem: pose_scene.PoseProblem, reference: Any) -> Method:
    settings = {"name": name}
    points = problem.p_rest[:: len(problem.p_rest) // 5][:5]
    renderer = BlobRenderer.create(problem.resolution, len(points))
    return PoseFit(renderer, "object", points, reference[..., :1], settings=settings)
