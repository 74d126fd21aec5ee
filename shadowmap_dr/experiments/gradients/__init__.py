"""Derivatives of shadows: derivative images, convergence, and the minimal plane."""
