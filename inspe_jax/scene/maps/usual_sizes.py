"""Sizes of bodies of which a map says none [m]."""

BUILDING = 6.0
"""Height of a building: two levels."""
BARRIERS = {"wall": (2.0, 0.25), "city_wall": (6.0, 1.0), "hedge": (1.5, 0.7), "fence": (1.8, 0.1)}
"""Height and width of barriers."""
TREE = {"height": 8.0, "diameter_crown": 5.0, "circumference": 0.94}
"""A tree."""
POLE = 6.0, 0.1
"""Height and radius of a pole."""
HEIGHTS = {
    "building": BUILDING,
    "wall": BARRIERS["wall"][0],
    "hedge": BARRIERS["hedge"][0],
    "tree": TREE["height"],
    "pole": POLE[0],
    "furniture": 1.0,
    "parked vehicle": 1.5,
}
"""Height of each kind of body of which a map says none."""


def crown_base(height: float) -> float:
    """Height at which the crown of a tree begins, of which a map says none."""
    return min(2.5, 0.4 * height)
