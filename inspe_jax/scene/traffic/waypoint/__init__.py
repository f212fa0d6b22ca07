"""The paper's waypoint model of traffic, with right of way.

The paper moves boxes along waypoints. Here they also keep their distance and give way, because
boxes that drive through each other would change occlusion and occupancy. SUMO does this too, but
needs an extra package and a map; this model needs neither, so it serves the built-in intersections.
"""
