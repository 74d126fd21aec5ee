"""Meshes and collections whose shadows match images."""
