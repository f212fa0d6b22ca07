"""The metrics, and how they are counted over frames and sensors."""
