"""Parameters of the plug-in ``shadowmap``: their names, types and defaults in XML, and their translation to settings."""

from __future__ import annotations

from dataclasses import dataclass, fields
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any

from ..errors import ShadowmapError, warn
from ..rendering.film.aovs import split_aovs
from ..rendering.settings import AUTO, DIRECT, RenderSettings
from ..shadow import ShadowSettings
from .name import PLUGIN

if TYPE_CHECKING:
    import mitsuba as mi

# Names of Mitsuba's own `aov` integrator for channels of this plug-in.
_SYNONYMS = {"sh_normal": "normal"}
# Channels of the image itself.
COLOURS = ("R", "G", "B", "A", "Y")

# Parameters of Mitsuba's integrators that are ignored here, so that a scene's description may keep them. A trailing * matches
# any ending.
_FOREIGN = (
    "rr_depth", "shading_samples", "emitter_samples", "bsdf_samples", "sppc", "sppp", "sppi", "guiding*", "project_seed",
    "proj_seed*", "samples_per_pass", "timeout", "block_size",
)  # fmt: skip


# Types of values in ``mi.Properties`` that are not those of the defaults. They hold no sequences: names of channels are text.
_KINDS: dict[str, type] = {
    "aovs": str,
    "shadow_map_resolution": int,
    "area_light_samples": int,
    "recorded": bool,
    "translucent_layers": int,
}
# Parameters that may be ``auto``, too.
_AUTOMATIC = ("shadow_map_resolution", "area_light_samples", "translucent_layers", "recorded")


