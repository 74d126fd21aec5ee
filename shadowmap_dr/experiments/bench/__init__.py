"""The benchmark: steps, rasterization, growth of costs, and time by pass."""
