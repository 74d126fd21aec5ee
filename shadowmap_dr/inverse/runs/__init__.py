"""Loops that survive being killed, and sweeps over many runs."""
