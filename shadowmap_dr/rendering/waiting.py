"""Memory of images that wait for their backward passes."""

from __future__ import annotations

#: Most pixel samples of all waiting images together; each may hold half a kilobyte.
MOST_SAMPLES = 1 << 20
#: Texels of shadow maps that take as much memory as one sample.
TEXELS = 6
#: Most samples, and texels that take as much memory, of an image whose results are handed to its backward pass. Only the latest
#: image may have more than ``MOST_SAMPLES``: computing its results again would take as much memory.
MOST_OF_LATEST = 6 << 20
