"""Readers of maps: OpenDRIVE, SUMO and OpenStreetMap."""
