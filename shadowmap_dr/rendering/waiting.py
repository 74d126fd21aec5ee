"""Memory of images that wait for their backward passes."""

from __future__ import annotations

#: Most pixel samples of all waiting images together; each may hold half a kilobyte.
MOST_SAMPLES = 1 << 20
#: Texels of shadow maps that take as much memory as one sample.
TEXELS = 6
