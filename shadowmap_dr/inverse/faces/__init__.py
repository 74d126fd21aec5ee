"""Morphable models: their format, converters, and the fit to shadows."""
