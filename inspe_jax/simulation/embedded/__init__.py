"""The package's own world of triangles: cameras and LiDARs by ray casting."""
