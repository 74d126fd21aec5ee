"""Fits of scenes to photographs: poses, lights, materials, cameras and exposure."""
