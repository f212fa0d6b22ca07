"""Maps into intersections: OpenDRIVE, SUMO and OpenStreetMap."""
