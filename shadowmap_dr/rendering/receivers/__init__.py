"""Shadows on a receiver alone, without a camera pass."""
