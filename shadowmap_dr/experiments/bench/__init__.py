"""The benchmark: steps, rasterization, how costs grow, and where the time goes."""
