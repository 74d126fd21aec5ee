"""Anti-aliasing in screen space: edges between pixels, and how the pixels beside them mix."""
