"""Pose estimation with three methods side by side."""
