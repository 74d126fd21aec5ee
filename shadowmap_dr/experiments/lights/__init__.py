"""Directions of lights from images, in sweeps."""
