"""Fits of scenes to photographs: poses, lights, materials, cameras, textures and vertices."""
