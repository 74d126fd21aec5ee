"""Pictures of a scene's shadows alone."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .views import View

# Brightness, as a share of the image's, below which a pixel has no light that could be missing.
_DARK = 1e-3


def lit_share(view: View, x: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Share (H, W) of the light that arrives, at the numbers x (n,): 0 in shadow, 1 where lit or where there is no light."""
    lit, unshadowed = (one.image(x).mean(2) for one in (view, view.without_shadows()))
    least = _DARK * max(float(unshadowed.mean()), 1e-12)
    share = np.where(unshadowed > least, lit / np.maximum(unshadowed, least), 1)
    return np.asarray(np.clip(share, 0, 1), np.float32)
