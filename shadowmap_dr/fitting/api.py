"""Fits from Python in one call."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import mitsuba as mi

from ..errors import ShadowmapError
from ..rendering.renderer import Renderer
from ..scene.origin import SceneOrigin
from .losses import LossKind
from .options import FitOptions
from .own import Own
from .own_losses import OwnFunction
from .result import FitResult
from .scene_loading import load_scene
from .search import Fit
from .targets import Target, make_target, read_target
from .vary import Vary

#: A picture: a file, an array (H, W), (H, W, 3) or (H, W, 4) of linear colours, or a record with a mask.
Picture = Any  # Any: arrays of NumPy, Dr.Jit and PyTorch, names of files, Target


def fit(
    scene: mi.Scene | Renderer | str | os.PathLike[str],
    targets: Picture | Sequence[Picture] | Mapping[int, Picture],
    vary: Sequence[str | Vary | Own | Mapping[str, Any]],
    *,
    residuals: OwnFunction | None = None,
    loss: LossKind | OwnFunction = "huber",
    **options: Any,  # Any: fields of FitOptions
) -> FitResult:
    """Fit a scene to pictures: find poses, lights, materials, cameras, textures or vertices.

    Args:
        scene: a scene, loaded with ``optimize=False`` so that shapes keep their names; a renderer of it; or a scene file. Its
            objects without an id get one: ``shape_0``, ``light_0``, ``camera_0``.
        targets: a picture of the scene's first sensor, several of the first, second, ... sensor, or a mapping from numbers of
            sensors. A picture is a file (sRGB, or OpenEXR: linear), an array of linear colours (H, W, 3), or a
            :class:`~shadowmap_dr.fitting.targets.Target`, which has a mask and a known exposure.
        vary: things that vary, as for ``shadowmap-dr fit --vary``: ``"bunny:pose"``, ``"sun:direction"``,
            ``"wall.bsdf.reflectance,max=0.8"``, mappings ``{"name": "sun", "kind": "direction", "spread": 60}``, or
            parametrisations of your own (:class:`~shadowmap_dr.fitting.own.Own`).
        residuals: function of yours, instead of differences of colours: it gets an image and the picture, two ``mi.TensorXf``
            (H, W, 3), linear, and returns residuals, a float array of Dr.Jit of any shape; zero where both are alike. The image
            has the picture's exposure, and is attached: use functions of ``drjit``. Pixels that do not count are black in both.
            It is called at several sizes, outside of recordings.
        loss: ``huber``, ``l2`` or ``l1``, of the residuals. Or, where nothing but textures and vertices varies, a function of an
            image and the picture that returns one number.
        options: further fields of :class:`~shadowmap_dr.fitting.options.FitOptions` by name: ``exposure=True``,
            ``starts=16``, ...

    Returns:
        The result: ``found``, ``estimates`` with 95 % intervals, ``words``, ``pictures``.

    Raises:
        ShadowmapError: names that the scene does not have, pictures of another shape, unknown options, functions that fail or
            have no derivatives.
    """
    return prepared(scene, targets, vary, residuals=residuals, loss=loss, **options).run()


def prepared(
    scene: mi.Scene | Renderer | str | os.PathLike[str],
    targets: Picture | Sequence[Picture] | Mapping[int, Picture],
    vary: Sequence[str | Vary | Own | Mapping[str, Any]],
    *,
    residuals: OwnFunction | None = None,
    loss: LossKind | OwnFunction = "huber",
    **options: Any,  # Any: fields of FitOptions
) -> Fit:
    """The fit that :func:`fit` runs, to take its steps one by one. Arguments as there."""
    own_loss = None if isinstance(loss, str) else loss
    if own_loss is None:
        options["loss"] = loss
    entries = [vary] if isinstance(vary, (str, Vary, Own)) else vary
    try:
        chosen = FitOptions(vary=tuple(entry if isinstance(entry, Own) else Vary.of(entry) for entry in entries), **options)
    except TypeError as error:
        known = ", ".join(one.name for one in fields(FitOptions) if one.name != "vary")
        raise ShadowmapError(f"fit: {str(error).partition('() ')[2] or error}; the options are {known}.") from error
    if isinstance(scene, Renderer):
        renderer = scene
    elif isinstance(scene, mi.Scene):
        renderer = Renderer.from_scene(scene)
    else:
        renderer = Renderer.from_scene(load_scene(scene))
        renderer.origin = SceneOrigin(scene)
    return Fit(renderer, _targets(targets), chosen, residuals, own_loss)


def _targets(given: Any) -> list[Target]:  # Any: see `fit`
    """Records of pictures."""
    if isinstance(given, Mapping):
        return [replace(_target(picture), sensor=number) for number, picture in given.items()]
    if isinstance(given, (list, tuple)):
        return [_of_place(picture, number) for number, picture in enumerate(given)]
    return [_target(given)]


def _of_place(picture: Picture, number: int) -> Target:
    """A picture of the sensor of its place in a list; records have their own."""
    return picture if isinstance(picture, Target) else replace(_target(picture), sensor=number)


def _target(picture: Picture) -> Target:
    if isinstance(picture, Target):
        return picture
    return read_target(picture) if isinstance(picture, (str, os.PathLike)) else make_target(picture)
