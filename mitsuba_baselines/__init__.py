"""Baselines for shadowmap_dr: references and pose estimation by Mitsuba's own integrators.

Modules: `reference` (path-traced images), `unshadowed` (images without shadow rays), `derivatives` (central differences),
`projective` (derivatives by `direct_projective`), `proxy` (an area light in place of a directional one), `pose` (pose estimation
with `direct_projective`) and `fair_settings` (its sample counts). None of them uses the rasterizer.
"""

from __future__ import annotations

import shadowmap_dr  # noqa: F401  (selects the LLVM library before mitsuba is imported)
