"""Optimisation loops that resume from checkpoints, and sweeps over many runs."""
