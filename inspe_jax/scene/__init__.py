"""Scenes: intersections, voxels and traffic."""
