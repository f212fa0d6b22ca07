"""SUMO networks and OpenStreetMap extracts."""
