"""Records a scene with a CARLA server."""
