"""Vertices of shapes: meshes, and tessellated spheres, disks, cylinders and curves."""
