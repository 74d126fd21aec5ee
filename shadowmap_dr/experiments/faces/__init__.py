"""Faces from profile shadows: heads, metrics, what a silhouette tells, and reports."""
