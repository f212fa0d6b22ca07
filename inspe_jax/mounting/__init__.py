"""Where a map can carry sensors, and the usual placements there."""
