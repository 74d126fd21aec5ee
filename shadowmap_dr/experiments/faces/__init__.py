"""Faces from profile shadows: heads, metrics, the information of a silhouette, and reports."""
