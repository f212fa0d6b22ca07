"""The frozen world: intersection, voxels and traffic."""
