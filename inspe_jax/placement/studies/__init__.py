"""Studies of placements: cost, tolerance, the optimum of given candidates."""
