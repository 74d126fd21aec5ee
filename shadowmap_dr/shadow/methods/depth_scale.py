"""The scale on which a map tells depths apart."""

from __future__ import annotations

from dataclasses import dataclass

from ...jit.types import Float


@dataclass(frozen=True)
class DepthScale:
    """Scale on which pre-filtered maps tell depths apart, for each lane or for all. Detached.

    Attributes:
        deviation: least standard deviation that depths are taken to have, as a share of the depth range. With less, surfaces at
            grazing angles to the light would shadow themselves, and derivatives by depth, which grow as it falls, would have
            single large values.
        exponent: of the warp that spreads the depths of the nearest casters, the same for a texel and for look-ups of it. The
            larger it is, the less light surfaces far behind a receiver let through to it, where a texel shows them and a caster.
    """

    deviation: Float | float
    exponent: Float | float = 1.0
