"""The paper's waypoint model of traffic."""
