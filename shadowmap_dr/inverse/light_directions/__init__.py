"""Directions of lights, many runs at once."""
