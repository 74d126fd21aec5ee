"""Names of a scene's objects that have no id."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi

from .mitsuba_objects import children


def names_of(objects: Sequence[mi.Object], word: str) -> list[str]:
    """Names of objects of one kind: ids, and ``word_N`` for the N-th one, counted from 0, if it has no id."""
    ids = [one.id() for one in objects]
    taken = set(ids)
    return [name or unique(f"{word}_{number}", taken) for number, name in enumerate(ids)]


def name_objects(scene: mi.Scene) -> None:
    """Give ids to the objects of a scene that have none, so that ``mi.traverse(scene)`` shows the same names each time.

    Mitsuba names such objects by their place in memory. Names are ``shape_N``, as in :class:`~shadowmap_dr.Renderer`,
    ``light_N``, ``camera_N`` and, for all else that has parameters, ``object_N``. Emitters within shapes need no names.
    """
    direct = dict.fromkeys(child for _, child in children(scene))
    for word, objects in (("shape", scene.shapes()), ("light", scene.emitters()), ("camera", scene.sensors())):
        for one, name in zip(objects, names_of(objects, word), strict=True):
            if one in direct and not one.id():
                one.set_id(name)
    rest = list(direct)
    for one, name in zip(rest, names_of(rest, "object"), strict=True):
        if not one.id():
            one.set_id(name)


def unique(name: str, taken: set[str]) -> str:
    """The name, with a number behind it if it is taken; added to those that are."""
    candidate, count = name, 1
    while candidate in taken:
        candidate, count = f"{name}_{count}", count + 1
    taken.add(candidate)
    return candidate
