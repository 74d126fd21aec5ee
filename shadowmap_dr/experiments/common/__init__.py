"""Timing, meshes and objects that several experiments share."""
