"""Sizes of bodies of which a map says none [m]."""

BUILDING = 6.0
"""Height of a building: two levels."""
BARRIERS = {"wall": (2.0, 0.25), "city_wall": (6.0, 1.0), "hedge": (1.5, 0.7), "fence": (1.8, 0.1)}
"""Height and width of barriers."""
TREE = {"height": 8.0, "diameter_crown": 5.0, "circumference": 0.94}
"""A tree."""
TREE_BASE = 2.5, 0.4
"""Crowns begin at this height, or at this share of a lower tree's height."""
POLE = 6.0, 0.1
"""Height and radius of a pole."""
FURNITURE = 1.0
"""Height of an obstacle."""
