"""Baselines for shadowmap_dr: references and pose estimation by Mitsuba's own integrators.

Modules: `reference` (path-traced images), `unshadowed` (the same without shadow rays), `proxy` (an area light that
stands in for a directional one) and `pose` (pose estimation with `direct_projective`). None uses the rasterizer.
"""

from __future__ import annotations

import shadowmap_dr  # noqa: F401  (selects the LLVM library before mitsuba is imported)