@dataclass(frozen=True)
class Options:
    """Parameters of the plug-in, as in XML or a dictionary.

    shadow_map_resolution  texels along each side of a shadow map, at least six more than those of the filter, at most 4096; or
                           ``auto``: 256, and directional lights and spots get as many maps as the pixels that see their
                           shadows are worth, or up to four where most of these see a small part of one; 128 to 256 in small
                           images, for several maps of a light, or for four lights and more
    shadow_tiles           most maps of such a light, at most 16; 0: 16 for ``auto``, else 1
    shadow_method          ``auto`` (``evsm4``), ``vsm``, ``esm``, ``evsm2``, ``evsm4``, ``msm``, ``csm``, ``pcf``, ``standard``
                           (no shadow gradients) or ``none`` (no shadows); see ``shadowmap_dr.shadow.ShadowSettings``
    shadow_filter          ``box``, ``gaussian``, ``wendland`` or ``none``
    shadow_filter_size     odd number of texels; 0: 3, or 1 for lights that have several maps
    shadow_antialias       anti-alias shadow maps; without it casters get no gradient from the outlines of their shadows
    shadow_bleeding        visibilities below this count as 0, against light that bleeds through (``vsm``, ``evsm``, ``msm``)
    shadow_order           terms of the Fourier series of ``csm``, an even number from 2 to 16
    shadow_supersampling   texels along each side that are averaged into one of the map, 1 to 8 (pre-filtered methods)
    shadow_receiver_range  resolve depths only from the first receiver on, against light that bleeds through
    shadow_cull_backfaces  leave the backs of closed shapes out of the maps of directional lights: faster, with the same result as
                           long as no shape turns inside out, not even in a fold
    area_light_samples     points on each area light that cast shadows, or ``auto``: 8 to 32, as its penumbrae need (Mitsuba's
                           ``emitter_samples`` is another number)
    environment_light_samples  directions of an environment that cast shadows
    soft_map_resolution    texels along each side of these points' and directions' shadow maps
    emitter_shadows        ``samples``, or ``single``: one map for each area light, penumbrae estimated from it
    light_memory           GiB for the shadow maps of lights; more lights are rendered one slice after the other
    translucent_layers     most translucent surfaces along a ray, nearest first, 1 to 64; ``auto``: as many as there are when the
                           scene is loaded, and one more, at most 32. Farther ones are left out
    transmittance_method   encoding of the depths of translucent casters in shadow maps: ``msm``, ``vsm``, ``esm``, ``evsm2``,
                           ``evsm4`` or ``csm``
    transmittance_groups   parts of the translucent casters, front to back, whose depths are encoded apart, 1 to 8; 0: 2, or 4 for
                           more than eight layers
    shadow_samples         look-ups along each side of a pixel, 1 to 8; 0: automatic
    antialias              anti-alias the image; without it outlines have no gradient
    ambient                radiance of unshadowed light from all directions, added to the scene's environment
    hide_emitters          the camera looks through area lights, and sees black instead of environments; both light the scene
    max_depth              as in Mitsuba: 0 is black, 1 shows emitters only, 2 is direct light; more, or -1, is rendered as 2
    aovs                   further channels, separated by commas: names of ``shadowmap_dr.rendering.film.aovs.AOVS``, or
                           ``label:name`` to call the channel ``label``. Python may give a sequence of them to this record
    tessellation           triangles around spheres, disks and cylinders, at least 3; curves have half as many around them, and
                           B-splines an eighth of it along each segment
    recorded               ``mi.render`` and its backward pass are recorded with ``dr.freeze`` and replayed while only numbers
                           change: up to four times as fast where passes are short, slower where they are long. Backward passes
                           to materials and textures are not recorded. ``auto``: from the fifth step of a loop on, where images
                           are small
    compat                 conventions of Worchel and Alexa's code
    """

    shadow_map_resolution: int | str = AUTO
    shadow_tiles: int = 0
    shadow_method: str = ShadowSettings.method
    shadow_filter: str = ShadowSettings.filter
    shadow_filter_size: int = 0
    shadow_antialias: bool = ShadowSettings.antialias
    shadow_bleeding: float = ShadowSettings.bleeding
    shadow_order: int = ShadowSettings.order
    shadow_supersampling: int = ShadowSettings.supersampling
    shadow_receiver_range: bool = ShadowSettings.receiver_range
    shadow_cull_backfaces: bool = ShadowSettings.cull_backfaces
    shadow_samples: int = RenderSettings.shadow_samples
    area_light_samples: int | str = RenderSettings.area_light_samples
    environment_light_samples: int = RenderSettings.environment_light_samples
    soft_map_resolution: int = RenderSettings.soft_map_resolution
    emitter_shadows: str = RenderSettings.emitter_shadows
    light_memory: float = RenderSettings.light_memory
    translucent_layers: int | str = RenderSettings.translucent_layers
    transmittance_method: str = ShadowSettings.transmittance_method
    transmittance_groups: int = ShadowSettings.transmittance_groups
    antialias: bool = RenderSettings.antialias
    ambient: float = RenderSettings.ambient
    hide_emitters: bool = RenderSettings.hide_emitters
    max_depth: int = RenderSettings.max_depth
    aovs: tuple[str, ...] = RenderSettings.aovs
    tessellation: int = 64
    recorded: bool | str = AUTO
    compat: bool = ShadowSettings.compat

    def __post_init__(self) -> None:
        object.__setattr__(self, "aovs", split_aovs(self.aovs))
        if self.recorded is not True and self.recorded is not False and self.recorded != AUTO:
            raise ShadowmapError(f"recorded is {self.recorded!r}: give True, False or '{AUTO}'.")

    @classmethod
    def from_properties(cls, props: mi.Properties) -> Options:
        """Read ``mi.Properties``. Raises ShadowmapError for an unknown parameter or a value of another type."""
        defaults = {f.name: f.default for f in fields(cls)}
        values: dict[str, Any] = {}
        foreign = []
        for name in props.keys():  # noqa: SIM118  (Properties is no dictionary)
            if name in defaults:
                if name in _AUTOMATIC and props[name] == AUTO:
                    continue  # the default
                values[name] = _typed(name, props[name], _KINDS.get(name) or type(defaults[name]))
            elif any(fnmatchcase(name, pattern) for pattern in _FOREIGN):
                _ = props[name]  # otherwise Mitsuba would report an unqueried parameter
                foreign.append(name)
            else:
                raise ShadowmapError(f"'{PLUGIN}' has no parameter '{name}': {_near(name, sorted(defaults))}.")
        if foreign:
            names, kind = ", ".join(sorted(foreign)), "parameters" if len(foreign) > 1 else "a parameter"
            own = " Points on area lights are area_light_samples here." if "emitter_samples" in foreign else ""
            warn(f"'{PLUGIN}' ignores {names}: {kind} of Mitsuba's integrators.{own}")
        options = cls(**values)
        if options.max_depth == -1 or options.max_depth > DIRECT:
            left_out = "light that is reflected more than once is left out"
            warn(f"'{PLUGIN}' renders max_depth {options.max_depth} as {DIRECT}: {left_out}.")
        return options

    @property
    def labelled_aovs(self) -> tuple[tuple[str, str], ...]:
        """(label, name) of each further channel."""
        pairs = []
        for entry in self.aovs:
            label, _, name = entry.rpartition(":")
            name = name.strip()
            pairs.append((label.strip() or name, _SYNONYMS.get(name, name)))
        labels = [label for label, _ in pairs]
        for label in labels:
            if label in COLOURS:
                raise ShadowmapError(
                    f"aovs is {','.join(self.aovs)!r}: '{label}' is a channel of the image itself, label it otherwise."
                )
            if labels.count(label) > 1:
                raise ShadowmapError(
                    f"aovs is {','.join(self.aovs)!r}: '{label}' is there twice; label one of them, as in a:depth."
                )
        return tuple(pairs)

    def render_settings(self) -> RenderSettings:
        """The settings of the renderer. Raises ShadowmapError for values out of range."""
        if self.tessellation < 3:
            raise ShadowmapError(f"tessellation is {self.tessellation}: spheres need at least 3 triangles around them.")
        own = ("aovs", "tessellation", "recorded")
        settings = {option.name: getattr(self, option.name) for option in fields(self) if option.name not in own}
        return RenderSettings.of(**settings, aovs=tuple(name for _, name in self.labelled_aovs))


def _near(name: str, known: list[str]) -> str:
    """Text with the known names and the one most similar to ``name``."""
    nearest = get_close_matches(name, known, 1)
    return f"it has {', '.join(known)}" + (f"; the nearest is '{nearest[0]}'" if nearest else "")


def _typed(name: str, value: object, kind: type) -> object:
    # Unlike in Python, a bool is no int here; but a float may be written without a decimal point.
    if type(value) is kind:
        return value
    if kind is float and type(value) is int:
        return float(value)
    words: dict[type, str] = {int: "an integer", float: "a number", bool: "a boolean", str: "a string"}
    shown = repr(value) if isinstance(value, bool | int | float | str) else type(value).__name__
    raise ShadowmapError(f"'{name}' of '{PLUGIN}' is {shown}, but must be {words[kind]}.")
