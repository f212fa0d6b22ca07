"""The paper's waypoint model of traffic, with right of way; it needs neither SUMO nor a map."""
