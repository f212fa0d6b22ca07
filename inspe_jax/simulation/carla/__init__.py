"""Recording by a CARLA server."""
