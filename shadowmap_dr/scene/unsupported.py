"""Parts of a scene that images leave out, named in one warning."""

from __future__ import annotations

from collections.abc import Sequence

import mitsuba as mi

from ..errors import warn
from .lights.read import named_emitters, unsupported_reason
from .sensor import lenses_of

# Names that a warning lists.
_LISTED = 4


def omissions_of(scene: mi.Scene, shapes: Sequence[tuple[str, mi.Shape]], unsupported: Sequence[str]) -> tuple[str, ...]:
    """Sentences, without full stops, about all that images of a scene leave out: one for each kind.

    ``shapes``: (name, ``mi.Shape``) of all rendered shapes; ``unsupported``: sentences about the shapes that are not.
    """
    found = list(unsupported)
    media = [name for name, shape in shapes if shape.is_medium_transition()]
    if media:
        found.append(f"{_named('shape', media)} {_bounds(media)}, which is ignored: light passes through it unchanged")
    found += _delta_materials(shapes, _has_extended_lights(scene))
    rendered = {shape for _, shape in shapes}
    for name, emitter in named_emitters(scene):
        shape, reason = emitter.get_shape(), unsupported_reason(emitter)
        place = f" of shape '{shape.id()}'" if shape is not None else ""
        if reason is not None:
            found.append(f"emitter '{name}'{place} ({emitter.class_name()}) {reason}")
        elif emitter.class_name() == "AreaLight" and shape not in rendered:
            found.append(f"emitter '{name}'{place} is left out with its shape")
    for sensor in scene.sensors():
        found += lenses_of(sensor)
    return tuple(found)


def warn_of(omissions: Sequence[str]) -> None:
    """Issue one ``UserWarning`` that names all omissions, if there are any."""
    if omissions:
        warn(f"Not all in the scene is supported: {'; '.join(omissions)}.")


def _has_extended_lights(scene: mi.Scene) -> bool:
    return any(emitter.is_environment() or emitter.class_name() == "AreaLight" for emitter in scene.emitters())


def _delta_materials(shapes: Sequence[tuple[str, mi.Shape]], mirrored: bool) -> list[str]:
    """Sentences about BSDFs that reflect or refract into single directions. ``mirrored``: whether mirrors could show lights."""
    groups: dict[mi.BSDF, list[str]] = {}
    for name, shape in shapes:
        groups.setdefault(shape.bsdf(), []).append(name)
    found = []
    for bsdf, users in groups.items():
        flags, what = bsdf.flags(), f"BSDF '{bsdf.id()}' ({bsdf.class_name()}) of {_named('shape', users)}"
        delta = mi.has_flag(flags, mi.BSDFFlags.DeltaReflection) or mi.has_flag(flags, mi.BSDFFlags.DeltaTransmission)
        if not mi.has_flag(flags, mi.BSDFFlags.Smooth):
            if not mi.has_flag(flags, mi.BSDFFlags.Null):
                found.append(f"{what} has no smooth component and renders black")
            elif delta and mirrored:
                found.append(f"{what} shows no mirror images of lights, only the light that it lets through")
        elif delta and mirrored:
            found.append(f"{what} shows no mirror images of lights, only its smooth component")
    return found


def _named(kind: str, names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"{kind}{'s' if len(names) > 1 else ''} " + ", ".join(f"'{name}'" for name in names[:_LISTED]) + more


def _bounds(names: Sequence[str]) -> str:
    return "bounds a medium" if len(names) == 1 else "bound media"
