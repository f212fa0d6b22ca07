"""Studies of placements: cost and tolerance."""
