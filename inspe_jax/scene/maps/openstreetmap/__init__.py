"""OpenStreetMap extracts: the bodies that they have beside lanes."""
