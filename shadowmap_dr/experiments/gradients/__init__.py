"""Derivatives of shadows: images of them, convergence, and the minimal plane."""
