"""The command `shadowmap-dr pose`: poses from images, with three methods side by side."""

from __future__ import annotations

import dataclasses

from ..experiments.pose import experiment as pose_experiment
from ..experiments.pose.methods import usual_methods
from ..io import console
from ..variants import DEFAULT_VARIANT, set_variant
from .options import Given, Variant, from_record


@from_record()
def pose(given: Given[pose_experiment.PoseOptions], variant: Variant = DEFAULT_VARIANT) -> None:
    """Find an object's pose from an image of the object and its shadow, with three methods side by side.

    Writes OUT/pose.json, and for each object and resolution a picture of all methods, images and a convergence plot.
    """
    set_variant(variant)
    options = given.make()
    if "methods" not in given:
        kinds = {options.normals_of(name) for name in options.objects}
        known = [usual_methods(options.shadow_only, normals) for normals in kinds]
        options = dataclasses.replace(options, methods=min(known, key=len))
    records = pose_experiment.run_pose(options)
    console.show(pose_experiment.table(records))
    console.result(pose_experiment.pictures_of(options)[0], options.out / "pose.json")
